"""Grade one submission against a new analysis of its own recordings.

Numbers that students computed are judged, but the analysis does not use them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import PipelineError, SubmissionError
from pipeline.grading.grade import CODES, Flag, Grade
from pipeline.grading.judge.award import award
from pipeline.grading.judge.checks import judge_with_undoing
from pipeline.grading.judge.context import GradingContext, Judgement, data_flag, missing_flag
from pipeline.grading.mistakes.controller import diagnose_controller, reported_controller
from pipeline.grading.mistakes.reduced import diagnose_reduced
from pipeline.grading.mistakes.state_model import diagnose_state_space, find_order, state_models
from pipeline.grading.mistakes.table_flags import copied_final
from pipeline.grading.mistakes.tables import diagnose_tables
from pipeline.grading.mistakes.undo import swapped_order
from pipeline.grading.reference import (
    in_doubt,
    in_scale,
    is_explained,
    is_followed,
    is_linear,
    recompute,
    trusted_chain,
)
from pipeline.grading.rubric import Rubric
from pipeline.grading.tolerance import rounding
from pipeline.grading.total import with_total
from pipeline.grading.true_bench import TrueBench, recordings_of_others
from pipeline.identify.recording_checks import find_bad_recordings, is_reversed
from pipeline.ingest.columns import conversion, is_count
from pipeline.names import read_name
from pipeline.results import Analysis, ChainFit, Record
from pipeline.submission import (
    Experiment,
    InputScale,
    PositionScale,
    Reported,
    ReportedFeedback,
    ReportedStateSpace,
    Submission,
    System,
)
from pipeline.submission.load import spring_names
from pipeline.words.progress import Progress, silent
from pipeline.workflow import analyse


@dataclass(frozen=True, kw_only=True, eq=False)
class Graded:
    """A grade, with its analysis and the judgements of its criteria.

    Attributes
    ----------
    analysis : analysis of the student's recordings; None if the grading failed.
    judgements : judgement of each criterion, even if a criterion that it requires was not passed;
        empty if the grading failed.
    """

    grade: Grade
    analysis: Analysis | None
    judgements: Mapping[str, Judgement] = field(default_factory=dict)


def grade_submission(
    submission: Submission,
    *,
    rubric: Rubric,
    name: str,
    days_late: float = 0.0,
    bench: str = "",
    progress: Progress = silent,
) -> Graded:
    """Analyse the recordings of a submission and grade what it reports.

    The analysis uses the rubric's system. Recordings that cannot be read are flagged. If none can
    be read, or the number of carts differs from the rubric's, the grade has the status `failed` and
    the reason.

    Parameters
    ----------
    bench : the team's bench in an answer key; see `HandIn`.
    """
    try:
        judged = analyse_under(submission, rubric=rubric, progress=progress)
    except SubmissionError as error:
        authors = tuple(author.id for author in submission.authors)
        given = {"out_of": rubric.out_of, "authors": authors, "days_late": days_late}
        return Graded(grade=Grade.failed(name, str(error), **given), analysis=None)
    springs, notes, analysis = judged.springs, judged.notes, judged.analysis
    if springs:
        lacking = "judged with springs that the recordings need but the rubric lacks"
        notes = (*notes, f"{lacking}: {', '.join(springs)}")
    graded = grade_analysis(
        judged.submission, analysis, rubric=rubric, name=name, days_late=days_late, bench=bench
    )
    more = {"springs": springs, "notes": (*notes, *graded.grade.notes)}
    return replace(graded, grade=graded.grade.model_copy(update=more))


@dataclass(frozen=True, kw_only=True, eq=False)
class Analysed:
    """A submission with the rubric's system, and the analysis of its recordings.

    Attributes
    ----------
    springs : springs that the recordings show but that are missing from the rubric.
    notes : one note for each setting of the submission that the rubric replaced.
    """

    submission: Submission
    analysis: Analysis
    springs: tuple[str, ...]
    notes: tuple[str, ...]


def analyse_under(
    submission: Submission, *, rubric: Rubric, progress: Progress = silent
) -> Analysed:
    """Analyse a submission's recordings under the rubric's system.

    Raises
    ------
    SubmissionError : no recording can be read, or the number of carts differs from the rubric's.
    """
    count = submission.system.carts
    if count != rubric.system.carts:
        carts = f"{count} cart{'s' if count > 1 else ''}"
        raise SubmissionError(
            f"the submission is for {carts}, the rubric for {rubric.system.carts}"
        )
    submission, notes = under_rubric(submission, rubric)
    analysis = analyse(submission, design=False, progress=progress)
    analysis, springs = with_all_springs(submission, analysis, progress=progress)
    return Analysed(submission=submission, analysis=analysis, springs=springs, notes=notes)


def grade_analysis(
    submission: Submission,
    analysis: Analysis,
    *,
    rubric: Rubric,
    name: str,
    days_late: float = 0.0,
    bench: str = "",
) -> Graded:
    """Grade a submission against the analysis of its own recordings, without any file access.

    Parameters
    ----------
    submission : submission with the rubric's system, from `under_rubric`.
    """
    work, flags, signed = prepare_work(submission, analysis, rubric=rubric, bench=bench)
    judgements = {one.id: judge_with_undoing(one, work) for one in rubric.criteria}
    criteria = award(rubric.criteria, judgements, flags, rubric=rubric)
    grade = Grade(
        submission=name,
        authors=tuple(author.id for author in submission.authors),
        status="graded",
        points=0.0,  # replaced below
        out_of=rubric.out_of,
        days_late=days_late,
        flags=flags,
        units=analysis.bench.units,
        notes=signed,
    )
    grade = with_total(grade, criteria, rubric=rubric)
    return Graded(grade=grade, analysis=analysis, judgements=judgements)


def prepare_work(
    submission: Submission, analysis: Analysis, *, rubric: Rubric, bench: str = ""
) -> tuple[GradingContext, tuple[Flag, ...], tuple[str, ...]]:
    """Return the input to the checks, all flags in the order of `CODES`, and notes.

    The notes say whether reported signs were reversed, because the recordings have the opposite
    sign, and whether the recordings contradict a stated unit.
    """
    reported, signed = accept_reversed_signs(submission.reported or Reported(), analysis.records)
    submission = submission.model_copy(update={"reported": reported})
    work, flags_so_far = _prepare(submission, analysis, rubric=rubric, bench=bench)
    more, meant = _flags(work)
    flags = sorted([*flags_so_far, *more], key=lambda flag: CODES.index(flag.code))
    units = (c.message for c in analysis.checks if c.kind in ("position_unit", "input_unit"))
    return replace(work, meant=meant), tuple(flags), (*signed, *units)


def _prepare(
    submission: Submission, analysis: Analysis, *, rubric: Rubric, bench: str
) -> tuple[GradingContext, tuple[Flag, ...]]:
    """Return the input to the checks, and the flags of the parameter tables."""
    reported, n = submission.reported or Reported(), rubric.system.carts
    measured, chain = in_scale(
        recompute(analysis),
        trusted_chain(analysis) if is_linear(analysis) else None,
        analysis=analysis,
        per_count=submission.system.position.per_count,
    )
    references = in_doubt(measured, analysis=analysis)
    bad, is_own, effects = find_bad_recordings(analysis), True, None
    if bench:
        true = TrueBench.read(bench, submission.system)
        effects = true.effects
        is_own = true.shows_in(measured)
        references = true.references(references, is_own=is_own)
        chain = true.chain if true.is_linear or not is_own else chain
        if not is_own:  # then they count as not handed in
            bad = recordings_of_others(analysis)
            submission = submission.model_copy(update={"experiments": ()})
    diagnosis = diagnose_tables(
        reported,
        references=references,
        analysis=analysis,
        copied=copied_final(reported, references=measured),
    )
    positive = {name: typed for name, typed in reported.final.items() if typed > 0}
    tables = [{name: float(typed) for name, typed in positive.items()}]
    if diagnosis.corrected != tables[0]:
        tables.append(diagnosis.corrected)
    if chain is None and not diagnosis.possible:
        tables = []  # the typed table is impossible, but the student's model may be right
    if not is_own:
        tables = []  # what follows from numbers of another bench is wrong for this one
    digits = {n: float(rounding(typed) / abs(Fraction(typed))) for n, typed in positive.items()}
    models = state_models(tables, rounding=digits, known=references.final, chain=chain, n=n)
    usual, space = tuple(range(2 * n)), reported.state_space
    order = find_order(space, models=models, n=n) if space and space.A else usual
    controller, gains_order = reported_controller(
        submission,
        analysis,
        chain=chain,
        tables=tables,
        orders=[order, *swapped_order(diagnosis.slipped["final"], n=n)],
    )
    work = GradingContext(
        submission=submission,
        analysis=analysis,
        rubric=rubric,
        references=references,
        controller=controller,
        state_models=models,
        bad=bad,
        named=diagnosis.named,
        slipped=diagnosis.slipped,
        order=order,
        gains_order=gains_order,
        effects=effects,
    )
    return work, diagnosis.flags


def under_rubric(submission: Submission, rubric: Rubric) -> tuple[Submission, tuple[str, ...]]:
    """Return a submission with the rubric's system, and notes on what was replaced.

    Only what is named here is replaced, so the recordings are read as the report reads them. If the
    rubric states no sign, calibration or columns, the submission's are kept.
    """
    own, set_ = submission.system, rubric.system
    position, input_ = _scale(own.position, set_.position), _scale(own.input, set_.input)
    notes = [
        f"{what} are in {scale['unit']}, as submitted; the rubric has {asked.unit}"
        for what, scale, asked in (
            ("lengths", position, set_.position),
            ("inputs", input_, set_.input),
        )
        if scale["unit"] != asked.unit
    ]
    # For a single cart, only the sum of the springs matters.
    if own.springs != set_.springs and set_.carts > 1:
        notes.append("the springs are the rubric's, not those of the submission")
    system = own.model_copy(
        update={
            "springs": set_.springs,
            "input": own.input.model_copy(
                update={**input_, "sign": set_.input.sign or own.input.sign}
            ),
            "position": own.position.model_copy(update=position),
            "columns": {**set_.columns, **own.columns},
        }
    )
    # A recording that the submission leaves out counts as not handed in.
    used = submission.used
    if len(used) < len(submission.experiments):
        notes.append("recordings that the submission leaves out count as not handed in")
    experiments = tuple(_under_calibration(e, set_) for e in used)
    if experiments != used:
        notes.append("the scale of the input is the rubric's, even if a recording states its own")
    update = {
        "system": system,
        "design": rubric.design or submission.design,
        "experiments": experiments,
    }
    return submission.model_copy(update=update), tuple(notes)


def _scale(own: PositionScale | InputScale, asked: PositionScale | InputScale) -> dict[str, Any]:
    """Return the unit and the size of a count, by the name of their keys.

    The submission's unit is kept, because the students' numbers use it, and the rubric's size of a
    count is converted to it. The rubric's unit is used only if it measures another quantity.
    """
    factor = conversion(asked.unit, own.unit)
    if factor is None and not is_count(asked.unit):
        return {"unit": asked.unit, "per_count": asked.per_count or own.per_count}
    per_count = factor * asked.per_count if factor and asked.per_count else own.per_count
    return {"unit": own.unit, "per_count": per_count}


def _under_calibration(experiment: Experiment, system: System) -> Experiment:
    """Remove the input scale of an experiment if the rubric states an input scale.

    A closed-loop run keeps its scale, because under feedback a bench may log another signal as its
    input. The experiment's sign is also kept; the analysis checks it against the data.
    """
    own = experiment.input
    if own is None or experiment.kind == "closed_loop" or not system.input.per_count:
        return experiment
    return experiment.model_copy(update={"input": own.model_copy(update={"per_count": None})})


# ------------------------------------------------------------------------------- flags


def _flags(context: GradingContext) -> tuple[list[Flag], Array | None]:
    """Return the flags that do not concern the parameter tables, and the gains that were meant.

    On a nonlinear bench, no single chain reproduces all recordings. Then only the zeros and ones of
    A and B are judged, and the controller is not.
    """
    flags, space, linear = [], context.reported.state_space, is_linear(context.analysis)
    meant = None
    if space is not None and space.A:
        n = context.rubric.system.carts
        entries = [entry for entry in context.entries if linear or entry.kind == "exact"]
        flags += diagnose_state_space(
            space, entries, models=context.state_models, n=n, order=context.order
        )
    if context.controller is not None and linear:
        of_loop, meant = diagnose_controller(context.controller)
        flags += of_loop
    flags += diagnose_reduced(context.analysis)
    if context.missing:
        flags.append(missing_flag(context.missing, context.rubric))
    if problems := context.problems:
        flags.append(data_flag(problems))
    return flags, meant


_NOTE = (
    "a positive input drives these carts towards negative x, so reported values with the opposite "
    "sign are read with the input reversed"
)


def accept_reversed_signs(
    reported: Reported, records: Sequence[Record]
) -> tuple[Reported, tuple[str, ...]]:
    """Return the numbers as reported on a bench that is not reversed, and a note if any changed.

    On a reversed bench, gains, B and the controller have the opposite sign in the log. Students may
    report them with this sign or as positive numbers; both are right.
    """
    if not is_reversed(records):
        return reported, ()
    turned = reported.model_copy(
        update={
            "initial": _gains(reported.initial),
            "final": _gains(reported.final),
            "state_space": _space(reported.state_space),
            "feedback": _feedback(reported.feedback),
        }
    )
    return turned, () if turned == reported else (_NOTE,)


def _gains(table: Mapping[str, Decimal]) -> dict[str, Decimal]:
    gains = {name: -value for name, value in table.items() if read_name(name).is_gain}
    return {**table, **gains} if gains and min(gains.values()) > 0 else dict(table)


def _space(space: ReportedStateSpace | None) -> ReportedStateSpace | None:
    if space is None or not any(space.B) or max(space.B) > 0:
        return space
    return space.model_copy(update={"B": tuple(-b if b else b for b in space.B)})


def _feedback(feedback: ReportedFeedback | None) -> ReportedFeedback | None:
    if feedback is None or feedback.prefilter is None or feedback.prefilter >= 0:
        return feedback
    gains = tuple(-gain for gain in feedback.gains)
    return feedback.model_copy(update={"gains": gains, "prefilter": -feedback.prefilter})


def with_all_springs(
    submission: Submission,
    analysis: Analysis,
    *,
    progress: Progress = silent,
) -> tuple[Analysis, tuple[str, ...]]:
    """Return the analysis with all springs, and the names of added springs, if the data need them.

    Otherwise, the analysis is returned unchanged. All springs are tried at once, because a spring
    that does not exist is fitted with zero stiffness. So no other set of springs can explain more.
    On a single cart, nothing is tried, because only the sum of the springs matters.
    """
    fit, springs = analysis.fit, submission.system.springs
    if analysis.bench.n == 1 or all(springs) or (fit is not None and is_explained(analysis)):
        return analysis, ()
    system = submission.system.model_copy(update={"springs": (True,) * len(springs)})
    try:
        other = analyse(
            submission.model_copy(update={"system": system}), design=False, progress=progress
        )
    except PipelineError:
        return analysis, ()
    if other.fit is None or not (
        is_explained(other)
        or (
            # Friction and similar effects increase χ² with any springs. Only a missing spring makes
            # it many times larger.
            fit is not None
            and fit.method == other.fit.method
            and fit.chi_square_per_dof > 10 * other.fit.chi_square_per_dof
            and is_followed(other)
        )
    ):
        return analysis, ()
    names = zip(spring_names(analysis.bench.n), springs, _certain(other.fit), strict=True)
    return other, tuple(name for name, asked, there in names if there and not asked)


def _certain(fit: ChainFit) -> list[bool]:
    """Return for each spring whether it certainly exists, even if the fit is not perfect."""
    wider = max(1.0, fit.chi_square_per_dof) ** 0.5
    std = dict(zip(fit.names, wider * np.sqrt(np.diag(fit.covariance)), strict=True))
    k = fit.chain.k
    # A spring fitted at zero has no standard error. The limits are high (ten standard errors, and a
    # share of the stiffest spring), because a delay or friction looks like a weak spring.
    least = [max(10 * std.get(f"k_{j + 1}", np.inf), 0.02 * k.max()) for j in range(k.size)]
    return [bool(stiffness > limit) for stiffness, limit in zip(k, least, strict=True)]
