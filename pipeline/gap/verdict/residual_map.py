"""The unexplained force on each cart against position, velocity and input, with its formula."""

from collections.abc import Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.types import ForceAgainst, Quantity, Residual, WindowedResidualForce
from pipeline.gap.verdict.formula import find_formula
from pipeline.setup import Setup


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
