"""Search the catalogue for the effects of a bench.

Effects are not tried one by one. All laws at all places are fitted together, from zero, to a model
that follows the measurement. Needless laws are then dropped (`gap.pem`), and the remaining ones
are fitted to whole runs. Each effect must lower the error on runs that the fit has not seen. Rivals
come from the same fit with one law exchanged.
"""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.fit import GapFit, Mapper, first_chain, fit_model, holding_force, measure_noise
from pipeline.gap.judge import (
    Hypothesis,
    Study,
    as_model,
    basin_hopping,
    build_up,
    enrich,
    filled,
    finish,
    fit_free_run,
    judge,
    prune,
    reach_verdict,
    steps_to,
    without_zero_effect,
    worth_it,
)
from pipeline.gap.parameters import Candidate, GapModel, Nuisance
from pipeline.gap.pem.fit import PemFit, Records, choose_laws, rivals_of
from pipeline.gap.pem.model import RunParameters
from pipeline.gap.runs import GapRun
from pipeline.gap.types import Verdict
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import Chain
from pipeline.plant.effect import Effect
from pipeline.words.numbers import listing
from pipeline.words.phrases import phrases

# ---------------------------------------------------------------------- the time limit


class OutOfTime(Exception):
    """The time limit is reached; the caller keeps its best result."""


class Deadline:
    """Maps a function over runs until the time is up; all slow work goes through here.

    `cut` is true if any work was refused. The answer then depends on the speed of the computer.
    """

    def __init__(self, mapper: Mapper, *, seconds: float | None) -> None:
        """Start the clock; `seconds` None means no limit."""
        self.cut = False
        self._mapper = mapper
        self._end = None if seconds is None else time.monotonic() + seconds

    def map(self, work: Callable[[Any], Any], *items: Iterable[Any]) -> Iterator[Any]:
        """Map like the built-in `map`.

        Raises
        ------
        OutOfTime : the time is up, before or between two items.
        """

        def in_time(*item: Any) -> Any:
            if self._end is not None and time.monotonic() > self._end:
                self.cut = True
                raise OutOfTime
            return work(*item)

        return iter(self._mapper(in_time, *items))


# -------------------------------------------------------- a constant force, from the rest points
#
# On a linear chain, a constant force only shifts the rest position, like a wrong encoder zero. But
# if other carts are held, other springs balance the same force.


def find_offset(
    chain: Chain, runs: Sequence[GapRun], nuisance: Sequence[Nuisance]
) -> tuple[int, float] | None:
    """Return the cart and the constant force that explain the fitted encoder zeros, if certain.

    The standard error of the force comes from the scatter between runs.
    """
    if not np.any(chain.k > 0):
        return None
    if len({run.free for run in runs}) == 1 and not any(run.at_rest for run in runs):
        return None  # the force would look like a wrong encoder zero
    zeros = [one.zero[list(run.rows)] for run, one in zip(runs, nuisance, strict=True)]
    total = sum(float(zero @ zero) for zero in zeros)
    step = max(float((run.sigma * np.sqrt(12.0)).max()) for run in runs)
    if np.sqrt(total / sum(zero.size for zero in zeros)) < limits.OFFSET_STEPS * step:
        return None
    found = []
    for cart in range(1, chain.n + 1):
        gains = [_compliance(chain, run, cart) for run in runs]
        pairs = [(gain, zero) for gain, zero in zip(gains, zeros, strict=True) if np.any(gain)]
        if len(pairs) < 3:
            continue
        forces = np.array([gain @ zero / (gain @ gain) for gain, zero in pairs])
        force = float(forces.mean())
        unexplained = total - sum(
            float(zero @ zero - (zero - gain * force) @ (zero - gain * force))
            for gain, zero in pairs
        )
        smallest = step / np.sqrt(12.0) / max(float(np.abs(gain).max()) for gain, _ in pairs)
        std = max(float(forces.std(ddof=1)), smallest) / np.sqrt(forces.size)
        is_sure = abs(force) > limits.OFFSET_SURE * std
        if is_sure and unexplained < (1.0 - limits.OFFSET_SHARE) * total:
            found.append((unexplained, cart, force))
    return min(found)[1:] if found else None


def _compliance(chain: Chain, run: GapRun, cart: int) -> Array:
    """Return the displacement of the measured carts under a unit force on one cart."""
    free = [i for i, moves in enumerate(run.free) if moves]
    if cart - 1 not in free:
        return np.zeros(len(run.rows))
    K = chain.stiffness[np.ix_(free, free)]
    unit = np.array([1.0 if i == cart - 1 else 0.0 for i in free])
    if np.linalg.cond(K) > 1e9:
        return np.zeros(len(run.rows))
    x = np.linalg.solve(K, unit)
    return np.array([x[free.index(row)] for row in run.rows])


