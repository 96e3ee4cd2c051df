"""The force on each cart that a model does not explain: over time, as a map, as a formula."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.polynomial import chebyshev

from pipeline.arrays import Array
from pipeline.estimation.force_balance import Windows, required_force
from pipeline.estimation.noise import high_frequency_noise
from pipeline.gap.limits import BIC_DROP
from pipeline.gap.parameters import GapModel, Nuisance, fresh_nuisance, simulate_run
from pipeline.gap.runs import GapRun, cut_shots
from pipeline.gap.types import (
    ForceAgainst,
    ForceFormula,
    FormulaTerm,
    Gap,
    Quantity,
    Residual,
    Trace,
    WindowedResidualForce,
)
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.simulator.generated_forces import shaped_input
from pipeline.setup import Setup

# ------------------------------------------------------- the force over time, without simulation
#
# The second derivative of measured positions is too noisy to use. Modulating functions instead give
# the exact mean of the force over a short window, and the means of velocity, position and input.


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
    t, n = trace.t, model.chain.n
    # Rows are the carts and, on either side, a wall.
    measured, simulated = np.zeros((2, n + 2, t.size))
    for number, one in carts.items():
        measured[number], simulated[number] = one.measured - one.zero, one.final - one.zero
    u = trace.u if cart == 1 else np.zeros(t.size)
    drive = model.tables().drive  # its delays and lags are ignored
    inputs = np.array([u, [shaped_input(drive, float(one)) for one in u]])
    noise = high_frequency_noise(trace.measured - trace.final)
    best = None
    # Lengths of the windows in s; the middle half has most of the weight.
    for length in (0.05, 0.07, 0.1, 0.15, 0.2, 0.3):
        width = round(length * (t.size - 1) / float(t[-1] - t[0])) + 1
        if not 9 <= width <= t.size:
            continue
        last = t.size - width
        windows = Windows(
            t, first=np.linspace(0, last, min(last + 1, 400)).astype(int), width=width
        )
        logged, shaped = windows.held_mean(inputs)
        seen, followed = windows.means(measured), windows.means(simulated)
        force = [
            required_force(model.chain, m[:, 1:-1])[cart - 1] - shaped for m in (seen, followed)
        ]
        (before, position, after), (v_before, velocity, v_after) = seen[:2, cart - 1 : cart + 2]
        best = ResidualForce(
            experiment=trace.experiment,
            cart=cart,
            held_out=trace.held_out,
            t=windows.mean(t),
            measured=force[0],
            model=force[1],
            u=logged,
            shaped_input=shaped,
            velocity=velocity,
            position=position,
            neighbours=np.array([before, after]),
            neighbours_velocity=np.array([v_before, v_after]),
        )
        # The noise must be less than a fiftieth of the force's range.
        if noise * windows.gain(model.chain, cart) <= 0.02 * np.ptp(best.measured):
            break
    return best


# ----------------------------------------------------- the force by position, velocity and input
#
# The model is restarted from the measurement again and again, and runs freely over a short stretch.
# In the later part of each stretch, the curvature of its error shows the missing force. Modulating
# functions average this force and suppress the effects of the start and of noise.

_DEGREE = 4  # degree of the polynomial through the model's error in a window


def windowed_residual_forces(
    model: GapModel, runs: Sequence[GapRun], nuisance: Sequence[Nuisance]
) -> tuple[WindowedResidualForce, ...]:
    """Return the unexplained force on each cart of each run, if its neighbours were measured."""
    found = []
    for run, own in zip(runs, nuisance, strict=True):
        best: list[WindowedResidualForce] = []
        # Lengths of the windows in s, for a bench of carts. The shortest with little noise is used.
        for length in (0.05, 0.07, 0.1, 0.15, 0.2):
            forces = _of_run(model, run, own, length=length * run.pace)
            best = [force for force, _ in forces] or best
            # The noise must be less than 0.3 of the force.
            if forces and all(noise < 0.3 * _rms(force.force) for force, noise in forces):
                break
        found += best
    return tuple(found)


def _of_run(
    model: GapModel, run: GapRun, own: Nuisance, *, length: float
) -> list[tuple[WindowedResidualForce, float]]:
    """Return the unexplained force on each cart in windows of `length` s, each with its noise."""
    width = round(length / run.record.sample_time) + 1
    if not 9 <= width <= run.t.size // 3:
        return []
    # A stretch is half a window longer, so that hidden states (a lag, a bent bristle) settle first.
    cut = cut_shots(run, length=(1.0 + 0.5) * length / run.pace)
    cut = replace(cut, zero=np.where(run.free, own.zero, 0.0))
    read = simulate_run(model, cut, replace(fresh_nuisance(cut), scatter=own.scatter))
    first = np.array([end - width for start, end in pairwise(cut.shots) if end - start >= width])
    windows = Windows(cut.t, first=first, width=width)
    t, weight = windows.cut(cut.t), np.broadcast_to(windows.weights[0], (first.size, width))
    n, chain = run.zero.size, model.structure.chain(model.theta)
    x, simulated = cut.by_cart(cut.y, own.zero), cut.by_cart(read, own.zero)
    speed = np.gradient(simulated, cut.t, axis=1)
    # A restart is a jump, so the speed at both ends of a stretch is computed from points inside it.
    bounds = np.array(cut.shots)
    for here, ahead in ((bounds[:-1], bounds[:-1] + 1), (bounds[1:] - 1, bounds[1:] - 2)):
        step = simulated[:, ahead] - simulated[:, here]
        speed[:, here] = step / (cut.t[ahead] - cut.t[here])
    off = x - simulated
    forces, accelerations = required_force(chain, windows.means(off)), windows.means(x)[2]
    out = []
    for j, i in enumerate(run.rows):
        around = {i - 1, i + 1} & {k for k in range(n) if run.free[k]}
        if not run.free[i] or not around <= set(run.rows):
            continue
        # A cart whose motion is within four times the noise is at rest; friction could then balance
        # any force.
        moves = np.ptp(windows.cut(x[i]), axis=1) > 4.0 * run.sigma[j]
        if not moves.any():
            continue
        error = windows.cut(off[i])
        drift, rate = _smooth(t, error)
        noise = float(np.median(np.std(error - drift, axis=1)))
        left = WindowedResidualForce(
            experiment=run.id,
            cart=i + 1,
            weight=weight[moves],
            t=t[moves],
            x=(windows.cut(simulated[i]) + drift)[moves],
            v=(windows.cut(speed[i]) + rate)[moves],
            u=windows.cut(run.input if i == 0 else 0.0 * run.t)[moves],
            acceleration=accelerations[i][moves],
            force=forces[i][moves],
        )
        out.append((left, noise * windows.gain(chain, i + 1)))
    return out


def _smooth(t: Array, values: Array) -> tuple[Array, Array]:
    """Fit a polynomial to each row of values (windows, samples); return it and its derivative."""
    span = t[:, -1:] - t[:, :1]
    # The samples are evenly spaced, or nearly so, and all windows share one basis.
    s = np.linspace(-1.0, 1.0, t.shape[1])
    basis = chebyshev.chebvander(s, _DEGREE)
    coefficients = np.linalg.lstsq(basis, values.T, rcond=None)[0]
    rate = chebyshev.chebvander(s, _DEGREE - 1) @ chebyshev.chebder(coefficients)
    return (basis @ coefficients).T, rate.T * 2.0 / span


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


# ---------------------------------------------------------------------- the shortest formula
#
# The force is known as a mean over windows, and so is each term of a library. Masses, dampings,
# springs and encoder zeros were fitted without the missing law, so they are fitted again together
# with the terms. The formula is the sum of the few terms with the best criterion, if this is better
# than the criterion without a term.
#
# References: S. L. Brunton, J. L. Proctor, J. N. Kutz, PNAS 113 (2016), 3932-3937 (sparse
# regression for laws of motion); D. A. Messenger, D. M. Bortz, J. Computational Physics 443 (2021),
# 110525 (in weak form).


@dataclass(frozen=True)
class _Term:
    """A candidate term of the formula; the powers of x, v and u give its unit."""

    name: str
    law: Callable[[Array, Array, Array], Array]
    x: float = 0.0
    v: float = 0.0
    u: float = 0.0

    def unit(self, *, position: str, drive: str) -> str:
        """Return the unit of the coefficient."""
        above = [_power(drive, 1.0 - self.u), _power("s", self.v)]
        below = _power(position, self.x + self.v)
        text = " ".join(part for part in above if part) or "1"
        return f"{text}/{below}" if below else text


def _power(unit: str, power: float) -> str:
    if power == 0.0:
        return ""
    return unit if power == 1.0 else f"{unit}^{power:g}"


LIBRARY = (
    _Term("1", lambda x, v, u: np.ones_like(x)),
    _Term("x^2", lambda x, v, u: x**2, x=2),
    _Term("x|x|", lambda x, v, u: x * np.abs(x), x=2),
    _Term("x^3", lambda x, v, u: x**3, x=3),
    _Term("sign v", lambda x, v, u: np.sign(v)),
    _Term("sqrt|v| sign v", lambda x, v, u: np.sqrt(np.abs(v)) * np.sign(v), v=0.5),
    _Term("v|v|", lambda x, v, u: v * np.abs(v), v=2),
    _Term("v^3", lambda x, v, u: v**3, v=3),
    _Term("|v|", lambda x, v, u: np.abs(v), v=1),
    _Term("x v", lambda x, v, u: x * v, x=1, v=1),
    _Term("x^2 v", lambda x, v, u: x**2 * v, x=2, v=1),
    _Term("x sign v", lambda x, v, u: x * np.sign(v), x=1),
    _Term("|x| sign v", lambda x, v, u: np.abs(x) * np.sign(v), x=1),
    _Term("|u|", lambda x, v, u: np.abs(u), u=1),
    _Term("|u| sign v", lambda x, v, u: np.abs(u) * np.sign(v), u=1),
    _Term("u x", lambda x, v, u: u * x, x=1, u=1),
    _Term("u|u|", lambda x, v, u: u * np.abs(u), u=2),
    _Term("u v", lambda x, v, u: u * v, v=1, u=1),
)  # fmt: skip


def find_formula(
    forces: Sequence[WindowedResidualForce], *, on_springs: bool, position: str, drive: str
) -> tuple[ForceFormula | None, Array]:
    """Return the formula for the force on one cart, and its value in every window (n,).

    Without a formula the values are zero. `on_springs` is true if the carts have springs. A wrong
    encoder zero then looks like a constant force in its run, so each run gets a constant.
    """
    force = np.concatenate([one.force for one in forces])
    linear = np.concatenate(
        [np.stack([one.acceleration, one.mean(one.v), one.mean(one.x)], axis=1) for one in forces]
    )
    if on_springs:
        run = np.repeat(np.arange(len(forces)), [one.force.size for one in forces])
        linear = np.hstack([linear, np.eye(len(forces))[run]])
    columns = np.stack(
        [
            np.concatenate([one.mean(term.law(one.x, one.v, one.u)) for one in forces])
            for term in LIBRARY
        ],
        axis=1,
    )
    basis = np.linalg.qr(linear / np.maximum(np.linalg.norm(linear, axis=0), 1e-300))[0]
    left = force - basis @ (basis.T @ force)
    alone = columns - basis @ (basis.T @ columns)
    size = np.linalg.norm(columns, axis=0)
    # A term is usable if the other columns do not explain all of it.
    usable = [j for j in range(len(LIBRARY)) if np.linalg.norm(alone[:, j]) > 1e-8 * size[j] > 0]
    best = _criterion(left, 0), (), np.zeros(0), left
    free = force.size - linear.shape[1]
    # At least ten windows for each term, and at most three terms.
    for count in range(1, min(3, free // 10) + 1):
        for chosen in combinations(usable, count):
            A = alone[:, chosen]
            coefficients = np.linalg.lstsq(A, left, rcond=None)[0]
            rest = left - A @ coefficients
            found = _criterion(rest, count), chosen, coefficients, rest
            best = min(best, found, key=lambda one: one[0])
    _, chosen, coefficients, rest = best
    if not chosen:
        return None, np.zeros(force.size)
    A = alone[:, chosen]
    variance = float(rest @ rest) / (free - len(chosen)) * np.diag(np.linalg.inv(A.T @ A))
    formula = ForceFormula(
        terms=tuple(
            FormulaTerm(
                term=LIBRARY[j].name,
                coefficient=float(coefficient),
                std=float(np.sqrt(square)),
                unit=LIBRARY[j].unit(position=position, drive=drive),
            )
            for j, coefficient, square in zip(chosen, coefficients, variance, strict=True)
        ),
        explains=1.0 - float(rest @ rest) / float(left @ left),
    )
    return formula, np.asarray(force - rest, dtype=np.float64)


def _criterion(rest: Array, terms: int) -> float:
    """Return the Bayesian criterion, with an extra penalty because many terms are tried."""
    count = rest.size
    cost = count * float(np.log(max(float(rest @ rest), 1e-300) / count))
    return cost + terms * (float(np.log(count)) + BIC_DROP)


# ---------------------------------------------------------------------- the map with its formula


def map_residual(forces: Sequence[WindowedResidualForce], bench: Setup) -> tuple[Residual, ...]:
    """Return the unexplained force on each cart, in the order of the carts."""
    found, position, drive = [], bench.units.position, bench.units.input
    for cart in sorted({force.cart for force in forces}):
        own = [force for force in forces if force.cart == cart]
        on_springs = bench.springs[cart - 1] or bench.springs[cart]
        formula, said = find_formula(own, on_springs=on_springs, position=position, drive=drive)
        axes: dict[Quantity, tuple[str, list[Array]]] = {
            "position": (position, [force.mean(force.x) for force in own]),
            "velocity": (f"{position}/s", [force.mean(force.v) for force in own]),
            "input": (drive, [force.mean(force.u) for force in own]),
        }
        against = tuple(
            _binned(own, values, said if formula else None, quantity=quantity, unit=unit)
            for quantity, (unit, values) in axes.items()
            if np.ptp(np.concatenate(values)) > 0.0
        )
        found.append(Residual(cart=cart, unit=drive, against=against, formula=formula))
    return tuple(found)


def _binned(
    forces: Sequence[WindowedResidualForce],
    values: Sequence[Array],
    said: Array | None,
    *,
    quantity: Quantity,
    unit: str,
) -> ForceAgainst:
    x, y = np.concatenate(values), np.concatenate([one.force for one in forces])
    run = np.repeat(np.arange(len(forces)), [one.force.size for one in forces])
    # At least six windows in a bin.
    count = int(np.clip(x.size // 6, 1, 20))
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, count + 1)))
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(edges.size - 2, 0))
    kept = [bins == b for b in np.unique(bins)]
    spread: list[float | None] = []
    for inside in kept:
        means = [float(y[inside & (run == r)].mean()) for r in np.unique(run[inside])]
        spread.append(float(np.std(means, ddof=1)) if len(means) > 1 else None)
    return ForceAgainst(
        quantity=quantity,
        unit=unit,
        at=tuple(float(x[inside].mean()) for inside in kept),
        force=tuple(float(y[inside].mean()) for inside in kept),
        spread=tuple(spread),
        formula=None if said is None else tuple(float(said[inside].mean()) for inside in kept),
    )
