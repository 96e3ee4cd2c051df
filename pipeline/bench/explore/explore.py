"""Record, identify, look for the gap, choose, record: until it is known, or time is up."""

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.bench.design.discriminate import far_sweep, propose_for
from pipeline.bench.design.goal import GAP
from pipeline.bench.design.next_plan import choose_next, known_commands
from pipeline.bench.explore.wish import Wish
from pipeline.bench.explore.words import (
    doubt_words,
    explanations,
    known_words,
    lost_words,
    model_words,
    relative_errors,
)
from pipeline.bench.planning.by_hand import add_recording
from pipeline.bench.planning.plan import Limits, Plan, Recording
from pipeline.bench.planning.plan_file import load_plan, plan_path, save_plan
from pipeline.bench.planning.plan_words import session_time, time_words
from pipeline.bench.planning.propose import (
    FIRST_SWEEP_TIME,
    FURTHEST,
    identified_chain,
    large_steps,
    propose_plan,
)
from pipeline.errors import ConfigError, DataError
from pipeline.estimation.chain.parametrisation import named_estimates
from pipeline.gap.investigate import investigate
from pipeline.gap.stored import gap_text
from pipeline.gap.types import Gap
from pipeline.names import parameter_names
from pipeline.output import own_folder, write_file
from pipeline.report.exploration.page import write_diary
from pipeline.report.exploration.turn import Turn
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.submission.load import NAME
from pipeline.submission.models import MOST_CARTS
from pipeline.workflow import analyse

FIRST = "sweep"  # of the plan that is proposed where nothing is known: it needs no hands
_SEARCH = 300.0  # s that a look for the gap may take; most take ten
# What there is to be known of carts as long as nobody has said how many there are.
_NAMES = (
    *parameter_names(1, rigid=True),
    *(name for n in range(1, MOST_CARTS + 1) for name in parameter_names(n)),
)
# Noises squared, times seconds: explanations that no recording sets further apart stay in dispute.
# Read 200 times a second, of which every tenth reading is news, the criterion would differ by 20.
_APART = 1.0
_HARD = 0.8  # of what takes the carts as far as they may go: as good as that
_FAR_OUT = "far"  # the aim of what shows what acts far out
_SETTLED = ("named", "none")
_OFTEN = 2  # times that one recording is to tell explanations apart, before another has its turn
_FAILURES = 3  # recordings in a row that a bench does not carry out: it is not their choice


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """What came off of the recordings asked for.

    Attributes
    ----------
    ids : of what was recorded.
    seconds : that all tries took.
    vetoed : somebody at the bench did not want what is not there.
    why : else, what became of it, as far as that is known.
    """

    ids: tuple[str, ...]
    seconds: float
    vetoed: bool = False
    why: str = ""


Record = Callable[[Sequence[str]], Recorded]


def explore(
    folder: Path,
    *,
    record: Record,
    wish: Wish,
    seconds: float,
    tell: Callable[[str], None],
    progress: Callable[[str], None] = lambda stage: None,
    vetoes: Callable[[Recording], bool] = lambda recording: False,
) -> tuple[Turn, ...]:
    """Explore the bench behind `record` into a submission; return what was known turn by turn.

    The submission, gap/gap.json and the diary stand there after each turn, so whatever ends it
    leaves them as they were. A recording that somebody adds to plan.toml meanwhile comes before
    what would be chosen.

    Parameters
    ----------
    record : carries out recordings of the plan by their ids; the first call makes submission and
        plan where there are none.
    seconds : at the bench, rests included; no recording is begun that would go beyond. One that is
        broken off counts each time it is tried.
    tell : takes a sentence at each turn.
    progress : takes a few words, often, while the data are asked; what it raises ends the
        exploration.
    vetoes : whether somebody does not want what was chosen; another is chosen then.

    Raises
    ------
    DataError : the first recordings do not identify the carts.
    ConfigError : the wish is for a parameter that such carts do not have, or the first sweep alone
        takes longer than is allowed.
    """
    known = (folder / NAME).exists() and bool(load_submission(folder).experiments)
    ours = {FIRST}  # in the plan; what else is there, and not recorded, somebody has added
    planned = False
    if (folder / NAME).exists():
        submission = load_submission(folder)
        system = submission.system
        wish.missing(dict.fromkeys(parameter_names(system.carts, rigid=not system.tied)))
        if planned := plan_path(submission).exists():
            ours.update(one.id for one in load_plan(submission).recordings)
    else:  # what no carts have, no bench need move for
        wish.missing(dict.fromkeys(_NAMES))
    made, spent = (), 0.0
    if not known:
        first = _first_time(folder)
        if first > seconds:
            raise ConfigError(
                f"--time: the first sweep takes {time_words(first)}, {time_words(seconds)} are "
                "allowed"
            )
        came = record([FIRST])
        made, spent = came.ids, came.seconds
    submission = load_submission(folder)
    usual = propose_plan(submission)
    if not plan_path(submission).exists():
        save_plan(usual, submission)
    if not planned:
        ours.update(one.id for one in usual.recordings)
    if not known:
        plan = load_plan(submission)
        steps = [r for r in plan.recordings if r.kind == "step" and not r.release]
        if steps and spent + session_time(steps) <= seconds:
            came = record([step.id for step in steps])
            made, spent = (*made, *came.ids), spent + came.seconds
    turns: list[Turn] = []
    refused: list[Recording] = []
    asked: list[Recording] = []  # to decide between explanations, and recorded
    analysis, gap = _look(folder, tell, progress, without=())
    before, failures = "", 0
    while True:
        progress("what to record next")
        plan = load_plan(load_submission(folder))
        turn, recording = _decide(
            analysis, gap, plan, folder, wish=wish, refused=refused, ours=ours
        )
        if recording and spent + session_time([recording]) > seconds:
            left = f"the {time_words(seconds)} allowed are up before {recording.id} would be done"
            said = f"{turn.said}, but {left}"
            turn, recording = replace(turn, said=said, reached=False), None
        elif recording and failures >= _FAILURES:
            said = f"{turn.said}, but {failures} recordings in a row did not come off"
            turn, recording = replace(turn, said=said, reached=False), None
        elif failures and not recording:  # what was still wanted is not there
            turn = replace(turn, reached=False)
        turn = replace(turn, seconds=spent, recorded=made, said=before + turn.said)
        turns.append(turn)
        write_diary(turns, analysis, folder, wanted=wish.error)
        tell(turn.said)
        if recording is None:
            return tuple(turns)
        ours.add(recording.id)
        vetoed = vetoes(recording)
        came = Recorded(ids=(), seconds=0.0, vetoed=True) if vetoed else record([recording.id])
        made, spent = came.ids, spent + came.seconds
        if made:
            before, failures = "", 0
            if recording.aim == GAP:
                asked.append(recording)
            analysis, gap = _look(folder, tell, progress, without=_not_again(refused, asked))
            continue
        refused.append(recording)
        failures = 0 if came.vetoed else failures + 1
        before = lost_words(recording.id, vetoed=came.vetoed, why=came.why) + "; "
        if gap is not None:  # which recording decides is open again
            submission = load_submission(folder)
            gap = propose_for(gap, submission, without=_not_again(refused, asked))
            _write_gap(gap, analysis, folder)


