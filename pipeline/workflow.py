"""The workflow from a submission to its analysis.

`identify/identify.py` lists the stages that measure the carts, and `identify/fit.py` the fits.
The later steps are in this module.
"""

from dataclasses import replace
from functools import partial

from pipeline.errors import DataError
from pipeline.estimation.estimates import list_off
from pipeline.estimation.force_balance import find_interventions
from pipeline.estimation.hardware_check import check_hardware
from pipeline.estimation.state_feedback import design_feedback
from pipeline.identify.assumptions import list_assumptions
from pipeline.identify.findings import valid_records
from pipeline.identify.groups import check_groups, find_groups, name_groups
from pipeline.identify.identify import compare_estimates, identify_with_rejection
from pipeline.identify.log import Log
from pipeline.identify.model_checks import (
    check_carts,
    check_coverage,
    check_decays,
    check_loops,
    check_rows,
    check_steps,
    design_margins,
    verify_design,
)
from pipeline.identify.recording_checks import (
    check_recordings,
    find_late_channels,
    gain_sign_warning,
    hand_remarks,
    reading_remarks,
)
from pipeline.identify.springs import check_springs
from pipeline.ingest.read import Ingested, read_data
from pipeline.plant.chain import Chain
from pipeline.results import (
    Analysis,
    ChainFit,
    FeedbackDesign,
    HardwareCheck,
    Intervention,
    RecordingGroup,
    Stage,
)
from pipeline.submission import Design, Submission
from pipeline.words.numbers import group_messages, join_names
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent

_WORDS = phrases("skipped")


def analyse(
    submission: Submission, *, design: bool = True, progress: Progress = silent
) -> Analysis:
    """Run every stage for which the submission has data; skip all other stages and record why.

    Without `design`, no controller is designed; see `reference_design`.

    Raises
    ------
    SubmissionError : none of the data files can be read.
    """
    bench, log = submission.system.bench, Log()

    progress("reading the data")
    data, interventions = _read(submission, log=log)

    found, left_out = identify_with_rejection(
        data, interventions=interventions, bench=bench, progress=progress
    )
    rows = compare_estimates(found, bench=bench)
    log.add(found.log)
    used = valid_records(data.records, left_out)
    late = find_late_channels(used, carts=bench.n)
    checks = (
        *check_recordings(data, left_out=left_out, sines=found.sines, late=late, bench=bench),
        *found.repeats.checks,
        *check_rows(rows),
        *check_coverage(rows),
        *check_decays(found.decays, records=data.records, bench=bench),
        *check_steps(found.gains, decays=found.decays, bench=bench),
        *check_carts(found.fit, decays=found.decays, bench=bench),
    )
    springs = check_springs(
        found.fit, responses=found.responses, gains=found.gains, records=used, bench=bench
    )
    groups: tuple[RecordingGroup, ...] = ()
    if not springs:
        groups = found.fitted.groups or find_groups(
            found.fit,
            fits=found.fitted.fits,
            decays=found.decays,
            records=used,
            rows=rows,
            bench=bench,
        )
        groups = name_groups(groups, data.records)
    checks = (
        *springs,
        *check_groups(groups),
        # With wrong springs, what the fit lacks says nothing.
        *(check for check in checks if not (springs and check.kind == "vanishing")),
    )

    analysis = Analysis(
        title=submission.title,
        section=submission.section,
        authors=tuple((author.id, author.name) for author in submission.authors),
        bench=bench,
        records=data.records,
        log_decrements=tuple(found.decays),
        step_gains=tuple(found.gains),
        sine_points=tuple(found.sines),
        frequency_responses=tuple(found.responses),
        tables=tuple(data.tables),
        fit=found.fit,
        rows=rows,
        checks=checks,
        feedback=None,
        hardware=(),
        skipped=(),
        warnings=(),
        files=data.files,
        unreadable=data.unreadable,
        unread=(*filter(None, [data.misnamed]), *(part.message for part in submission.unread)),
        unexplained={name: one.share for name, one in found.fitted.fits.items()},
        discussion=submission.discussion,
        left_out=tuple(left_out),
        groups=groups,
        late_channels=late,
        reported=submission.typed,
        reported_off=list_off(rows, submission.typed),
        assumptions=list_assumptions(submission, data=data, fit=found.fit, checks=checks),
    )
    return _with_loops(analysis, submission, design=design, progress=progress, log=log)


