"""One search for the effects on a bench, step by step."""

from contextlib import suppress
from dataclasses import replace

from pipeline.gap import limits
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.baseline import measure_noise
from pipeline.gap.fit.levenberg_marquardt import GapFit, fit_model
from pipeline.gap.fit.linearise import Nuisance
from pipeline.gap.fit.restart import holding_force
from pipeline.gap.fit.structure import Candidate
from pipeline.gap.search.deadline import Deadline, OutOfTime
from pipeline.gap.search.find import find_hypotheses
from pipeline.gap.search.free_run_fit import finish, fit_free_run
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge
from pipeline.gap.search.offset import find_offset
from pipeline.gap.search.prune import steps_to, without_zero_effect
from pipeline.gap.search.verdict import reach_verdict
from pipeline.gap.types import Verdict
from pipeline.words.phrases import phrases


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
        study = self.study
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
        if baseline.at_floor or baseline.error < limits.AS_REPEATS * study.repeatability:
            return baseline, [baseline]
        study.progress(f"linear model: error {baseline.error:.1%} of the motion on held-out runs")
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
        holding = holding_force(chosen.fit.tables)
        if abs(offset.force) < holding[offset.cart - 1]:
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
        candidate = Candidate(
            effect=effect, place=offset.cart, signs=(1.0,), scales=(abs(offset.force),)
        )
        without = tuple(
            judge(fit_free_run(h.fit.without_nuisance, pinned), pinned) for h in self.path
        )
        fit = fit_free_run(chosen.fit.with_effect(candidate, (offset.force,)), loose)
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