def _not_again(refused: Sequence[Recording], asked: Sequence[Recording]) -> Sequence[Recording]:
    """Return what is not proposed again: refused, or made often without deciding anything."""
    return [*refused, *(r for r in asked if sum(map(r.resembles, asked)) >= _OFTEN)]


def _first_time(folder: Path) -> float:
    """Return what the first sweep takes, s: the plan's, or that of the plan to come."""
    if (folder / NAME).exists() and plan_path(submission := load_submission(folder)).exists():
        return session_time([r for r in load_plan(submission).recordings if r.id == FIRST])
    return FIRST_SWEEP_TIME


def _look(
    folder: Path,
    tell: Callable[[str], None],
    progress: Callable[[str], None],
    *,
    without: Sequence[Recording],
) -> tuple[Analysis, Gap | None]:
    """Identify the carts and look for the gap, as the data stand now; None: it cannot be."""
    submission = load_submission(folder)
    analysis = analyse(submission, progress=progress)
    try:
        gap = investigate(analysis, progress=progress, budget=_SEARCH)
    except DataError as error:
        tell(f"the gap cannot be looked for: {error}")
        return _identified(analysis, None), None
    gap = propose_for(gap, submission, without=without)
    _write_gap(gap, analysis, folder)
    return _identified(analysis, gap), gap


def _write_gap(gap: Gap, analysis: Analysis, folder: Path) -> None:
    place = own_folder(folder, "gap")
    place.mkdir(exist_ok=True)
    write_file(place / "gap.json", gap_text(gap, analysis))


def _identified(analysis: Analysis, gap: Gap | None) -> Analysis:
    """Return the analysis with the carts as they are beside the effects that act on them.

    Raises
    ------
    DataError : neither with effects nor without them the carts are identified.
    """
    fit, acting = analysis.fit, gap is not None and bool(gap.model.terms)
    if fit is None or not (fit.converged or acting):
        reasons = "; ".join(one.reason for one in analysis.skipped if "estimates" in one.stage)
        raise DataError(f"the carts are not identified: {reasons or 'see the report'}")
    if gap is None or not acting:
        return analysis
    model, covariance = gap.model, gap.chain_covariance
    if covariance is None or not model.chain.is_tied:
        return analysis
    names = tuple(gap.chain_std)
    # What the linear chain leaves is no noise: the encoders' own is.
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