def _read(submission: Submission, *, log: Log) -> tuple[Ingested, tuple[Intervention, ...]]:
    """Return the data, and the intervals in which an unmeasured force moved a cart."""
    data = read_data(submission)
    for name, reason in data.unreadable.items():
        log.skip(Stage.READING, reason, run=name)
    log.warn([f"not used, because it cannot be read: {part.message}" for part in submission.unread])
    log.warn([data.misnamed])
    log.warn(reading_remarks(data, unit=submission.system.bench.units.position))
    used = {one.id for one in submission.used}
    left_out = [one.id for one in submission.experiments if one.id not in used]
    if left_out:
        log.warn([_WORDS.text("stated_left_out", runs=join_names(left_out))])
    interventions = find_interventions(data.records)
    log.warn(hand_remarks(interventions, records=data.records))
    return data, interventions


# -------------------------------------------------- stages that use the fitted carts


def _with_loops(
    analysis: Analysis, submission: Submission, *, design: bool, progress: Progress, log: Log
) -> Analysis:
    """Add the designed loop, the checks of recorded loops and the log's notes to the analysis."""
    fit, feedback, checks = analysis.fit, None, list(analysis.checks)
    if design:
        progress("state feedback")
    if design and submission.design is None:
        log.skip(Stage.STATE_FEEDBACK, _WORDS.text("no_goal"), missing=_WORDS.text("goal"))
    elif design:
        design_loop = partial(reference_design, submission, fit)
        feedback = log.attempt(Stage.STATE_FEEDBACK, design_loop)
    if feedback and fit:
        margins = log.attempt(Stage.MARGINS, partial(design_margins, fit.chain, feedback))
        on_bench = partial(design_margins, fit.chain, feedback, on_bench=True)
        bench_margins = margins and log.attempt(Stage.MARGINS, on_bench)
        feedback = replace(feedback, margins=margins, bench_margins=bench_margins)
        checks.append(verify_design(fit.chain, feedback))
        if not any(check.kind == "input" for check in checks):
            log.warn(gain_sign_warning(analysis.records))
    progress("hardware against model")
    hardware = _hardware(submission, analysis, log=log)
    return replace(
        analysis,
        checks=(*checks, *check_loops(hardware)),
        feedback=feedback,
        hardware=tuple(hardware),
        skipped=tuple(log.skipped),
        warnings=tuple(log.warnings),
    )


def reference_design(submission: Submission, fit: ChainFit | None) -> FeedbackDesign:
    """Design the state feedback that the submission asks for, for the identified carts.

    Raises
    ------
    DataError : the carts are not identified well enough for a design.
    """
    task = submission.design or Design(cart=submission.system.carts)
    return design_feedback(_identified(fit), task)


def _identified(fit: ChainFit | None) -> Chain:
    """Return the fitted carts.

    Raises
    ------
    DataError : there is no fit, or it failed.
    """
    if fit is None:
        raise DataError(_WORDS.text("no_carts"))
    if not fit.converged:
        raise DataError(_WORDS.text("no_carts_fit_failed", message=fit.message))
    return fit.chain


def _hardware(submission: Submission, analysis: Analysis, *, log: Log) -> list[HardwareCheck]:
    """Return how each recorded loop compares with a simulation of the fitted carts."""
    runs = {record.id: record for record in analysis.records if record.kind == "closed_loop"}
    if not runs:
        log.skip(Stage.HARDWARE_CHECK, _WORDS.text("no_loop"), missing=_WORDS.text("loop"))
        return []
    chain = log.attempt(Stage.HARDWARE_CHECK, partial(_identified, analysis.fit))
    if chain is None:
        return []
    for one in analysis.left_out:
        if runs.pop(one.experiment, None):
            reason = _WORDS.text("left_out", reason=one.reason)
            log.skip(Stage.HARDWARE_CHECK, reason, run=one.experiment)
    checks: list[HardwareCheck] = []
    for experiment in [one for one in submission.experiments if one.id in runs]:
        compare_run = partial(
            check_hardware,
            runs[experiment.id],
            chain,
            controller=experiment.controller,
            controlled_cart=experiment.controlled_cart,
            input_limit=submission.design.input_limit if submission.design else None,
        )
        checks += log.attempt(Stage.HARDWARE_CHECK, compare_run, of=experiment.id) or ()
    log.warn(
        group_messages(
            (f"{c.experiment} (cart {c.cart})", c.note) for c in checks if not c.contradicted
        )
    )
    return checks
