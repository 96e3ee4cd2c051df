"""Check the numbers of a submission as grading does; the answer never contains a value.

A hint about a wrong number names the kind of mistake, and the part of a recording that shows it.
There are only six parts of a recording, so a part does not reveal a period or a settling time. All
sine dwells are named together, because the one nearest to a resonance would reveal its frequency.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import get_args

from pipeline.errors import SubmissionError
from pipeline.grading.grade import CODES, Flag
from pipeline.grading.judge.checks import judge
from pipeline.grading.judge.context import GradingContext
from pipeline.grading.judge.run import analyse_under, prepare_work
from pipeline.grading.rubric import Claims, Gains, Parameters, Prefilter, Rubric, StateModel
from pipeline.grading.rubric_file import shipped_rubric
from pipeline.grading.self_check.answers import (
    CheckAnswer,
    Hint,
    MistakeKind,
    Part,
    RecordingPart,
    find_basis,
    read_answers,
    write_answer,
)
from pipeline.lock import lock_when_free
from pipeline.names import read_name
from pipeline.results import Analysis, ExperimentKind
from pipeline.submission import Reported, Submission
from pipeline.words.progress import Progress, silent

# The table under `[reported]` that each check judges.
_TABLE = {
    "initial": "initial",
    "final": "final",
    "state_space": "state_space",
    "gains": "feedback",
    "claims": "feedback",
    "prefilter": "feedback",
}


def check_numbers(
    submission: Submission,
    *,
    rubric: Rubric | None,
    where: Collection[str] | None = None,
    progress: Progress = silent,
) -> CheckAnswer:
    """Find the reported numbers that disagree with the recordings.

    If the same numbers were checked before, the answer also has hints on where to look. The answer
    is written into the submission's `checks.jsonl` before it is returned.

    Parameters
    ----------
    rubric : rubric with the tolerances; None for the shipped one for this number of carts.
    where : the numbers to give hints for; None for all numbers that may have a hint.

    Raises
    ------
    SubmissionError : nothing is reported, no recording can be read, or the file of earlier answers
        was changed.
    """
    if not _list_reported(submission.reported or Reported()) and not submission.unread:
        raise SubmissionError(
            "no number is reported yet: enter what you found under [reported.initial] or "
            "[reported.final] of submission.toml, then check again"
        )
    folder, rubric = submission.folder, rubric or _default_rubric(submission)
    read_answers(folder)  # report a bad file before the long analysis
    judged = analyse_under(submission, rubric=rubric, progress=progress)
    found = judge_numbers(judged.submission, judged.analysis, rubric=rubric)
    with lock_when_free(folder):
        before = read_answers(folder)
        answer = next_answer(found, before, basis=find_basis(submission), where=where)
        write_answer(folder, answer)
    return answer


@dataclass(frozen=True, kw_only=True)
class JudgedNumbers:
    """The reported numbers by outcome, and what is needed for hints."""

    context: GradingContext
    flags: Sequence[Flag]
    disagree: tuple[str, ...]
    agree: tuple[str, ...]
    not_checked: tuple[str, ...]


def judge_numbers(submission: Submission, analysis: Analysis, *, rubric: Rubric) -> JudgedNumbers:
    """Judge every reported number as grading does.

    A number agrees if it loses no points in any criterion that judges it.

    Parameters
    ----------
    submission : submission that has the rubric's system; see `analyse_under`.
    """
    work, flags, _ = prepare_work(submission, analysis, rubric=rubric)
    agrees: dict[str, bool] = {}
    for criterion in rubric.criteria:
        if table := _TABLE.get(criterion.check):
            for name, right in judge(criterion, work).agrees.items():
                number = f"{table}.{name}"
                agrees[number] = right and agrees.get(number, True)
    reported = _list_reported(work.reported)
    entries = [number for number in agrees if number.startswith("state_space.")]
    listed = [n for n in reported if n != "state_space" or not entries] + entries
    return JudgedNumbers(
        context=work,
        flags=flags,
        disagree=tuple(n for n in listed if agrees.get(n) is False),
        agree=tuple(n for n in listed if agrees.get(n)),
        not_checked=tuple(n for n in listed if n not in agrees),
    )


def next_answer(
    found: JudgedNumbers,
    before: Sequence[CheckAnswer],
    *,
    basis: str,
    where: Collection[str] | None = None,
) -> CheckAnswer:
    """Return the answer to the next request.

    A number gets a hint only if the last answer said that it disagrees, and if nothing has been
    changed since.

    Parameters
    ----------
    basis : hash of everything that must stay the same for hints to be given; see `find_basis`.
    where : the numbers to give hints for; None for all numbers that may have a hint.
    """
    known: Collection[str] = ()
    if before and before[-1].basis == basis:
        known = before[-1].disagree
    hinted = [n for n in found.disagree if n in known and (where is None or n in where)]
    return CheckAnswer(
        ask=len(before) + 1,
        stage="where" if hinted else "which",
        basis=basis,
        disagree=found.disagree,
        agree=found.agree,
        not_checked=found.not_checked,
        unread=(
            *(part.message for part in found.context.submission.unread),
            *(f"{name}: {why}" for name, why in found.context.analysis.unreadable.items()),
        ),
        doubtful=tuple(found.context.bad),
        hints=tuple(find_hint(number, found.context, found.flags) for number in hinted),
    )


def _list_reported(reported: Reported) -> list[str]:
    """Return the keys of the reported numbers; A and B together count as one number."""
    found = [f"initial.{name}" for name in reported.initial]
    found += [f"final.{name}" for name in reported.final]
    if reported.state_space and (reported.state_space.A or reported.state_space.B):
        found.append("state_space")
    if loop := reported.feedback:
        for name in ("gains", "prefilter", "overshoot_percent", "settling_time"):
            if getattr(loop, name) not in (None, ()):
                found.append(f"feedback.{name}")
    return found


def _default_rubric(submission: Submission) -> Rubric:
    """Return the shipped rubric for this number of carts, with the submission's own system."""
    system = submission.system
    shipped = None if system.bench.rigid else shipped_rubric(system.carts)
    criteria = (
        Parameters(id="initial", check="initial", points=1),
        Parameters(id="final", check="final", points=1),
        StateModel(id="state", check="state_space", points=1),
        Gains(id="gains", check="gains", points=1),
        Claims(id="claims", check="claims", points=1),
        Prefilter(id="prefilter", check="prefilter", points=1),
    )
    return Rubric(version=1, system=system, criteria=shipped.criteria if shipped else criteria)


