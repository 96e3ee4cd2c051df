"""Grade one submission: its own recordings are analysed anew, nothing it brings is believed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction

from pipeline.errors import SubmissionError
from pipeline.grading.judge.checks import judge
from pipeline.grading.judge.costs import charge
from pipeline.grading.judge.work import Verdict, Work, missing_flag
from pipeline.grading.mistakes.controller import diagnose_controller, reported_controller
from pipeline.grading.mistakes.no_fit import copied_final
from pipeline.grading.mistakes.recordings import bad_runs, data_flag
from pipeline.grading.mistakes.reduced import diagnose_reduced
from pipeline.grading.mistakes.state_model import diagnose_state_space, state_models
from pipeline.grading.mistakes.tables import diagnose_tables
from pipeline.grading.references.reference import (
    in_doubt,
    in_scale,
    is_linear,
    recompute,
    trusted_chain,
)
from pipeline.grading.references.signs import turned_round
from pipeline.grading.references.springs import with_all_springs
from pipeline.grading.references.tolerance import exact, late_deduction, rounding, to_step
from pipeline.grading.rubric import Rubric
from pipeline.ingest.columns import conversion
from pipeline.results import Analysis
from pipeline.schemas.base import Units
from pipeline.schemas.grade import CODES, Criterion, Flag, Grade, Outcome
from pipeline.submission import Experiment, InputOverride, Reported, Submission, System
from pipeline.workflow import analyse


@dataclass(frozen=True, kw_only=True, eq=False)
class Graded:
    """A grade, and the analysis of the student's recordings it rests on (None where it failed)."""

    grade: Grade
    analysis: Analysis | None


def grade_submission(
    submission: Submission,
    *,
    rubric: Rubric,
    name: str,
    days_late: float = 0.0,
    progress: Callable[[str], None] | None = None,
) -> Graded:
    """Analyse a submission's recordings under the rubric's system and grade what it reports.

    Recordings that cannot be read are flagged. Where none can be, or the carts are
    not as many as the rubric's, the grade is `failed` with its reason.
    """

    def failed(reason: str) -> Graded:
        authors = tuple(author.id for author in submission.authors)
        grade = Grade.failed(
            name, reason, out_of=rubric.out_of, authors=authors, days_late=days_late
        )
        return Graded(grade=grade, analysis=None)

    count = submission.system.carts
    if count != rubric.system.carts:
        carts = f"{count} cart{'s' if count > 1 else ''}"
        reason = f"the submission is for {carts}, the rubric for {rubric.system.carts}"
        return failed(reason)
    submission, notes = under_rubric(submission, rubric)
    say = progress or (lambda text: None)
    try:
        analysis = analyse(submission, design=False, progress=say)
    except SubmissionError as error:
        return failed(str(error))
    analysis, springs = with_all_springs(submission, analysis, progress=say)
    if springs:
        asked = f"these recordings ask for springs that the rubric has not: {', '.join(springs)}"
        notes = (*notes, f"{asked}; judged with them")
    grade = grade_analysis(submission, analysis, rubric=rubric, name=name, days_late=days_late)
    grade = grade.model_copy(update={"springs": springs, "notes": (*notes, *grade.notes)})
    return Graded(grade=grade, analysis=analysis)


def grade_analysis(
    submission: Submission,
    analysis: Analysis,
    *,
    rubric: Rubric,
    name: str,
    days_late: float = 0.0,
) -> Grade:
    """Grade a submission against the analysis of its own recordings: a pure function.

    Parameters
    ----------
    submission : under the rubric's system, see `under_rubric`.
    """
    reported, signed = turned_round(submission.reported or Reported(), analysis.records)
    submission, n = submission.model_copy(update={"reported": reported}), rubric.system.carts
    measured, chain = in_scale(
        recompute(analysis),
        trusted_chain(analysis) if is_linear(analysis) else None,
        analysis=analysis,
        per_count=submission.system.position.per_count,
    )
    references = in_doubt(measured, analysis=analysis)
    diagnosis = diagnose_tables(
        reported,
        references=references,
        analysis=analysis,
        copied=copied_final(reported, references=measured),
    )
    tables = [{name: float(typed) for name, typed in reported.final.items() if typed > 0}]
    if diagnosis.corrected != tables[0]:
        tables.append(diagnosis.corrected)
    if chain is None and not diagnosis.possible:
        tables = []  # a model may well be right where its table was copied wrongly
    digits = {
        name: float(rounding(typed) / abs(Fraction(typed)))
        for name, typed in reported.final.items()
        if typed > 0
    }
    work = Work(
        submission=submission,
        analysis=analysis,
        rubric=rubric,
        references=references,
        controller=reported_controller(submission, analysis, chain=chain, tables=tables),
        state_models=state_models(
            tables, rounding=digits, known=references.final, chain=chain, n=n
        ),
        bad=bad_runs(analysis),
        named=diagnosis.named,
    )
    flags = sorted([*diagnosis.flags, *_flags(work)], key=lambda flag: CODES.index(flag.code))
    criteria = _criteria(work, flags)
    earned = sum((Fraction(str(c.points)) for c in criteria), Fraction(0))
    deducted = late_deduction(earned, late=rubric.late, step=rubric.step, days_late=days_late)
    return Grade(
        submission=name,
        authors=tuple(author.id for author in submission.authors),
        status="graded",
        points=float(earned - deducted),
        out_of=rubric.out_of,
        days_late=days_late,
        deducted=float(deducted),
        criteria=criteria,
        flags=tuple(flags),
        units=Units(position=analysis.position_unit, input=analysis.input_unit),
        notes=signed,
    )


