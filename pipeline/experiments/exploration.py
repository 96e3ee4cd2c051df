"""Record, identify, look for the gap and choose again, until all is known or time is up."""

import gc
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pipeline.errors import ConfigError, DataError
from pipeline.estimation.parametrisation import named_estimates
from pipeline.experiments import propose
from pipeline.experiments.discriminate import propose_for
from pipeline.experiments.information import GAP, ErrorGoal
from pipeline.experiments.next_recordings import choose_next, far_sweep
from pipeline.experiments.plan import (
    Plan,
    PlanLimits,
    Recording,
    load_plan,
    plan_path,
    recorded_ids,
    save_plan,
    session_time,
    time_words,
)
from pipeline.gap.explain import investigate
from pipeline.gap.limits import NOTHING
from pipeline.gap.types import Gap, Trace
from pipeline.json_files import json_text
from pipeline.names import parameter_names
from pipeline.output import own_folder, write_file
from pipeline.plant.effect import AugmentedChain, effect_name
from pipeline.results import Analysis, Estimate, Stage
from pipeline.submission import load_submission
from pipeline.submission.load import NAME
from pipeline.submission.models import MOST_CARTS
from pipeline.words.numbers import join_names, listing
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import capital
from pipeline.workflow import analyse

# ----------------------------------------------------- a turn: what is known, and what is in doubt

WORDS = phrases("exploration")


@dataclass(frozen=True, kw_only=True)
class Turn:
    """What was known after one turn of an exploration.

    Attributes
    ----------
    seconds : time at the bench up to the end of this turn, including rests.
    recorded : ids of the recordings made in this turn.
    errors : relative standard error of each parameter, by name; None if unknown.
    reached : whether all requested parameters are known and the gap is named or absent.
    summary : results, doubts and the reason for the next recording, as sentences.
    gap : the gap analysis of this turn; None if it was not possible. For an earlier turn, it keeps
        only the trace that the diary shows; all traces of all turns would need too much memory.
    """

    seconds: float
    recorded: tuple[str, ...]
    errors: dict[str, float | None]
    reached: bool
    summary: str
    gap: Gap | None = None

    def without_other_traces(self) -> "Turn":
        """Return the turn without the traces that the diary does not show."""
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


def is_unstated(errors: dict[str, float | None]) -> bool:
    """Return whether no parameter has a standard error, as in a fit with backlash."""
    return all(error is None for error in errors.values())


def describe_accuracy(missing: dict[str, float], errors: dict[str, float | None]) -> str:
    """Say how well the parameters are known."""
    if is_unstated(errors):
        return WORDS.text("no_errors")
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
            rivals = " or ".join(name for name, _ in list_explanations(gap)[:2])
            return WORDS.text("disputed", rivals=rivals)
    if gap.final < NOTHING * gap.noise_floor:
        return WORDS.text("only_fitted")
    return WORDS.text("no_name", times=times)


def list_explanations(gap: Gap) -> list[tuple[str, float]]:
    """Return the names and weights of the models that may be true, the chosen one first.

    A named gap has only the chosen one. If the linear chain is enough, the list is empty.
    """
    if gap.verdict == "named":
        return [(name_model(gap.model), 1.0)]
    return [(name_model(one), one.weight) for one in gap.contenders]


def name_model(model: AugmentedChain) -> str:
    """Return the effects of a model in words, by name and place."""
    names = [effect_name(term.effect, term.where) for term in model.terms]
    return " and ".join(names) or "the linear chain"


# ---------------------------------------------------------------------- the exploration

