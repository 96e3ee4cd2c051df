"""The verdict on a search: how much is explained, how surely, and what would settle it."""

from collections.abc import Sequence

from pipeline.gap import limits
from pipeline.gap.search.hypothesis import Hypothesis, Study, evidence, lowers_error
from pipeline.gap.search.search import steps_to
from pipeline.gap.types import GapWindow, Verdict
from pipeline.plant.nonlinear.effects import find_effect

_REPEAT = "Repeat each run, so that what differs from run to run is known."
# What shows more of what is left, by what the cart does there.
_SHOWS = {
    "velocity near zero": "Small free decays, and a slow ramp of the input: what holds a cart "
    "near its rest shows there.",
    "fast motion": "Free decays of one cart at a time from two release heights: what is in "
    "the carts shows there, what is in the drive does not.",
    "large displacement, positive side": "Static steps of both signs and several sizes: a "
    "spring or a stop that changes with the position bends the line of level against input.",
    "after an edge of the input": "Steps of several sizes at the highest sampling rate: what "
    "is late, lost or soft in the drive shows at their edges.",
    "input on": "Steps of several sizes and both signs, and the same swing released by hand: "
    "what only the driven cart does is in the drive.",
}
_SHOWS["large displacement, negative side"] = _SHOWS["large displacement, positive side"]
_SHOWS["input off"] = _SHOWS["fast motion"]


def reach_verdict(
    steps: tuple[Hypothesis, ...], found: Sequence[Hypothesis], *, study: Study, sample_time: float
) -> tuple[Verdict, tuple[Hypothesis, ...], list[Hypothesis]]:
    """Return the verdict, the steps that stand, and under `ambiguous` the rivals.

    `steps` lead from the linear model to the one chosen; `found` are all hypotheses judged. Where
    much is left, a step that another could stand in for is taken back, and so is every effect
    without which a hypothesis does about as well.
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
    """Return the best hypothesis without one of the effects, if that effect does not pay."""
    smaller = [h for h in found if h.key < chosen.key and len(h.key) == len(chosen.key) - 1]
    as_good = [h for h in smaller if not lowers_error(chosen, h, study)]
    return min(as_good, key=lambda h: h.error, default=None)


def _stand_ins(
    rival: Hypothesis, chosen: Hypothesis
) -> list[tuple[tuple[str, int], tuple[str, int]]]:
    """Return the effects of the chosen that the rival lacks, each with what it has instead."""
    mine = sorted(chosen.key - rival.key, key=_place)
    other = sorted(rival.key - chosen.key, key=_place)
    return list(zip(mine, other, strict=True))


def _place(key: tuple[str, int]) -> tuple[int, str]:
    return key[1], key[0]


def _same_kind(rival: Hypothesis, chosen: Hypothesis) -> bool:
    """Are the laws of one family at the same places, dry friction on one cart, say?"""
    return all(
        mine[1] == other[1] and find_effect(mine[0]).family == find_effect(other[0]).family != ""
        for mine, other in _stand_ins(rival, chosen)
    )


def _same_thing(rival: Hypothesis, chosen: Hypothesis, *, sample_time: float) -> bool:
    """Is a rival a richer form of the same laws, or one the data provably cannot tell from it?"""
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


def choose_experiment(
    verdict: Verdict,
    chosen: Hypothesis,
    close: Sequence[Hypothesis],
    left: Sequence[GapWindow],
    *,
    repeated: bool,
) -> str:
    """Return what to record next: what tells the rivals apart, settles the name, or shows more.

    `left` are the windows in which the chosen model still departs, the worst first; `repeated`:
    runs of one input tell already by how much they differ.
    """
    if verdict == "ambiguous":
        texts = {find_effect(key).deciding_run for key, _ in chosen.key ^ close[0].key}
        return " ".join(sorted(texts))
    if verdict == "named":
        return chosen.fit.structure.effects[-1].effect.deciding_run
    if verdict == "none":
        return ""
    phase = next((_SHOWS[w.what] for w in left if w.what in _SHOWS), "")
    shows = phase or _SHOWS["fast motion"]
    return shows if repeated else f"{_REPEAT} {shows}"
