"""Simulate one run with effects, from rest or from its first readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.hardware_check import measured_run
from pipeline.gap.fit import evaluate, fit_nuisance
from pipeline.gap.parameters import (
    FRICTION_SPREAD,
    Candidate,
    Structure,
    fresh_nuisance,
    simulate_run,
)
from pipeline.gap.runs import GapRun
from pipeline.plant.augmented import rest_positions, simulate_augmented
from pipeline.plant.effect import AugmentedChain
from pipeline.results import HardwareCheck, Record


@dataclass(frozen=True, kw_only=True, eq=False)
class Replay:
    """One cart under the measured input, according to both models: linear, and with effects.

    `rest` is the cart's rest position, from which its motion is measured.
    """

    check: HardwareCheck
    model: Array
    nrmse: float
    rest: float


def replay_driven(
    record: Record, checks: Sequence[HardwareCheck], model: AugmentedChain
) -> list[Replay]:
    """Simulate a run with the measured input; return [] if it diverges or has no input.

    Parameters
    ----------
    checks : the linear model's result under the same input, one for each cart.
    """
    if record.u is None:
        return []
    run = measured_run(record, model.chain)
    rows = [cart - 1 for cart in run.free]
    try:
        rest = rest_positions(model, free=run.free)
        x0 = rest.copy()
        x0[rows] += run.x0[::2]
        factors = {1.0, *(c.input_scale for c in checks if c.input_scale is not None)}
        found = [
            run.rest[:, None] + (y - rest[:, None])[rows]
            for factor in sorted(factors, key=lambda factor: factor != 1.0)
            if factor == 1.0 or not 1 / 1.5 <= factor <= 1.5  # within 1.5, the model is wrong
            for y in [simulate_augmented(model, record.t, factor * record.u, free=run.free, x0=x0)]
        ]
    except DataError:
        return []
    as_logged, *others = found
    best = min(others, key=run.misfit, default=as_logged)
    # A factor on the logged input is accepted if it reduces the error to 0.6 or less.
    chosen = best if run.misfit(best) < 0.6 * run.misfit(as_logged) else as_logged
    replays = []
    for check in checks:
        row = run.free.index(check.cart)
        motion = check.measured - run.rest[row]
        error = float(np.sqrt(np.sum((check.measured - chosen[row]) ** 2) / np.sum(motion**2)))
        rest_of_cart = float(run.rest[row])
        replays.append(Replay(check=check, model=chosen[row], nrmse=error, rest=rest_of_cart))
    return replays


def replay_fitted(run: GapRun, model: AugmentedChain, *, springs: tuple[bool, ...]) -> Array:
    """Return the simulated readings (rows, samples) of a run, with start and zeros fitted.

    Raises
    ------
    DataError : the simulation diverges.
    """
    structure = Structure(
        springs=springs,
        effects=tuple(
            Candidate(
                effect=term.effect,
                place=term.place,
                signs=tuple(-1.0 if value < 0 else 1.0 for value in term.values),
                scales=tuple(abs(value) or 1.0 for value in term.values),
            )
            for term in model.terms
        ),
    )
    start = structure.start(model.chain, [term.values for term in model.terms])
    spread = np.full(structure.n, FRICTION_SPREAD)
    known = evaluate(start, [run], [fresh_nuisance(run)], spread=spread)
    fit = fit_nuisance(known, [run])
    readings = simulate_run(fit, run, fit.nuisance[0])
    if not np.all(np.isfinite(readings)):
        raise DataError(f"{run.id}: the carts diverge")
    return readings
