"""The straight line from a submission to its analysis.

The stages that measure the carts stand in order in `identify/carts.py`, their fits in
`identify/fit.py`; what follows them is here.
"""

from collections.abc import Sequence
from dataclasses import replace

from pipeline.checks.carts import check_carts
from pipeline.checks.channels import check_channels, find_late_channels
from pipeline.checks.estimates import check_decays, check_rows, check_steps
from pipeline.checks.loops import check_loops, design_margins, verify_design
from pipeline.checks.recordings import (
    check_dwells,
    check_files,
    check_held,
    check_left_out,
    check_scales,
    check_setup,
    check_signs,
    check_units,
)
from pipeline.errors import DataError
from pipeline.estimation.interventions import find_interventions
from pipeline.identify.assumptions import list_assumptions
from pipeline.identify.carts import UNTIED
from pipeline.identify.log import Log, Progress
from pipeline.identify.remarks import hand_remarks, reading_remarks, turn_of_the_gains
from pipeline.identify.sound import identify_from_sound
from pipeline.ingest.read import read_data
from pipeline.names import by_note, parameter_names
from pipeline.results import Analysis, ChainFit, FeedbackDesign, HardwareCheck, LeftOut, Record
from pipeline.stages.compare import compare, why_open
from pipeline.stages.hardware_check import check_hardware
from pipeline.stages.state_feedback import design_feedback
from pipeline.submission import Design, Submission


def _silent(text: str) -> None:
    pass


def analyse(
    submission: Submission, *, design: bool = True, progress: Progress = _silent
) -> Analysis:
    """Run every stage that the submission's data support; the rest is skipped with its reason.

    Without `design` no controller is designed: see `reference_design`.

    Raises
    ------
    SubmissionError : none of the data files can be read.
    """
    system = submission.system
    position, drive = system.position.unit, system.input.unit
    log = Log()

    progress("reading the data")
    data = read_data(submission)
    for name, reason in data.unreadable.items():
        log.skip(f"reading {name}", reason)
    log.warn(reading_remarks(data, unit=position))

    interventions = find_interventions(data.records)
    log.warn(hand_remarks(interventions, records=data.records))
    found, left_out = identify_from_sound(
        data, interventions=interventions, system=system, progress=progress
    )
    log.add(found.log)
    wrong = {one.experiment for one in left_out if one.is_wrong}
    sound = [record for record in data.records if record.id not in wrong]
    fit, final = found.fit, found.fit.parameters if found.fit else {}
    if fit and not final:
        log.skip("named parameters", UNTIED)
    for name, estimate in final.items():
        if reason := why_open(name, estimate):
            log.skip(f"final {name}", reason)
    rows = compare(
        found.initial,
        final=final,
        names=list(final) or parameter_names(system.carts, rigid=system.rigid),
        position_unit=position,
        input_unit=drive,
        fitted_to=fit.experiments if fit else (),
    )
    late = find_late_channels(sound, carts=system.carts)
    signs = check_signs(data.signs, without=wrong)
    checks = [
        *signs,
        *check_files(data.unreadable),
        *check_units(data.records, system=system),
        *check_scales(sound, system=system),
        *check_left_out(left_out, records=data.records),
        *check_setup(data.records),
        *check_held(data.records),
        *check_dwells(data.records, found.sines),
        *check_channels(late),
        *found.repeats.checks,
        *check_rows(rows),
        *check_decays(found.decays, records=data.records, position_unit=position),
        *check_steps(found.gains, decays=found.decays, gain_unit=f"{position}/{drive}"),
        *check_carts(fit, springs=system.springs),
    ]

    feedback = None
    if design:
        progress("state feedback")
        feedback = _design(submission, fit, log=log)
    if feedback and fit:
        margins = log.attempt("margins", design_margins, fit.chain, feedback)
        feedback = replace(feedback, margins=margins)
        checks.append(verify_design(fit.chain, feedback))
        log.warn([] if signs else turn_of_the_gains(data.records))
    progress("hardware against model")
    hardware = _hardware(submission, data.records, fit, left_out=left_out, log=log)
    checks += check_loops(hardware)

    return Analysis(
        title=submission.title,
        section=submission.section,
        authors=tuple((author.id, author.name) for author in submission.authors),
        carts=system.carts,
        springs=system.springs,
        position_unit=position,
        input_unit=drive,
        records=data.records,
        log_decrements=tuple(found.decays),
        step_gains=tuple(found.gains),
        sine_points=tuple(found.sines),
        frequency_responses=tuple(found.responses),
        tables=tuple(data.tables),
        fit=fit,
        rows=rows,
        checks=tuple(checks),
        feedback=feedback,
        hardware=tuple(hardware),
        skipped=tuple(log.skipped),
        warnings=tuple(log.warnings),
        files=data.files,
        unreadable=data.unreadable,
        unexplained={name: one.share for name, one in found.fitted.fits.items()},
        discussion=submission.discussion,
        left_out=tuple(left_out),
        late_channels=late,
        reported=submission.typed,
        assumptions=list_assumptions(submission, data=data, fit=fit, checks=checks),
    )


# ----------------------------------------------- what rests on the carts


def reference_design(submission: Submission, fit: ChainFit | None) -> FeedbackDesign:
    """Return the state feedback for the submission's task on the carts as they were identified.

    Raises
    ------
    DataError : they are not identified well enough to design for.
    """
    if fit is None:
        raise DataError("the carts are not identified")
    if not fit.converged:
        raise DataError(f"the fit of the carts did not converge: {fit.message}")
    task = submission.design or Design(cart=submission.system.carts)
    return design_feedback(fit.chain, **dict(task))


def _design(submission: Submission, fit: ChainFit | None, *, log: Log) -> FeedbackDesign | None:
    if submission.design is None:
        log.skip(
            "state feedback",
            "no goal is stated: add a [design] table to submission.toml",
            missing="a [design] table with the goal of the controller",
        )
        return None
    return log.attempt("state feedback", reference_design, submission, fit)


def _hardware(
    submission: Submission,
    records: Sequence[Record],
    fit: ChainFit | None,
    *,
    left_out: Sequence[LeftOut],
    log: Log,
) -> list[HardwareCheck]:
    runs = {record.id: record for record in records if record.kind == "closed_loop"}
    if not runs or fit is None:
        if runs:
            log.skip("hardware check", "the carts are not identified")
        else:
            reason = "no closed-loop run was recorded"
            log.skip("hardware check", reason, missing="a closed-loop run")
        return []
    for one in left_out:
        if runs.pop(one.experiment, None):
            log.skip(f"hardware check, {one.experiment}", f"it is left out: {one.reason}")
    checks: list[HardwareCheck] = []
    for experiment in [one for one in submission.experiments if one.id in runs]:
        found = log.attempt(
            f"hardware check, {experiment.id}",
            check_hardware,
            runs[experiment.id],
            fit.chain,
            controller=experiment.controller,
            controlled_cart=experiment.controlled_cart,
            input_limit=submission.design.input_limit if submission.design else None,
        )
        checks += found or ()
    log.warn(
        by_note((f"{c.experiment}, cart {c.cart}", c.note) for c in checks if not c.contradicted)
    )
    return checks
