"""Check the numbers of a submission as grading does; the answer never contains a value."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from pipeline.errors import SubmissionError
from pipeline.grading.grade import Flag
from pipeline.grading.judge.checks import judge
from pipeline.grading.judge.context import GradingContext
from pipeline.grading.judge.run import analyse_under, prepare_work
from pipeline.grading.rubric import Claims, Gains, Parameters, Prefilter, Rubric, StateModel
from pipeline.grading.rubric_file import shipped_rubric
from pipeline.grading.self_check.hints import find_hint
from pipeline.grading.self_check.log import CheckAnswer, find_basis, read_answers, write_answer
from pipeline.lock import lock_when_free
from pipeline.results import Analysis
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