def under_rubric(submission: Submission, rubric: Rubric) -> tuple[Submission, tuple[str, ...]]:
    """Return the submission with the rubric's system in the place of its own, and what to note.

    Where the rubric leaves a sign or a calibration open the submission's own stands. A length
    unit other than the rubric's is kept, as the students' numbers are in it; the calibration is
    converted.
    """
    own, set_ = submission.system, rubric.system
    notes = []
    unit, per_count = set_.position.unit, set_.position.per_count
    factor = None if own.position.unit == "count" else conversion(unit, own.position.unit)
    if factor is not None and own.position.unit != unit:
        unit = own.position.unit
        per_count = None if per_count is None else per_count * factor
        notes.append(f"lengths are in {unit}, as handed in; the rubric has {set_.position.unit}")
    if own.springs != set_.springs and set_.carts > 1:  # one cart has one stiffness
        notes.append("the springs are the rubric's, not those of the submission")
    system = System(
        carts=set_.carts,
        springs=set_.springs,
        input=set_.input.model_copy(
            update={
                "sign": set_.input.sign or own.input.sign,
                "per_count": set_.input.per_count or own.input.per_count,
            }
        ),
        position=set_.position.model_copy(
            update={"unit": unit, "per_count": per_count or own.position.per_count}
        ),
    )
    experiments = tuple(_under_calibration(e, set_) for e in submission.experiments)
    if experiments != submission.experiments:
        notes.append("the input's scale is the rubric's, also where a record states its own")
    update = {
        "system": system,
        "design": rubric.design or submission.design,
        "experiments": experiments,
    }
    return submission.model_copy(update=update), tuple(notes)


def _under_calibration(experiment: Experiment, system: System) -> Experiment:
    """Return the experiment without an input scale of its own where the rubric states one.

    Under feedback a bench may log another signal as its input, so there the record's own stands.
    Between its own sign and the rubric's the data decide, as everywhere.
    """
    own = experiment.input
    if own is None or experiment.kind == "closed_loop" or not system.input.per_count:
        return experiment
    return experiment.model_copy(update={"input": InputOverride(sign=own.sign)})


# ------------------------------------------------------------------ criteria and flags


def _criteria(work: Work, flags: Sequence[Flag]) -> tuple[Criterion, ...]:
    done: dict[str, Criterion] = {}
    for asked in work.rubric.criteria:
        parents = [done[p] for p in asked.requires if done[p].outcome in ("fail", "skip")]
        verdict = _waits_for(parents[0]) if parents else judge(asked, work)
        verdict = charge(verdict, asked, flags, rubric=work.rubric)
        points = to_step((verdict.share or 0) * exact(asked.points), work.rubric.step)
        outcome = _outcome(verdict.share, points, out_of=exact(asked.points))
        advised = outcome in ("partial", "fail") and not verdict.explained
        more = f" {asked.message}" if asked.message and advised else ""
        done[asked.id] = Criterion(
            id=asked.id,
            title=asked.title,
            outcome=outcome,
            points=float(points),
            out_of=asked.points,
            message=verdict.message + more,
            expected=verdict.expected,
            found=verdict.found,
        )
    return tuple(done.values())


def _waits_for(parent: Criterion) -> Verdict:
    how = "not passed" if parent.outcome == "fail" else "skipped"
    on = f"{parent.id!r} ({parent.title or parent.id})"
    return Verdict(share=None, message=f"Not checked: it builds on {on}, which was {how}.")


def _outcome(share: Fraction | None, points: Fraction, *, out_of: Fraction) -> Outcome:
    """Return how a criterion went, by the points it is given: what rounding forgives has passed."""
    if share is None:
        return "skip"
    return "pass" if points == out_of else "fail" if points == 0 else "partial"


def _flags(work: Work) -> list[Flag]:
    """Return the flags beside those of the parameter tables.

    A table of a bench that is not linear is of no one chain: what is made of it one way is not
    what is made of it another, and only what no chain can have is wrong.
    """
    flags, space, linear = [], work.reported.state_space, is_linear(work.analysis)
    if space is not None and space.A:
        n = work.rubric.system.carts
        entries = [entry for entry in work.entries if linear or entry.kind == "exact"]
        flags += diagnose_state_space(space, entries, models=work.state_models, n=n)
    if work.controller is not None and linear:
        flags += diagnose_controller(work.controller)
    flags += diagnose_reduced(work.analysis)
    if work.missing:
        flags.append(missing_flag(work.missing))
    if work.bad:
        flags.append(data_flag(work.bad))
    return flags