# Mistakes in reading a decay or a step. If a final table has one, the hint names decays and steps.
_OF_TIME_RECORDS: tuple[MistakeKind, ...] = ("peak_count", "log10_for_ln", "peak_for_steady_state")
# Mistakes that no part of a recording can show.
_OF_NO_RECORD: tuple[MistakeKind, ...] = ("physically_impossible", "no_fit_done")
_IN_FREQUENCY: tuple[ExperimentKind, ...] = ("sine", "sweep", "bode")
_OF_LOOP: dict[str, MistakeKind] = {
    "gains": "wrong_gains",
    "prefilter": "wrong_prefilter",
    "overshoot_percent": "claims_off",
    "settling_time": "claims_off",
}


def find_hint(number: str, context: GradingContext, flags: Sequence[Flag]) -> Hint:
    """Return a hint for a number that disagrees.

    Parameters
    ----------
    number : key of the number under `[reported]`, such as "final.K_1".
    flags : all flags of the submission, in the order of `CODES`.
    """
    table, _, name = number.partition(".")
    if table == "feedback":
        return Hint(number=number, slip=_OF_LOOP[name])
    if table == "state_space":
        return Hint(number=number, slip="wrong_state_space")
    slip, or_else = _find_slip(table, name, flags)
    return Hint(
        number=number,
        slip=slip,
        or_else=or_else,
        stretches=tuple(_find_stretches(table, name, slip, context.analysis)),
    )


