"""The verdict on a search: named, none, ambiguous, or unexplained, and what would settle it."""

from collections.abc import Sequence

import numpy as np

from pipeline.gap.hypothesis import THINNING, Bench, Hypothesis
from pipeline.gap.linearise import simulate_run
from pipeline.gap.types import Verdict
from pipeline.plant.effects import find_effect

_CLOSE_ERROR, _CLOSE_GAIN, _CLOSE_BIC = 1.15, 0.10, 40.0
_REFUSED_SHARE, REFUSED_FLOOR = 0.5, 1.5
_NOTHING = 1.05  # times the noise: too little to speak of
AS_REPEATS = 1.1  # an error below this many times what repeats differ by is theirs
_DECISIVE_SHARE, _DECISIVE_RIVAL = 0.8, 1.2


def reach_verdict(
    chosen: Hypothesis,
    baseline: Hypothesis,
    found: Sequence[Hypothesis],
    *,
    bench: Bench,
    floor: float,
    sample_time: float,
) -> tuple[Verdict, list[Hypothesis]]:
    """Return the verdict, and under `ambiguous` the rivals that explain as much.

    `found` are all hypotheses judged; `floor` the relative error of noise alone.
    """
    if not chosen.key:
        least = max(_NOTHING * floor, AS_REPEATS * bench.repeatability)
        nothing = baseline.at_floor or baseline.error < least
        return ("none" if nothing else "unexplained"), []
    refused = chosen.error > _REFUSED_SHARE * baseline.error
    refused &= chosen.error > REFUSED_FLOOR * floor
    if refused and not _decisive(chosen, baseline, found):
        return "unexplained", []
    gain = baseline.bic - chosen.bic
    close = [
        rival
        for rival in found
        if len(rival.key) == len(chosen.key)
        and len(rival.key - chosen.key) == 1
        and rival.error < _CLOSE_ERROR * chosen.error
        and _evidence(chosen, rival, bench) < min(_CLOSE_GAIN * gain, _CLOSE_BIC)
        and not _same_thing(rival, chosen, sample_time=sample_time)
    ]
    return ("ambiguous" if close else "named"), close


def _evidence(chosen: Hypothesis, rival: Hypothesis, bench: Bench) -> float:
    """Return by how much the chosen is the likelier, in units of the criterion.

    What a model leaves that is not noise swings with the carts: far fewer of its points are
    independent than the criterion counts, and much of the difference may be chance.
    """
    difference = rival.bic - chosen.bic
    if chosen.fit.chi < REFUSED_FLOOR**2:
        return difference
    counted = chosen.fit.n_points / THINNING
    return difference * min(1.0, _independent_points(chosen, bench) / counted)


def _independent_points(hypothesis: Hypothesis, bench: Bench) -> float:
    """Return how many residuals would tell as much, were they independent.

    Reference: M. S. Bartlett, Journal of the Royal Statistical Society 98 (1935), 536-543: a
    mean square of n correlated points is as sure as one of n / (1 + 2 Σ ρ²).
    """
    total = 0.0
    fit = hypothesis.fit
    for run, own in zip(bench.training, fit.locals_, strict=True):
        model = simulate_run(fit.structure, fit.theta[None], run, own)[0]
        for row in run.y - model:
            power = np.abs(np.fft.rfft(row - row.mean(), 2 * row.size)) ** 2
            covariance = np.fft.irfft(power)[: row.size]
            correlation = covariance / max(covariance[0], 1e-300)
            total += row.size / (1.0 + 2.0 * float((correlation[1:] ** 2).sum()))
    return total


def _decisive(chosen: Hypothesis, baseline: Hypothesis, found: Sequence[Hypothesis]) -> bool:
    """Is the name beyond doubt although much of the gap remains?

    It must help clearly, and every rival of another kind must leave clearly more.
    """
    if chosen.error > _DECISIVE_SHARE * baseline.error or len(chosen.key) > 1:
        return False
    family = chosen.fit.structure.effects[0].effect.family
    rivals = [h for h in found if len(h.key) == 1 and h.key != chosen.key]
    others = [h for h in rivals if h.fit.structure.effects[0].effect.family != family or not family]
    return all(h.error > _DECISIVE_RIVAL * chosen.error for h in others)


def _same_thing(rival: Hypothesis, chosen: Hypothesis, *, sample_time: float) -> bool:
    """Is a rival a richer form of the same law, or one the data provably cannot tell from it?"""
    (mine,) = chosen.key - rival.key
    (other,) = rival.key - chosen.key
    if find_effect(other[0]).grows_from == mine[0] and other[1] == mine[1]:
        return True
    names = {mine[0], other[0]}
    if names == {"sensor_gain"}:
        return True  # only ratios of gains show
    if names == {"input_delay", "actuator_lag"}:
        term = next(
            t for t in chosen.fit.structure.model(chosen.fit.theta).terms if t.effect.key == mine[0]
        )
        return abs(term.values[0]) < 0.5 * sample_time
    return False


def choose_experiment(verdict: Verdict, chosen: Hypothesis, close: Sequence[Hypothesis]) -> str:
    """Return what to record next: what tells the rivals apart, or settles the name."""
    if verdict == "ambiguous":
        own = next(iter(chosen.key - close[0].key))
        other = next(iter(close[0].key - chosen.key))
        texts = {find_effect(key[0]).deciding_run for key in (own, other)}
        return " ".join(sorted(texts))
    if verdict == "unexplained":
        return (
            "Repeat each run, then free decays of one cart at a time from two release heights: "
            "what is in the carts shows there, what is in the drive does not."
        )
    if verdict == "named":
        return chosen.fit.structure.effects[-1].effect.deciding_run
    return ""
