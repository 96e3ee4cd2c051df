"""Describe a turn of an exploration: what is known and what is in doubt."""

import numpy as np

from pipeline.gap.limits import NOTHING
from pipeline.gap.types import Gap
from pipeline.plant.effect import AugmentedChain
from pipeline.report.exploration.diary import WeighedExplanation
from pipeline.report.gap.verdict import effect_name
from pipeline.results import Analysis
from pipeline.words.numbers import abridge
from pipeline.words.phrases import phrases

WORDS = phrases("exploration")


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
    named = abridge([effect_name(found.effect, found.where) for found in gap.effects])
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
