"""The force on each cart that masses, dampings and springs do not explain.

The second derivative of measured positions is too noisy to use. Modulating functions instead give
the exact mean of the force over a short window, and the means of velocity, position and input.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.modulating import bump_integral, window_weights
from pipeline.estimation.noise import high_frequency_noise
from pipeline.gap.types import Gap, Trace
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.simulator.laws import shaped_input


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualForce:
    """The force on one cart in one run that the linear chain does not explain.

    All values (n,) are weighted means, one for each window.

    Attributes
    ----------
    measured : the force according to the measured motion.
    model : the force according to the motion of the model with effects. It agrees with `measured`
        if the effects are right.
    u : the logged input for cart 1; zero for other carts.
    shaped_input : the input after the model's dead zone and saturation, which is subtracted from
        the forces.
    velocity, position : measured motion of the cart, without the encoder zero.
    neighbours : positions (2, n) of the carts before and after; zero for a wall or a held cart.
    neighbours_velocity : velocities (2, n) of the neighbours.
    """

    experiment: str
    cart: int
    held_out: bool
    t: Array
    measured: Array
    model: Array
    u: Array
    shaped_input: Array
    velocity: Array
    position: Array
    neighbours: Array
    neighbours_velocity: Array


def residual_forces(gap: Gap, *, free: Mapping[str, Sequence[int]]) -> tuple[ResidualForce, ...]:
    """Return the unexplained force on every cart in every run, if its neighbours were measured.

    A run sampled too slowly for the longest window is left out. `free` lists, for each experiment,
    the carts that move.
    """
    runs: dict[tuple[str, bool, float], dict[int, Trace]] = {}
    for trace in gap.traces:
        run = trace.experiment, trace.held_out, float(trace.t[0])
        runs.setdefault(run, {})[trace.cart] = trace
    found: list[ResidualForce | None] = []
    for (experiment, *_), carts in runs.items():
        moving = set(free[experiment])
        for cart in carts:
            if moving & {cart - 1, cart + 1} <= set(carts):
                found.append(_one(carts, cart, gap.model))
    return tuple(force for force in found if force is not None)


def _one(carts: Mapping[int, Trace], cart: int, model: AugmentedChain) -> ResidualForce | None:
    trace = carts[cart]
    t = trace.t
    around = [carts.get(cart - 1), trace, carts.get(cart + 1)]
    zero = np.zeros(t.size)
    measured = np.array([zero if c is None else c.measured - c.zero for c in around])
    simulated = np.array([zero if c is None else c.final - c.zero for c in around])
    u = trace.u if cart == 1 else zero
    inputs = np.array([u, _shaped_input(u, model)])
    noise = high_frequency_noise(trace.measured - trace.final)
    i, chain = cart - 1, model.chain
    before, after = chain.k[i], chain.k[i + 1]
    best = None
    # Lengths of the windows in s; the middle half has most of the weight.
    for length in (0.05, 0.07, 0.1, 0.15, 0.2, 0.3):
        if (windows := _cut(t, length=length)) is None:
            continue
        local = t[windows]
        s = (local - local[:, :1]) / (local[:, -1:] - local[:, :1])
        w, w1, w2 = window_weights(local)
        # An input is held after its sample, so its weight is the exact share of the bump function
        # in that interval.
        held = np.diff(bump_integral(s), axis=1) / bump_integral(np.ones(1))
        pushes = [(held * push[windows[:, :-1]]).sum(1) for push in inputs]
        own = chain.m[i] * w2 - chain.c[i] * w1 + (before + after) * w
        means = []
        for x in (measured, simulated):
            springs = (w * (before * x[0] + after * x[2])[windows]).sum(1)
            means.append((own * x[1][windows]).sum(1) - springs - pushes[1])
        position = np.array([(w * x[windows]).sum(1) for x in measured])
        velocity = np.array([-(w1 * x[windows]).sum(1) for x in measured])
        best = ResidualForce(
            experiment=trace.experiment,
            cart=cart,
            held_out=trace.held_out,
            t=(w * local).sum(1),
            measured=means[0],
            model=means[1],
            u=pushes[0],
            shaped_input=pushes[1],
            velocity=velocity[1],
            position=position[1],
            neighbours=position[[0, 2]],
            neighbours_velocity=velocity[[0, 2]],
        )
        # The noise must be less than a fiftieth of the force's range.
        if noise * float(np.sqrt(np.median((own**2).sum(1)))) <= 0.02 * np.ptp(best.measured):
            break
    return best


def _shaped_input(u: Array, model: AugmentedChain) -> Array:
    """Return the input after dead zone and saturation; delays and lags are ignored."""
    drive = model.tables().drive
    return np.array([shaped_input(drive, float(one)) for one in u])


def _cut(t: Array, *, length: float) -> np.ndarray | None:
    """Return the sample numbers (windows, samples) of overlapping windows; None for a short run."""
    width = round(length * (t.size - 1) / float(t[-1] - t[0])) + 1
    if width < 9 or width > t.size:
        return None
    count = min(t.size - width + 1, 400)
    first = np.linspace(0, t.size - width, count).astype(int)
    return first[:, None] + np.arange(width)
