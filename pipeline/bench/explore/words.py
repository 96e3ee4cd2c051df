"""A turn of an exploration in words: what is known, what is in doubt, and between what."""

import numpy as np

from pipeline.gap.limits import NOTHING
from pipeline.gap.types import Gap
from pipeline.names import listed
from pipeline.plant.nonlinear.effects.base import AugmentedChain
from pipeline.report.exploration.turn import Explanation
from pipeline.report.gap.words import effect_name
from pipeline.results import Analysis


def relative_errors(analysis: Analysis) -> dict[str, float | None]:
    """Return the relative standard error of each parameter."""
    assert analysis.fit is not None
    return {
        name: None if e.std is None or not e.value else float(e.std / abs(e.value))
        for name, e in analysis.fit.parameters.items()
    }


def known_words(missing: dict[str, float], errors: dict[str, float | None]) -> str:
    """Say how well the parameters are known."""
    if not missing:
        worst = max((error for error in errors.values() if error is not None), default=0.0)
        return f"every parameter asked for is known, the worst of all to ± {100 * worst:.2g} %"
    name = max(missing, key=lambda one: missing[one])
    if not np.isfinite(missing[name]):
        return f"{name} is not known at all"
    return f"{name} is known to ± {100 * missing[name]:.2g} % only"


def doubt_words(gap: Gap) -> str:
    """Say what acts beside the linear carts, or between which explanations that is open."""
    named = listed([effect_name(found.effect, found.where) for found in gap.effects])
    times = f"{gap.final / gap.noise_floor:.2g} times the noise" if gap.noise_floor else "a gap"
    match gap.verdict:
        case "none":
            return "the linear carts explain the motion down to the noise"
        case "named":
            return f"what else acts has a name: {named}"
        case "partial":
            return f"{named} is only part of the gap, {times} is left"
        case "ambiguous":
            rivals = " or ".join(one.name for one in explanations(gap)[:2])
            return f"it may be {rivals}"
    if gap.final < NOTHING * gap.noise_floor:
        return "something that the runs fitted show, and the others do not, has no name"
    return f"{times} is left and has no name"


def explanations(gap: Gap) -> tuple[Explanation, ...]:
    """Return the models that may be true, the chosen first; of a named gap the one."""
    contenders = [(one.model, one.weight) for one in gap.contenders]
    if gap.verdict == "named":
        contenders = [(gap.model, 1.0)]
    return tuple(
        Explanation(name=model_words(model), weight=weight) for model, weight in contenders
    )


def model_words(model: AugmentedChain) -> str:
    """Return the effects of a model by name and place."""
    names = [effect_name(term.effect, term.where) for term in model.terms]
    return " and ".join(names) or "the linear chain"


def lost_words(name: str, *, vetoed: bool, why: str) -> str:
    """Say that a recording was chosen and is not there."""
    if vetoed:
        return f"{name} was vetoed"
    return f"{name} did not come off" + (f" ({why})" if why else "")