# ------------------------------------------------------ from the prediction-error fit to effects


def follow(runs: Sequence[GapRun], catalogue: Iterable[Effect], mapper: Mapper) -> Records:
    """Return the runs as the prediction-error fit follows them."""
    return Records(
        runs=tuple(runs),
        mapper=mapper,
        columns=frozenset().union(*(filled(effect) for effect in catalogue)),
    )


_FOLLOWED = 0.5  # gain; the motion before a window is then forgotten within it
_AS_NOISE = 9.0  # largest mean square error in a window: three standard deviations
# The noise is not measured yet. It may be up to twice the rounding of the encoder.
_MOST_NOISE = 4.0
_CHI_MEDIAN = 0.455  # median of a squared standard normal variable


def are_followed(
    windows: Sequence[tuple[GapRun, float, float]], model: PemFit, records: Records
) -> list[bool]:
    """Return for each window (run, start, end) whether the model follows it down to the noise.

    No hand is then needed to explain its motion: the laws of the catalogue, driven by the measured
    input, do. `model` was fitted to other runs or stretches.
    """
    model = records.fit(model, gain=_FOLLOWED)
    if not np.isfinite(model.cost):
        return [False] * len(windows)
    usual = np.concatenate([errors.ravel() for errors in model.errors])
    noise = float(np.median(usual**2)) / _CHI_MEDIAN
    most = _AS_NOISE * min(max(1.0, noise), _MOST_NOISE)
    out = []
    for run, start, end in windows:
        own = (RunParameters.of(run),)
        alone = replace(records, runs=(run,)).evaluate(replace(model, own=own))
        inside = (run.followed.t >= start) & (run.followed.t <= end)
        if fine := bool(np.isfinite(alone.cost) and inside.any()):
            fine = bool(np.mean(alone.errors[0][:, inside] ** 2) < most)
        out.append(fine)
    return out


def find_hypotheses(baseline: Hypothesis, study: Study) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return the chosen hypothesis and all that were judged, the baseline first.

    If the time limit is reached, the result is the best so far.
    """
    found = [baseline]
    with suppress(OutOfTime):
        records = follow(study.training, study.catalogue, study.mapper)
        chain = baseline.fit.structure.chain(baseline.fit.theta)
        own = first_chain(study.training, springs=study.springs)
        lean = choose_laws(
            records, springs=study.springs, chains=[chain, own], progress=study.progress
        )
        if not lean.laws.groups():
            return baseline, found
        full = judge(fit_free_run(_as_model(lean, study, records), study), study)
        found.append(full)
        found[-1] = full = _in_lower_minimum(full, study)
        study.progress(f"{full.size} laws remain: error {full.error:.1%}")
        made = build_up(full, baseline, study) if study.explains(full) else [full]
        found += [h for h in made if h is not full]
        smallest = made[-1]
        lean = _restricted(lean, smallest, records)
        _judge_rivals(rivals_of(lean, records), found, study, records)
        found[1:] = [h for h in found[1:] if np.isfinite(h.error)]
        # More effects than the smallest model has would only be crutches.
        few = [h for h in found if len(h.key) <= max(len(smallest.key), 1)]
        # An effect with a parameter at its bound is often not real, so it is removed.
        chosen = prune(min(few, key=lambda h: h.bic_of_all), study, found)
        sound = [h for h in found if h.is_credible and np.isfinite(h.error)]
        if not chosen.is_credible:
            chosen = prune(min(sound, key=lambda h: h.bic_of_all), study, found)
        if not study.is_noise(chosen):
            chosen = enrich(chosen, study, found)
            # Rivals of the same size are improved too, so all are compared at the same stage.
            at = found.index(chosen)
            with suppress(OutOfTime):
                for i, h in enumerate(found):
                    if len(h.key) == len(chosen.key):
                        found[i] = _in_lower_minimum(h, study)
            chosen = found[at]
        usable = chosen.is_credible and np.isfinite(chosen.error)
        return chosen if usable else baseline, [h for h in found if h.is_credible]
    found = [h for h in found if np.isfinite(h.error) and h.is_credible]
    worth = [h for h in found if worth_it(h, baseline, study)]
    return min(worth, key=lambda h: h.bic, default=baseline), found


def _in_lower_minimum(hypothesis: Hypothesis, study: Study) -> Hypothesis:
    """Return a hypothesis with backlash in a lower minimum, if jumps lead to one."""
    fit = basin_hopping(hypothesis.fit, study)
    return hypothesis if fit is hypothesis.fit else judge(fit, study)


def _restricted(lean: PemFit, model: Hypothesis, records: Records) -> PemFit:
    """Return the fit with only the laws that fill columns of the model's effects."""
    kept = {(c.place, column) for c in model.fit.structure.effects for column in filled(c.effect)}
    gone = [
        group
        for group in lean.laws.groups()
        if not {(place, column) for place, column in lean.laws.filled(group)} & kept
    ]
    return records.refit(lean, *lean.laws.without(lean.p, gone)) if gone else lean