def _decide(
    analysis: Analysis,
    gap: Gap | None,
    plan: Plan,
    folder: Path,
    *,
    wish: Wish,
    refused: Sequence[Recording],
    ours: Collection[str],
) -> tuple[Turn, Recording | None]:
    """Return the turn, and the recording to make next: it stands in the plan."""
    errors = relative_errors(analysis)
    missing = wish.missing(errors)
    known = known_words(missing, errors)
    doubt = doubt_words(gap) if gap else "what else acts could not be looked for"
    if gap and not gap.complete:
        doubt += f" (so far: the search was ended after {_SEARCH:.0f} s)"
    recording, why = None, ""
    try:
        recording, why = _next(analysis, gap, plan, folder, missing=missing, refused=refused)
    except DataError as error:
        why = str(error)
    # After all that took its time: somebody may have chosen meanwhile.
    if added := _added(folder, ours):
        recording, why = added, f"next {added.id}, which was added by hand"
    elif recording:
        recording = _planned(recording, folder)
        why = f"therefore {recording.id}: {why}"
    said = "; ".join(filter(None, [known, doubt, why or "so this is the end"]))
    return (
        Turn(
            seconds=0.0,
            recorded=(),
            errors=errors,
            verdict=gap.verdict if gap else "",
            explanations=explanations(gap) if gap else (),
            left=gap.final if gap else None,
            floor=gap.noise_floor if gap else None,
            reached=not missing and gap is not None and gap.verdict in _SETTLED,
            said=said,
        ),
        recording,
    )


def _next(
    analysis: Analysis,
    gap: Gap | None,
    plan: Plan,
    folder: Path,
    *,
    missing: dict[str, float],
    refused: Sequence[Recording],
) -> tuple[Recording | None, str]:
    """Return what to record next and why; None where all is known, or nothing would help."""
    named = gap is None or gap.verdict in _SETTLED
    # A name that leaves more than noise is one of its contenders still.
    settled = gap is None or (named and not gap.contenders)
    commands = known_commands(folder)
    end = "" if named else "no recording within the limits would decide"
    decides = gap and gap.proposal
    if gap and decides and decides.separation**2 * decides.t[-1] > _APART:
        recording = Recording.model_validate_json(json.dumps(decides.recording))
        disputed = [model_words(one.model) for one in gap.contenders]
        names = " and ".join(f'"{disputed[i]}"' for i in decides.pair)
        return recording, f"in it {names} differ by {decides.separation:.2g} times the noise"
    if missing and named:
        worst = max(missing, key=lambda name: missing[name])
        # What is open was refused, or is the next to be chosen: it tells nothing yet.
        made = plan.model_copy(update={"recordings": ()})
        try:
            found = choose_next(analysis, made, n=1, goal=worst, commands=commands, without=refused)
        except DataError as error:  # the large step is left
            end = str(error)
        else:
            return found.recordings[0], found.said
    # Each once: carts that something holds back go no further the second time.
    recorded = {record.id for record in analysis.records}
    tried = [*refused, *(r for r in plan.recordings if r.id in recorded)]
    for recording, unseen in _far_out(analysis, plan.limits):
        alike = any(
            recording.resembles(other) or (other.kind, other.aim) == (recording.kind, _FAR_OUT)
            for other in tried
        )
        if not alike and (unseen or not settled):
            why = unseen if settled else "it takes the carts as far as they may go"
            return recording.model_copy(update={"aim": _FAR_OUT}), why
    return None, end


def _far_out(analysis: Analysis, limits: Limits) -> Iterator[tuple[Recording, str]]:
    """Yield what shows what acts far out, with what has not been seen so far: "", all has.

    A step as large as the carts may rest, and a sweep that swings them to both sides.
    """
    chain = identified_chain(analysis)
    driven = [record for record in analysis.records if record.kind in ("step", "sweep")]
    inputs = [float(np.abs(record.u).max()) for record in driven if record.u is not None]
    hardest = max(inputs, default=0.0)
    furthest = min(
        max((float((side * y).max()) for record in driven for y in record.y), default=0.0)
        for side in (1, -1)
    )
    step, swing = large_steps(chain, limits)[0], far_sweep(chain, limits)
    words = f"no input was above {hardest:.2g} {analysis.input_unit}, and what only a larger one "
    words += "or carts further out show would not be seen"
    yield step, words if hardest < _HARD * abs(step.amplitude) else ""
    words = f"no cart was further out than {furthest:.2g} {analysis.position_unit} to both sides, "
    words += "and what acts there would not be seen"
    yield swing, words if furthest < _HARD * FURTHEST * limits.travel else ""


def _added(folder: Path, ours: Collection[str]) -> Recording | None:
    """Return the first recording that somebody else has put into the plan since it began."""
    submission = load_submission(folder)
    done = {*ours, *(experiment.id for experiment in submission.experiments)}
    return next((one for one in load_plan(submission).recordings if one.id not in done), None)


def _planned(recording: Recording, folder: Path) -> Recording:
    """Return the recording as it stands in the plan: an open one that is the same, or a new one."""
    submission = load_submission(folder)
    done = {experiment.id for experiment in submission.experiments}
    for one in load_plan(submission).recordings:
        if one.id not in done and one.aim == recording.aim and _shape(one) == _shape(recording):
            return one
    return add_recording(folder, recording)


def _shape(recording: Recording) -> str:
    """Return what a recording is, whatever it is called."""
    return recording.model_copy(update={"id": "", "note": "", "aim": ""}).model_dump_json()
