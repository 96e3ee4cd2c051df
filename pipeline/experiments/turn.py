"""Describe a turn of an exploration: what is known and what is in doubt."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from pipeline.gap.limits import NOTHING
from pipeline.gap.types import Gap, Trace
from pipeline.plant.effect import AugmentedChain, effect_name
from pipeline.results import Analysis
from pipeline.words.numbers import join_names
from pipeline.words.phrases import phrases

WORDS = phrases("exploration")


@dataclass(frozen=True, kw_only=True)
class WeighedExplanation:
    """One explanation of the gap: its effects in words, and its weight among all explanations."""

    name: str
    weight: float


@dataclass(frozen=True, kw_only=True)
class Turn:
    """What was known after one turn of an exploration.

    Attributes
    ----------
    seconds : time at the bench up to the end of this turn, including rests.
    recorded : ids of the recordings made in this turn.
    errors : relative standard error of each parameter, by name; None if unknown.
    verdict : verdict of the gap analysis; "" if the analysis was not possible.
    explanations : the competing explanations, the one in the model first. If none compete, only the
        named explanation; empty if the linear chain is enough.
    left : the model's error as a share of the motion; None if unknown.
    floor : the noise floor as a share of the motion; None if unknown.
    reached : whether all requested parameters are known and the gap is named or absent.
    summary : results, doubts and the reason for the next recording, as sentences.
    gap : the gap analysis of this turn; None if it was not possible. For an earlier turn, it keeps
        only the trace that the diary shows.
    """

    seconds: float
    recorded: tuple[str, ...]
    errors: dict[str, float | None]
    verdict: str
    explanations: tuple[WeighedExplanation, ...]
    left: float | None
    floor: float | None
    reached: bool
    summary: str
    gap: Gap | None = None

    def without_other_traces(self) -> "Turn":
        """Return the turn without the traces that the diary does not show.

        Each gap analysis has the traces of all runs so far. If they were all kept, memory use would
        grow with the square of the number of turns.
        """
        if self.gap is None:
            return self
        shown = deciding_trace(self.gap, self.recorded)
        kept = replace(self.gap, traces=(shown,) if shown else (), measure_left=tuple)
        return replace(self, gap=kept)


def deciding_trace(gap: Gap, recorded: Collection[str]) -> Trace | None:
    """Return the trace that the linear model describes worst, from the `recorded` runs.

    If the gap has no traces of these runs, all traces are considered. Returns None if it has no
    traces at all.
    """

    def size(trace: Trace) -> float:
        of_trace = (trace.experiment, trace.cart, trace.held_out)
        rows = (r for r in gap.by_record if (r.experiment, r.cart, r.held_out) == of_trace)
        return next((row.baseline for row in rows), 0.0)

    new = [trace for trace in gap.traces if trace.experiment in recorded]
    return max(new or gap.traces, key=size, default=None)


def relative_errors(analysis: Analysis) -> dict[str, float | None]:
    """Return the relative standard error of each parameter."""
    assert analysis.fit is not None
    return {
        name: None if e.std is None or not e.value else float(e.std / abs(e.value))
        for name, e in analysis.fit.parameters.items()
    }


def describe_accuracy(missing: dict[str, float], errors: dict[str, float | None]) -> str:
    """Say how well the parameters are known."""
    if not missing:
        worst = max((error for error in errors.values() if error is not None), default=0.0)
        return WORDS.text("all_known", error=f"{100 * worst:.2g} %")
    name = max(missing, key=lambda one: missing[one])
    if not np.isfinite(missing[name]):
        return WORDS.text("not_known", name=name)
    return WORDS.text("known_to", name=name, error=f"{100 * missing[name]:.2g} %")


def describe_doubt(gap: Gap) -> str:
    """Describe the effects found, or the explanations that are still in dispute."""
    named = join_names([effect_name(found.effect, found.where) for found in gap.effects])
    times = "a gap"
    if gap.noise_floor:
        times = WORDS.text("times_noise", times=f"{gap.final / gap.noise_floor:.2g}")
    match gap.verdict:
        case "none":
            return WORDS.text("linear")
        case "named":
            return WORDS.text("named", named=named)
        case "partial":
            return WORDS.text("part_named", named=named, times=times)
        case "ambiguous":
            rivals = " or ".join(one.name for one in list_explanations(gap)[:2])
            return WORDS.text("disputed", rivals=rivals)
    if gap.final < NOTHING * gap.noise_floor:
        return WORDS.text("only_fitted")
    return WORDS.text("no_name", times=times)


def list_explanations(gap: Gap) -> tuple[WeighedExplanation, ...]:
    """Return the models that may be true, the chosen one first; it is alone if the gap is named."""
    contenders = [(one, one.weight) for one in gap.contenders]
    if gap.verdict == "named":
        contenders = [(gap.model, 1.0)]
    return tuple(
        WeighedExplanation(name=name_model(model), weight=weight) for model, weight in contenders
    )


def name_model(model: AugmentedChain) -> str:
    """Return the effects of a model in words, by name and place."""
    names = [effect_name(term.effect, term.where) for term in model.terms]
    return " and ".join(names) or "the linear chain"
