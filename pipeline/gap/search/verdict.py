"""The verdict on a search: how much is explained, and how certainly."""

from collections.abc import Sequence

from pipeline.gap import limits
from pipeline.gap.search.hypothesis import Hypothesis, Study, evidence, lowers_error
from pipeline.gap.search.prune import steps_to
from pipeline.gap.types import Verdict
from pipeline.plant.catalogue import find_effect


def reach_verdict(
    steps: tuple[Hypothesis, ...], found: Sequence[Hypothesis], *, study: Study, sample_time: float
) -> tuple[Verdict, tuple[Hypothesis, ...], list[Hypothesis]]:
    """Return the verdict, the accepted steps, and the rivals if the verdict is `ambiguous`.

    `steps` lead from the linear model to the chosen one; `found` are all hypotheses judged. If a
    large error remains, two more rules apply. An effect is dropped if a hypothesis without it does
    about as well. Otherwise the last step is withdrawn if rivals dispute its effect.
    """
    baseline, chosen = steps[0], steps[-1]
    if not chosen.key:
        return ("none" if study.is_noise(chosen) else "unexplained"), steps, []
    explained = study.explains(chosen)
    gain = baseline.bic - chosen.bic
    close = [
        rival
        for rival in found
        if len(rival.key) == len(chosen.key)
        and rival.key != chosen.key
        and rival.error < limits.CLOSE_ERROR * chosen.error
        and evidence(chosen, rival) < min(limits.CLOSE_GAIN * gain, limits.CLOSE_BIC)
        and not _same_thing(rival, chosen, sample_time=sample_time)
        and (explained or not _same_kind(rival, chosen))
    ]
    if not explained:
        without = _needless(chosen, [*found, *steps], study)
        disputed = bool(close) and chosen.error > limits.MOSTLY * baseline.error
        if without is not None or disputed:
            back = steps[:-1] if without is None else steps_to(without, [*found, *steps], study)
            return reach_verdict(back, found, study=study, sample_time=sample_time)
    if close:
        return "ambiguous", steps, close
    return ("named" if explained else "partial"), steps, []


def _needless(chosen: Hypothesis, found: Sequence[Hypothesis], study: Study) -> Hypothesis | None:
    """Return the best hypothesis without one of the effects, if that effect helps too little."""
    smaller = [h for h in found if h.key < chosen.key and len(h.key) == len(chosen.key) - 1]
    as_good = [h for h in smaller if not lowers_error(chosen, h, study)]
    return min(as_good, key=lambda h: h.error, default=None)


def _stand_ins(
    rival: Hypothesis, chosen: Hypothesis
) -> list[tuple[tuple[str, int], tuple[str, int]]]:
    """Return the chosen effects that the rival lacks, each with the rival's substitute."""
    mine = sorted(chosen.key - rival.key, key=_place)
    other = sorted(rival.key - chosen.key, key=_place)
    return list(zip(mine, other, strict=True))


def _place(key: tuple[str, int]) -> tuple[int, str]:
    return key[1], key[0]


def _same_kind(rival: Hypothesis, chosen: Hypothesis) -> bool:
    """Return whether the rival differs only by laws of the same families at the same places."""
    return all(
        mine[1] == other[1] and find_effect(mine[0]).family == find_effect(other[0]).family != ""
        for mine, other in _stand_ins(rival, chosen)
    )


def _same_thing(rival: Hypothesis, chosen: Hypothesis, *, sample_time: float) -> bool:
    """Return whether a rival is a richer form of the same laws, or provably indistinguishable."""
    return all(
        _same_law(mine, other, chosen, sample_time=sample_time)
        for mine, other in _stand_ins(rival, chosen)
    )


def _same_law(
    mine: tuple[str, int], other: tuple[str, int], chosen: Hypothesis, *, sample_time: float
) -> bool:
    effect = find_effect(mine[0])
    if find_effect(other[0]).grows_from == mine[0] and other[1] == mine[1]:
        return True
    if effect.same_as != other[0]:
        return False
    places = [candidate.key for candidate in chosen.fit.structure.effects]
    term = chosen.fit.terms[places.index(mine)]
    return abs(term.values[0]) < effect.same_below * sample_time