SETTLED = ("named", "none")
# Separation squared times seconds: a recording below this limit cannot decide between explanations.
# With 200 readings a second, of which every tenth is independent, the criterion would differ by 20.
_APART = 1.0
# A recording with this share of the largest allowed amplitude is as good as the largest.
_HARD = 0.8
# One analysis plans this share of the recordings so far. Fewer data hardly change the next choice,
# but each analysis takes as much longer as there are more recordings.
_SHARE = 0.1
_FAR_OUT = "far"  # the aim of a recording that shows effects at large motion
_FIRST = "sweep"  # the first recording that the plan proposes; nobody has to hold a cart for it
# most recordings in a row that distinguish explanations; then another purpose comes first
_OFTEN = 2


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The result of the requested recordings.

    Attributes
    ----------
    ids : ids of the recordings that were made.
    seconds : total time of all attempts, in s.
    vetoed : whether recordings are missing because a person at the bench refused them.
    why : why requested recordings are missing; empty if all came or the reason is unknown.
    """

    ids: tuple[str, ...] = ()
    seconds: float = 0.0
    vetoed: bool = False
    why: str = ""


@dataclass(kw_only=True)
class Exploration:
    """An exploration of a bench, turn by turn; a submission collects its recordings.

    After each turn, the folder holds the submission, gap/gap.json and the diary. A recording that a
    person adds to plan.toml takes precedence over cartlab's choice.

    Attributes
    ----------
    folder : the submission's folder.
    record : function that makes recordings of the plan, given by their ids. Its first call also
        makes submission and plan if they are missing.
    write_diary : function that writes the page of all turns; see `report.exploration`.
    known_commands : function that returns the extensions of the protocol that the bench knows.
    goal : the errors to reach.
    seconds : time allowed at the bench, including rests. A recording that would exceed it is not
        begun. Each interrupted attempt counts in full.
    announce : function that is called with a sentence in each turn.
    progress : function that is called often with a few words during computations. An exception that
        it raises ends the exploration.
    vetoes : function that returns whether a person refuses the chosen recording; if so, another one
        is chosen.
    turns : the knowledge after each turn.
    made : ids of the recordings made since the last turn.
    spent : time spent at the bench, in s.
    ours : ids in the plan that cartlab added. All other recordings without data were added by a
        person.
    refused : recordings that were vetoed or failed.
    lost : the reason why the last chosen recording is missing; empty if it was made.
    failures : number of failures in a row.
    """

    folder: Path
    record: Callable[[Sequence[str]], Recorded]
    write_diary: Callable[..., object]
    known_commands: Callable[[Path], frozenset[str]]
    goal: ErrorGoal
    seconds: float
    announce: Progress
    progress: Progress = silent
    vetoes: Callable[[Recording], bool] = lambda recording: False
    turns: list[Turn] = field(default_factory=list)
    made: tuple[str, ...] = ()
    spent: float = 0.0
    ours: set[str] = field(default_factory=lambda: {_FIRST})
    refused: list[Recording] = field(default_factory=list)
    lost: str = ""
    failures: int = 0

    def run(self) -> tuple[Turn, ...]:
        """Explore until all is known, nothing would help or time is up; return the turns.

        Raises
        ------
        DataError : the first recordings do not identify the carts.
        ConfigError : the carts have no parameter that the goal names, or the first sweep alone
            takes too long.
        """
        self._begin()
        self._analyse()
        while recordings := self._take_turn():
            self._make(recordings)
            if self.made:
                self._analyse()
            else:
                self._propose(self.gap)  # find again which recording decides
        return tuple(self.turns)

    def choose(self, missing: dict[str, float]) -> tuple[Sequence[Recording], str]:
        """Return the next recordings and why they were chosen.

        The result is empty if everything is known or nothing would help. A recording that
        distinguishes explanations comes first, then some that improve the least known parameter,
        then one that shows effects at large motion. None resembles a refused one.

        Parameters
        ----------
        missing : the parameters that are not known well enough, with their relative errors.
        """
        analysis, gap = self.analysis, self.gap
        limits = load_plan(load_submission(self.folder)).limits
        named = gap is None or gap.verdict in SETTLED
        end = "" if named else WORDS.text("undecided")
        decides = gap and gap.proposal
        predicted = decides and decides.prediction
        if gap and decides and predicted and decides.separation**2 * predicted.t[-1] > _APART:
            names = " and ".join(f'"{name_model(gap.contenders[i])}"' for i in predicted.pair)
            times = f"{decides.separation:.2g}"
            return [decides.recording], WORDS.text("differ", names=names, times=times)
        if missing and named and not is_unstated(relative_errors(analysis)):
            n = max(1, int(_SHARE * len(analysis.records)))
            try:
                found = choose_next(
                    analysis,
                    Plan(limits=limits),  # planned recordings give no information yet
                    n=n,
                    goal=max(missing, key=lambda name: missing[name]),
                    commands=self.known_commands(self.folder),
                    without=self.refused,
                )
            except DataError as error:  # a large step is still possible
                end = str(error)
            else:
                # Drop those beyond the error to reach or the time left, but keep the first.
                while n > 1 and not (
                    found.errors[n - 1] > self.goal.error
                    and self._has_time_for(found.recordings[:n])
                ):
                    n -= 1
                found = replace(
                    found, recordings=found.recordings[:n], errors=found.errors[: n + 1]
                )
                return found.recordings, "; ".join(found.sentences)
        # A named model whose error exceeds the noise is only one of several contenders.
        settled = named and not (gap and gap.contenders)
        # Record each of these only once: carts that were held back would go no further.
        tried = [*self.refused, *self._planned(recorded=True)]
        for recording, unseen in _reach_far_out(analysis, limits):
            alike = any(
                recording.resembles(other) or (other.kind, other.aim) == (recording.kind, _FAR_OUT)
                for other in tried
            )
            if not alike and (unseen or not settled):
                why = unseen if settled else WORDS.text("as_far")
                return [recording.model_copy(update={"aim": _FAR_OUT})], why
        return (), end

    def _begin(self) -> None:
        """Make the first recordings of an empty submission, after checking the goal."""
        submission = load_submission(self.folder) if (self.folder / NAME).exists() else None
        if submission:
            system = submission.system
            names = parameter_names(system.carts, rigid=not system.bench.tied)
        else:  # a goal may name a parameter of any number of carts
            of_any = (name for n in range(1, MOST_CARTS + 1) for name in parameter_names(n))
            names = (*parameter_names(1, rigid=True), *of_any)
        self.goal.missing(dict.fromkeys(names))  # refuses a goal that the carts cannot meet
        known = submission is not None and bool(submission.experiments)
        plan = None
        if submission and plan_path(submission).exists():
            plan = load_plan(submission)
            self.ours.update(one.id for one in plan.recordings)
        if not known:
            first = propose.FIRST_SWEEP_TIME
            if plan:
                first = session_time([one for one in plan.recordings if one.id == _FIRST])
            if first > self.seconds:
                raise ConfigError(
                    f"--time: the first sweep alone takes {time_words(first)}, "
                    f"more than the {time_words(self.seconds)} allowed"
                )
            self._record([_FIRST])
        submission = load_submission(self.folder)
        if plan is None:
            plan = propose.propose_plan(submission)
            self.ours.update(one.id for one in plan.recordings)
            if not plan_path(submission).exists():
                save_plan(plan, submission)
        if not known:
            recordings = load_plan(submission).recordings
            steps = [one for one in recordings if one.kind == "step" and not one.release]
            if steps and self._has_time_for(steps):
                self._record([step.id for step in steps])

    def _record(self, ids: Sequence[str]) -> Recorded:
        recorded = self.record(ids)
        self.made += recorded.ids
        self.spent += recorded.seconds
        return recorded

    def _has_time_for(self, recordings: Sequence[Recording]) -> bool:
        return self.spent + session_time(recordings) <= self.seconds

    def _analyse(self) -> None:
        """Identify the carts and look for the gap with all data so far."""
        if self.turns:  # their arrays and the new ones need not be in memory together
            del self.analysis
        self.gap: Gap | None = None
        gc.collect()  # figures and searches are reference cycles with large arrays
        analysis = analyse(load_submission(self.folder), progress=self.progress)
        try:
            self._propose(investigate(analysis, progress=self.progress))
        except DataError as error:
            self.announce(f"the search for the gap is not possible: {error}")
        self.analysis = _identify_beside(analysis, self.gap)

    def _propose(self, gap: Gap | None) -> None:
        """Find the recording that best distinguishes the explanations; save it in gap.json."""
        if gap is None:
            return
        submission = load_submission(self.folder)
        asked = [one for one in self._planned(recorded=True) if one.aim == GAP]
        often = [one for one in asked if sum(map(one.resembles, asked)) >= _OFTEN]
        self.gap = propose_for(gap, submission, without=[*self.refused, *often])
        place = own_folder(self.folder, "gap")
        place.mkdir(exist_ok=True)
        write_file(place / "gap.json", json_text(self.gap))

    def _take_turn(self) -> Sequence[Recording]:
        """Report what is known; add the next recordings to the plan and return them."""
        self.progress("what to record next")
        gap, errors = self.gap, relative_errors(self.analysis)
        missing = self.goal.missing(errors)
        recordings, why = self._plan_next(missing)
        why_ended = ""
        if recordings and not self._has_time_for(recordings[:1]):
            name = recordings[0].id
            why_ended = WORDS.text("time_up", time=time_words(self.seconds), name=name)
        # after three failures in a row, another choice does not help
        elif recordings and self.failures >= 3:
            why_ended = WORDS.text("none_came", count=self.failures)
        # whether something useful was left undone
        is_cut_short = bool(why_ended or (self.failures and not recordings))
        parts = (
            self.lost,
            describe_accuracy(missing, errors),
            describe_doubt(gap) if gap else WORDS.text("no_look"),
            capital(why) or WORDS.text("the_end"),
            why_ended,
        )
        turn = Turn(
            seconds=self.spent,
            recorded=self.made,
            errors=errors,
            reached=not missing and not is_cut_short and gap is not None and gap.verdict in SETTLED,
            summary=". ".join(filter(None, parts)).replace("?. ", "? "),
            gap=gap,
        )
        self.turns.append(turn)
        self.made = ()
        self.write_diary(self.turns, self.analysis, self.folder, wanted=self.goal.error)
        self.announce(turn.summary)
        return () if why_ended else recordings

    def _plan_next(self, missing: dict[str, float]) -> tuple[list[Recording], str]:
        """Return the next recordings as written in the plan, and their reason."""
        try:
            recordings, why = self.choose(missing)
        except DataError as error:
            recordings, why = (), str(error)
        if added := self._added():  # during the computation
            return [added], WORDS.text("added", name=added.id)
        still, planned = self._planned(recorded=False), list[Recording]()
        for recording in recordings:
            named = {"id": recording.id, "note": recording.note}
            same = (one for one in still if one.model_copy(update=named) == recording)
            planned.append(next(same, None) or propose.add_recording(self.folder, recording))
            still = [one for one in still if one.id != planned[-1].id]
        if planned:
            key = "therefore" if len(planned) == 1 else "therefore_these"
            why = WORDS.text(key, name=listing([one.id for one in planned]), why=why)
        return planned, why

    def _planned(self, *, recorded: bool) -> list[Recording]:
        """Return the recordings of the plan that have data, or those without data."""
        submission = load_submission(self.folder)
        plan = load_plan(submission)
        done = recorded_ids(plan, submission)
        return [one for one in plan.recordings if (one.id in done) == recorded]

    def _added(self) -> Recording | None:
        """Return the first recording without data that a person added to the plan."""
        still = self._planned(recorded=False)
        return next((one for one in still if one.id not in self.ours), None)

    def _make(self, recordings: Sequence[Recording]) -> None:
        """Make the chosen recordings; remember why one was not made.

        A recording that fails, or one that a person adds to the plan, ends the series.
        """
        self.turns[-1] = self.turns[-1].without_other_traces()
        self.ours.update(one.id for one in recordings)
        for recording in recordings:
            if self.made and (self._added() or not self._has_time_for([recording])):
                return
            vetoed = self.vetoes(recording)
            came = Recorded(vetoed=True) if vetoed else self._record([recording.id])
            if came.ids:
                self.lost, self.failures = "", 0
                continue
            self.refused.append(recording)
            self.failures = 0 if came.vetoed else self.failures + 1
            if came.why and not came.vetoed:
                self.lost = WORDS.text("lost_why", name=recording.id, why=came.why)
            else:
                self.lost = WORDS.text("vetoed" if came.vetoed else "lost", name=recording.id)
            return


def _reach_far_out(analysis: Analysis, limits: PlanLimits) -> Iterator[tuple[Recording, str]]:
    """Yield two recordings that show effects at large motion, each with a reason in words.

    The first is a step to the furthest intended rest position; the second is a sweep with large
    swings to both sides. The reason is empty if earlier records already go about as far.
    """
    chain = propose.identified_chain(analysis)
    driven = [record for record in analysis.records if record.kind in ("step", "sweep")]
    hardest = max((float(np.abs(record.input).max()) for record in driven), default=0.0)
    furthest = min(
        max((float((side * y).max()) for record in driven for y in record.y), default=0.0)
        for side in (1, -1)
    )
    step, swing = propose.large_steps(chain, limits)[0], far_sweep(chain, limits)
    unit = analysis.bench.units.input
    words = WORDS.text("far_step", most=f"{hardest:.2g}", unit=unit)
    yield step, words if hardest < _HARD * abs(step.amplitude) else ""
    unit = analysis.bench.units.position
    words = WORDS.text("far_swing", most=f"{furthest:.2g}", unit=unit)
    yield swing, words if furthest < _HARD * propose.FURTHEST * limits.travel else ""


def _identify_beside(analysis: Analysis, gap: Gap | None) -> Analysis:
    """Return the analysis with the carts as identified together with the effects of the gap.

    Raises
    ------
    DataError : the carts could be identified neither with effects nor without.
    """
    fit, acting = analysis.fit, gap is not None and bool(gap.model.terms)
    if fit is None or not (fit.converged or acting):
        reasons = "; ".join(
            one.reason for one in analysis.skipped if one.stage is Stage.FINAL_ESTIMATES
        )
        raise DataError(f"the carts are not identified: {reasons or 'see the report'}")
    if gap is None or not acting:
        return analysis
    model, covariance = gap.model, gap.chain_covariance
    if covariance is None:  # the errors of a chain without the effects would be wrong
        unknown = {name: replace(one, std=None) for name, one in fit.parameters.items()}
        if model.chain.is_tied:
            values = model.chain.parameters().items()
            unknown = {
                name: Estimate(value=value, std=None, source="gap") for name, value in values
            }
            fit = replace(fit, chain=model.chain, converged=True)
        return replace(analysis, fit=replace(fit, parameters=unknown))
    if not model.chain.is_tied:
        return analysis
    names = tuple(gap.chain_std)
    # With effects, the residual of the linear chain is not noise, so only the encoders' noise is
    # used.
    noise = {name: np.ones_like(left) for name, left in fit.standardised.items()}
    parameters = named_estimates(model.chain, names=names, covariance=covariance, source="gap")
    fit = replace(
        fit,
        chain=model.chain,
        names=names,
        covariance=covariance,
        parameters=parameters,
        standardised=noise,
        converged=True,
    )
    return replace(analysis, fit=fit)