def _judge_rivals(
    rivals: Sequence[PemFit], found: list[Hypothesis], study: Study, records: Records
) -> None:
    """Append the rivals, fitted to whole runs; those that are finished if the time is up."""
    judged: dict[int, Hypothesis] = {}

    def fit(at: int, rival: PemFit) -> None:
        judged[at] = judge(fit_free_run(_as_model(rival, study, records), study), study)

    try:
        list(study.mapper(fit, range(len(rivals)), rivals))
    finally:
        found += [judged[at] for at in sorted(judged)]


def _as_model(fit: PemFit, study: Study, records: Records) -> GapModel:
    """Return a model that follows the record as a model with effects of the catalogue."""
    if not any(study.springs):
        # Without springs, errors add up, and a missing effect would mislead a fit that starts with
        # a free simulation. So the gain is lowered step by step.
        for gain in (0.02, 0.01, 0.005, 0.002, 0.0):
            fit = records.fit(fit, gain=gain) if gain < fit.gain else fit
    return as_model(fit, springs=study.springs, catalogue=study.catalogue, runs=study.training)


# ---------------------------------------------------------------------- one search, step by step


class Search:
    """A search. Each step continues from the results of the previous one.

    Attributes
    ----------
    study : runs and options of fits. It is replaced if a new noise level or a different split of
        the runs is better.
    linear : the linear chain that fits the training runs.
    chosen : the best hypothesis so far.
    found : all hypotheses judged so far, the linear one first.
    path : the hypotheses from the linear model to the chosen one, each with one effect more.
    close : the rivals, if the verdict is `ambiguous`.
    final : the chosen fit with its covariance; its parameters come from whole runs.
    """

    chosen: Hypothesis
    found: list[Hypothesis]
    path: tuple[Hypothesis, ...]
    verdict: Verdict
    close: list[Hypothesis]
    final: GapFit

    def __init__(self, study: Study, linear: GapFit, deadline: Deadline) -> None:
        """Begin with the linear chain, fitted to the training runs of the study."""
        self.study, self.linear, self.deadline = study, linear, deadline
        self.notes: list[str] = []

    # ------------------------------------------------------------------------ the steps

    def find_effects(self) -> None:
        """Choose the effects, unless the linear model already fits down to noise or repeats."""
        self.chosen, self.found = self._look(self.study)

    def remeasure_noise(self) -> None:
        """Search again if the remaining error is smaller than the assumed noise.

        The assumed noise included the misfit of the linear model.
        """
        for _ in range(2):
            if self.chosen.fit.chi > limits.TOO_GOOD or self.deadline.cut:
                return
            training = self.study.training
            self._try(self.study.with_noise(measure_noise(self.chosen.fit, training, training)))

    def change_sides(self) -> None:
        """Exchange training and held-out runs and search again, if only held-out runs fit badly.

        An effect that acts only in the held-out runs cannot be found from the training runs.
        """
        left = self.chosen.fit.chi, self.chosen.held.chi
        if not left[0] < limits.NEAR_FLOOR**2 < left[1] or self.deadline.cut:
            return
        sides = {"training": self.study.held_out, "held_out": self.study.training}
        if self._try(replace(self.study, **sides), only_at_floor=True):
            self.notes.append(phrases("gap").text("note_sides"))

    def add_constant_force(self) -> None:
        """Add a constant force if the rest points imply one.

        With the force in the model, the file's encoder zeros count as right to within half the
        noise. All hypotheses are then judged with these zeros.
        """
        self.path = steps_to(self.chosen, self.found, self.study)
        with suppress(OutOfTime):
            self._add_constant_force(self._timed(self.study))

    def reach_verdict(self) -> None:
        """Complete the chosen fit, and set the verdict."""
        study, tried = self.study, self.path[-1]
        sample_time = max(run.record.sample_time for run in study.training)
        while True:
            self.verdict, self.path, self.close = reach_verdict(
                self.path, self.found, study=study, sample_time=sample_time
            )
            self.chosen = self.path[-1]
            with suppress(OutOfTime):
                self._settle(self._timed(study))
            self.final = finish(self.chosen.fit, study)
            without = without_zero_effect(self.chosen, self.final, study)
            if without is None:
                break
            # After the complete fit, an effect may turn out to be zero.
            self.found = [*self.found, *self.path, without]
            self.path = steps_to(without, self.found, study)
        if not study.whole:
            self.chosen = replace(self.chosen, fit=self.final)
        self.path = (*self.path[:-1], self.chosen)
        if self.verdict == "named" and not study.explains(self.chosen):
            self.verdict = "partial"
        if self.verdict == "none" and tried.key:
            titles = [find_effect(key).title.lower() for key, _ in sorted(tried.key)]
            errors = {"before": f"{self.path[0].error:.3%}", "after": f"{tried.error:.3%}"}
            hint = phrases("gap").text("note_hint", effects=listing(titles), **errors)
            self.notes.append(hint)

    # ------------------------------------------------------------------- judged runs

    @property
    def judged(self) -> list[tuple[GapRun, Nuisance]]:
        """The runs on which the final model is judged, each with its nuisance parameters."""
        study = self.study
        if study.whole:
            return list(zip(study.whole, self.final.nuisance, strict=True))
        nuisance = (*self.final.nuisance, *self.chosen.held.nuisance)
        return list(zip((*study.training, *study.held_out), nuisance, strict=True))

    # ------------------------------------------------------------------- private parts

    def _timed(self, study: Study) -> Study:
        """Return a study whose fits obey the time limit."""
        return replace(study, fitting=replace(study.fitting, mapper=self.deadline.map))

    def _look(self, study: Study) -> tuple[Hypothesis, list[Hypothesis]]:
        """Return the chosen hypothesis and all that were judged in time, the linear one first."""
        baseline = judge(self.linear, study)
        # If the error is this small, no effect could lower it by a tenth.
        quiet = limits.PARTIAL_GAIN * baseline.error < study.floor
        quiet = quiet and baseline.fit.chi < limits.NEAR_FLOOR**2
        as_repeats = baseline.error < limits.AS_REPEATS * study.repeatability
        if baseline.at_floor or quiet or as_repeats:
            return baseline, [baseline]
        study.progress(
            f"linear model: error {baseline.error:.1%} of the motion on held-out recordings"
        )
        return find_hypotheses(baseline, self._timed(study))

    def _try(self, study: Study, *, only_at_floor: bool = False) -> bool:
        """Search with a changed study; return whether its result was complete and is kept."""
        self.linear = fit_model(self.linear.without_nuisance, study.training, study.fitting)
        chosen, found = self._look(study)
        kept = not self.deadline.cut and (chosen.at_floor or not only_at_floor)
        if kept:
            self.study, self.chosen, self.found = study, chosen, found
        return kept

    def _add_constant_force(self, study: Study) -> None:
        chosen, structure = self.chosen, self.chosen.fit.structure
        effect = next((effect for effect in study.catalogue if effect.only_rest), None)
        runs = [*study.training, *study.held_out]
        nuisance = [*chosen.fit.nuisance, *chosen.held.nuisance]
        offset = find_offset(structure.chain(chosen.fit.theta), runs, nuisance)
        if effect is None or offset is None:
            return
        cart, force = offset
        if abs(force) < holding_force(chosen.fit.tables)[cart - 1]:
            # Effects such as friction can hold a cart this far from its equilibrium, so its rest
            # proves nothing.
            return
        pinned, loose = (
            replace(
                study,
                training=tuple(run.with_zeros(width=width) for run in study.training),
                held_out=tuple(run.with_zeros(width=width) for run in study.held_out),
            )
            for width in (1e-4, 0.5)  # width of the zeros, times the noise: exact, or rounded
        )
        candidate = Candidate(effect=effect, place=cart, signs=(1.0,), scales=(abs(force),))
        without = tuple(
            judge(fit_free_run(h.fit.without_nuisance, pinned), pinned) for h in self.path
        )
        fit = fit_free_run(chosen.fit.with_effect(candidate, (force,)), loose)
        final = judge(fit, loose)
        as_good = limits.OFFSET_AS_FREE * chosen.error
        if final.error > min(limits.OFFSET_GAIN * without[-1].error, as_good):
            return
        # These replace the other hypotheses, which were judged with free encoder zeros.
        self.path, self.found = (*without, final), [*without, final]
        self.study = replace(loose, fitting=self.study.fitting)

    def _settle(self, study: Study) -> None:
        """Continue the fit until the cost no longer falls; the search stops fits earlier.

        The `bic` is not changed, so that the chosen hypothesis and its rivals are compared at the
        same stage of the fit.
        """
        fit = self.chosen.fit
        # A hundredth of chi-square is a tenth of a standard error.
        fit = study.fit(fit, scatter_free=fit.scattered, tolerance=0.01 / fit.n_points)
        self.chosen = replace(judge(fit, study), bic=self.chosen.bic)