def _find_slip(
    table: str, name: str, flags: Sequence[Flag]
) -> tuple[MistakeKind, tuple[MistakeKind, ...]]:
    mine = [flag for flag in flags if _is_about(flag, table, name)]
    # A mistake in one table is a better hint than a difference between the tables.
    mine.sort(key=lambda flag: flag.code == "initial_final_disagree")
    if not mine:
        return ("initial_off" if table == "initial" else "final_off"), ()
    others = mine[0].evidence.get("or_else", ())
    return mine[0].code, tuple(code for code in CODES if code in others)


def _is_about(flag: Flag, table: str, name: str) -> bool:
    if name not in flag.parameters:
        return False
    tables = {flag.evidence.get("table"), flag.evidence.get("also_in")}
    return table in tables or flag.code == "initial_final_disagree"


def _find_stretches(
    table: str, name: str, slip: MistakeKind, analysis: Analysis
) -> Iterator[RecordingPart]:
    """Yield the parts of recordings in which a mistake in a number can be seen."""
    if slip in _OF_NO_RECORD:
        return
    if table == "initial" or slip in _OF_TIME_RECORDS:
        own = list(_list_readings(name, analysis))
        if own:
            yield from _gather(own)
            return
    part: Part = "beginning" if slip == "transient_used" else "whole"
    kinds = _find_kinds(analysis)
    every: list[tuple[str, ExperimentKind, Part]] = [
        (run, kind, part) for run, kind in kinds.items()
    ]
    yield from _gather([one for one in every if one[1] in _IN_FREQUENCY] or every)


def _list_readings(name: str, analysis: Analysis) -> Iterator[tuple[str, ExperimentKind, Part]]:
    """Yield experiment, kind and part of each recording from which a first estimate is read."""
    read = read_name(name)
    if read.is_by_eye and read.suffix != "n":
        return
    cart = read.cart or 1
    if read.is_gain:
        for step in analysis.step_gains:
            if step.cart == cart and step.edges:
                window = step.edges[0].window_after
                yield step.experiment, "step", _name_part(step.experiment, window, analysis)
    else:
        kinds = _find_kinds(analysis)
        for decay in analysis.log_decrements:
            if decay.cart == cart:
                window = decay.release, float(decay.peak_t[-1])
                run = decay.experiment
                yield run, kinds.get(run, "decay"), _name_part(run, window, analysis)


def _find_kinds(analysis: Analysis) -> dict[str, ExperimentKind]:
    """Return the kind of every recording, and of each table that the students reduced."""
    kinds: dict[str, ExperimentKind] = {}
    for response in analysis.frequency_responses:
        kinds |= dict.fromkeys(response.experiments, "bode")
    for record in analysis.records:
        kinds[record.id] = record.kind
    return kinds


def _name_part(run: str, window: tuple[float, float], analysis: Analysis) -> Part:
    """Return the smallest of the six parts of a recording that contains a window of time."""
    record = next((one for one in analysis.records if one.id == run), None)
    if record is None:
        return "whole"
    length = float(record.t[-1] - record.t[0])
    start, end = ((float(t) - float(record.t[0])) / length for t in window)
    if end <= 0.3:
        return "beginning"
    if start >= 0.7:
        return "end"
    if end <= 0.55:
        return "first_half"
    if start >= 0.45:
        return "second_half"
    return "middle" if start >= 0.2 and end <= 0.8 else "whole"


def _gather(parts: Sequence[tuple[str, ExperimentKind, Part]]) -> Iterator[RecordingPart]:
    """Yield the parts; recordings of the same kind and part are named together."""
    order = [(kind, part) for kind in get_args(ExperimentKind) for part in get_args(Part)]
    for kind, part in order:
        runs = tuple(dict.fromkeys(run for run, k, p in parts if (k, p) == (kind, part)))
        if runs:
            yield RecordingPart(kind=kind, recordings=runs, part=part)
