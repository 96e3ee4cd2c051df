"""What the student's own recordings say each parameter is, and what an honest reading may give."""

from dataclasses import dataclass

from pipeline.grading.rubric import is_damping
from pipeline.results import Analysis, Estimate, ParameterRow
from pipeline.stages.compare import CHI_SQUARE_LIMIT


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A recomputed parameter.

    Attributes
    ----------
    value : the estimate that is shown; `source` says where it comes from.
    low, high : an honest reading of these recordings may lie anywhere between.
    std : standard error of the bounds.
    """

    value: float
    low: float
    high: float
    std: float
    source: str

    def times(self, factor: float) -> "Reference":
        """Return the reference multiplied by a positive factor."""
        return Reference(
            value=factor * self.value,
            low=factor * self.low,
            high=factor * self.high,
            std=factor * self.std,
            source=self.source,
        )


@dataclass(frozen=True, kw_only=True)
class References:
    """Both tables, by parameter name; what could not be recomputed, or is a guess, is not there."""

    initial: dict[str, Reference]
    final: dict[str, Reference]


def recompute(analysis: Analysis) -> References:
    """Return the references of both tables.

    Where a cart sticks, dry friction adds to every damping ratio, the more the smaller the
    motion; a student who took it out is right too, so the lower bound is without it. An initial
    estimate is right anywhere between the recomputed initial and final ones; where the linear
    carts do not explain the data, so is a final one, as then the fit itself may be off.
    """
    final = {row.name: _final(row.final, row, analysis) for row in analysis.rows if row.final}
    initial = {}
    for row in analysis.rows:
        reference = _initial(row, final.get(row.name), analysis)
        if reference is not None:
            initial[row.name] = reference
    return References(initial=initial, final=final)


def friction_share(analysis: Analysis) -> float:
    """Return the least share of a decay's apparent damping that is viscous; 1 without friction."""
    shares = [
        d.friction.zeta / d.zeta
        for d in analysis.log_decrements
        if d.friction is not None and d.friction.present and d.zeta > 0
    ]
    return min([max(share, 0.0) for share in shares], default=1.0)


def _final(estimate: Estimate, row: ParameterRow, analysis: Analysis) -> Reference:
    # A dwell moves less than a decay and sees about twice the friction: the share twice.
    share = friction_share(analysis) ** 2 if is_damping(row.name) else 1.0
    bounds = [estimate.value, estimate.value * (share if estimate.value > 0 else 1.0)]
    explained = analysis.fit is None or analysis.fit.chi_square_per_dof <= CHI_SQUARE_LIMIT
    if row.initial is not None and row.initial.source != "assumed" and not explained:
        bounds.append(row.initial.value)
    return Reference(
        value=estimate.value,
        low=min(bounds),
        high=max(bounds),
        std=estimate.std or 0.0,
        source=estimate.source,
    )


def _initial(row: ParameterRow, final: Reference | None, analysis: Analysis) -> Reference | None:
    measured = row.initial
    if measured is not None and measured.source == "assumed":
        return None
    if measured is None:
        return final
    bounds = [measured.value, *_spread(row.name, analysis)]
    if final is not None:
        bounds += [final.low, final.high]
    return Reference(
        value=measured.value,
        low=min(bounds),
        high=max(bounds),
        std=measured.std or 0.0,
        source=measured.source,
    )


def _spread(name: str, analysis: Analysis) -> list[float]:
    """Return the single readings of a gain: a student may well quote one of them."""
    if not name.startswith("K"):
        return []
    cart = 1 if name == "K" else int(name.removeprefix("K_"))
    readings: list[float] = []
    for step in analysis.step_gains:
        if step.cart == cart:
            readings += [step.gain, *(step.interval or ())]
    return readings
