"""The force on each cart that masses, dampings and springs do not account for.

Measured positions give no acceleration worth having. What modulating functions give is the exact
mean of the force over a short window, with the mean velocity, position and input beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.modulating import bump_integral, window_weights
from pipeline.estimation.noise import high_frequency_noise
from pipeline.gap.types import Gap, Trace
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.effects.base import AugmentedChain
from pipeline.plant.nonlinear.simulator.laws import arriving

_WINDOWS = (0.05, 0.07, 0.1, 0.15, 0.2, 0.3)  # s; half of one weighs anything
_FEWEST = 9  # samples in a window
_NOISE = 0.02  # of the force's range that noise may make
_MOST = 400  # windows a record


@dataclass(frozen=True, kw_only=True, eq=False)
class ResidualForce:
    """One cart in one run; all (n,) are weighted means over one window each.

    Attributes
    ----------
    measured, model : what the linear part leaves of the measured motion, and of the motion that
        the model with its effects gives: alike where the effects are right.
    u : the logged input, on cart 1; 0 elsewhere.
    arriving : what the model's dead zone and saturation leave of it, which is taken off the forces.
    velocity, position : of the measured cart, its encoder's zero taken off.
    neighbours : (2, n) positions of the carts before and after, 0 for a wall or a held cart.
    neighbours_velocity : (2, n) their velocities.
    """

    experiment: str
    cart: int
    held_out: bool
    t: Array
    measured: Array
    model: Array
    u: Array
    arriving: Array
    velocity: Array
    position: Array
    neighbours: Array
    neighbours_velocity: Array


def residual_forces(gap: Gap, *, free: Mapping[str, Sequence[int]]) -> tuple[ResidualForce, ...]:
    """Return the residual force of every cart in every run whose neighbours were measured.

    A run sampled too slowly for the longest window has none.

    `free` tells which carts move in each run.
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
    inputs = np.array([u, _arriving(u, model)])
    noise = high_frequency_noise(trace.measured - trace.final)
    best = None
    for length in _WINDOWS:
        if (windows := _cut(t, length=length)) is None:
            continue
        best = _average(
            windows, t, measured, simulated, inputs, chain=model.chain, cart=cart, noise=noise
        )
        if best.noise <= _NOISE * np.ptp(best.force):
            break
    if best is None:
        return None
    return ResidualForce(
        experiment=trace.experiment,
        cart=cart,
        held_out=trace.held_out,
        t=best.t,
        measured=best.force,
        model=best.model,
        u=best.inputs[0],
        arriving=best.inputs[1],
        velocity=best.velocity[1],
        position=best.position[1],
        neighbours=best.position[[0, 2]],
        neighbours_velocity=best.velocity[[0, 2]],
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Means:
    t: Array
    force: Array
    model: Array
    inputs: Array
    position: Array
    velocity: Array
    noise: float


def _arriving(u: Array, model: AugmentedChain) -> Array:
    """Return what the drive passes on of the input, delays and lags apart."""
    _, _, drive = model.tables()
    return np.array([arriving(drive, float(one)) for one in u])


def _cut(t: Array, *, length: float) -> np.ndarray | None:
    """Return the sample numbers (windows, samples) of overlapping windows, None if too short."""
    width = round(length * (t.size - 1) / float(t[-1] - t[0])) + 1
    if width < _FEWEST or width > t.size:
        return None
    count = min(t.size - width + 1, _MOST)
    first = np.linspace(0, t.size - width, count).astype(int)
    return first[:, None] + np.arange(width)


def _average(
    windows: np.ndarray,
    t: Array,
    measured: Array,
    simulated: Array,
    inputs: Array,
    *,
    chain: Chain,
    cart: int,
    noise: float,
) -> _Means:
    local = t[windows]
    s = (local - local[:, :1]) / (local[:, -1:] - local[:, :1])
    w, w1, w2 = window_weights(local)
    # An input is held over the interval that follows its sample: the weight's exact share of it.
    s = (local - local[:, :1]) / (local[:, -1:] - local[:, :1])
    held = np.diff(bump_integral(s), axis=1) / bump_integral(np.ones(1))
    pushes = np.array([(held * u[windows[:, :-1]]).sum(1) for u in inputs])
    i = cart - 1
    m, c = chain.m[i], chain.c[i]
    before, after = chain.k[i], chain.k[i + 1]

    force_weight = m * w2 - c * w1 + (before + after) * w

    def force(x: Array) -> Array:
        springs = (w * (before * x[0] + after * x[2])[windows]).sum(1)
        return (force_weight * x[1][windows]).sum(1) - springs - pushes[1]

    return _Means(
        t=(w * local).sum(1),
        force=force(measured),
        model=force(simulated),
        inputs=pushes,
        position=np.array([(w * x[windows]).sum(1) for x in measured]),
        velocity=np.array([-(w1 * x[windows]).sum(1) for x in measured]),
        noise=noise * float(np.sqrt(np.median((force_weight**2).sum(1)))),
    )
