"""The straight line from a submission to its analysis: the only file that knows the order."""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import ParamSpec, TypeVar

import numpy as np

from pipeline.errors import DataError
from pipeline.ingest.read import Ingested, read_data
from pipeline.ingest.signs import contradictions
from pipeline.plant.chain import Chain, parameter_names
from pipeline.results import (
    Analysis,
    ChainFit,
    Estimate,
    FeedbackDesign,
    FrequencyResponse,
    HardwareCheck,
    LeftOut,
    LogDecrement,
    Record,
    SinePoint,
    Skipped,
    StepGain,
)
from pipeline.stages.bode_fit import fit_bode
from pipeline.stages.compare import (
    CHI_SQUARE_LIMIT,
    NOT_IDENTIFIED,
    check_chain,
    check_decays,
    check_dwells,
    check_files,
    check_rows,
    check_setup,
    check_steps,
    compare,
    why_open,
)
from pipeline.stages.design_check import design_margins, verify_design
from pipeline.stages.encoder_units import find_other_units
from pipeline.stages.faults import (
    Followed,
    check_left_out,
    find_faults,
    follow,
    follows,
    standing_still,
)
from pipeline.stages.frequency_response import (
    collect_dwells,
    dwell_fault,
    find_resonances,
    response_from_records,
)
from pipeline.stages.hardware_check import check_hardware
from pipeline.stages.initial import estimate_initially
from pipeline.stages.log_decrement import fit_log_decrement
from pipeline.stages.repeated_numbers import Repeats, compare_repeats
from pipeline.stages.repeats import find_outlier_repeats
from pipeline.stages.sine import FEW_COUNTS, Dwell
from pipeline.stages.state_feedback import design_feedback
from pipeline.stages.step_gain import fit_step_gain
from pipeline.stages.time_fit import fit_records
from pipeline.submission import Design, Submission, System

P = ParamSpec("P")
T = TypeVar("T")
Progress = Callable[[str], None]

_ROUNDS = 3  # of leaving out what the carts found without it show to be wrong
_LISTED = 4  # more runs than these are not named one by one
_UNTIED = "no spring ties the carts to a wall: they rest anywhere and have no static gain"


def _silent(text: str) -> None:
    pass


@dataclass
class _Log:
    """What could not run and what a reader must know, collected along the way."""

    skipped: list[Skipped] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def attempt(
        self, stage: str, run: Callable[P, T], *args: P.args, **options: P.kwargs
    ) -> T | None:
        """Run one stage; data that do not support it are a reason, not an end."""
        try:
            return run(*args, **options)
        except DataError as error:
            self.skip(stage, str(error))
            return None

    def skip(self, stage: str, reason: str) -> None:
        self.skipped.append(Skipped(stage=stage, reason=reason))

    def warn(self, texts: Iterable[str]) -> None:
        self.warnings += [text for text in texts if text and text not in self.warnings]

    def add(self, other: "_Log") -> None:
        self.skipped += other.skipped
        self.warn(other.warnings)


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
    n, springs = system.carts, system.springs
    log = _Log()

    progress("reading the data")
    data = read_data(submission)
    for name, reason in data.unreadable.items():
        log.skip(f"reading {name}", reason)
    log.warn(data.warnings)
    log.warn(_by_note((record.id, note) for record in data.records for note in record.notes))
    found, left_out = _identify_from_sound(data, system=system, progress=progress)
    log.add(found.log)
    log.warn(contradictions(data.signs, without={one.experiment for one in left_out}))
    fit = found.fit
    final = fit.parameters if fit else {}
    if fit and not final:
        log.skip("named parameters", _UNTIED)
    for name, estimate in final.items():
        if reason := why_open(name, estimate):
            log.skip(f"final {name}", reason)
    rows = compare(
        found.initial,
        final=final,
        names=list(final) or parameter_names(n, rigid=system.rigid),
        position_unit=system.position.unit,
        input_unit=system.input.unit,
    )
    checks = [
        *check_files(data.unreadable),
        *check_setup(data.records),
        *check_dwells(data.records, found.sines),
        *check_left_out(left_out),
        *found.repeats.checks,
        *check_rows(rows),
        *check_decays(found.decays, position_unit=system.position.unit),
        *check_steps(found.gains, gain_unit=f"{system.position.unit}/{system.input.unit}"),
    ]
    checks += check_chain(fit, springs=springs) if fit else [NOT_IDENTIFIED]

    feedback = None
    if design:
        progress("state feedback")
        feedback = _design(submission, fit, log=log)
    if feedback and fit:
        margins = log.attempt("margins", design_margins, fit.chain, feedback)
        feedback = replace(feedback, margins=margins)
        checks.append(verify_design(fit.chain, feedback))
    if feedback and is_reversed(data.records):
        log.warn(
            [
                "state feedback: the gains are for an input that pushes cart 1 towards positive x; "
                "the bench's own input pushes the other way, so negate what the controller sends"
            ]
        )
    progress("hardware against model")
    hardware = _hardware(submission, data.records, fit, log=log)

    return Analysis(
        title=submission.title,
        section=submission.section,
        authors=tuple((author.id, author.name) for author in submission.authors),
        carts=n,
        springs=springs,
        position_unit=system.position.unit,
        input_unit=system.input.unit,
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
        discussion=submission.discussion,
        left_out=tuple(left_out),
    )


# ---------------------------------------------------------- from records to carts


@dataclass(frozen=True, kw_only=True, eq=False)
class _Identified:
    """What the stages make of some records, up to the fit."""

    decays: Sequence[LogDecrement]
    gains: Sequence[StepGain]
    sines: Sequence[SinePoint]
    responses: Sequence[FrequencyResponse]
    repeats: Repeats
    initial: dict[str, Estimate]
    fit: ChainFit | None
    log: _Log


def _identify_from_sound(
    data: Ingested, *, system: System, progress: Progress
) -> tuple[_Identified, list[LeftOut]]:
    """Identify the carts without the records that they, or their repeats, show to be wrong.

    Records in which a reading stands still bear no witness until the carts that the others show
    say that it may.
    """
    driven = [r for r in data.records if r.kind in ("step", "sweep")]
    unit = system.position.unit
    odd = find_outlier_repeats(driven, unit=unit)
    # What the encoder's own step, later the numbers of repeats show to be odd.
    numbers = find_other_units(data.records)
    odd |= numbers
    without, contradicted = odd.keys() | standing_still(data.records), []
    found = _identify(data, without=without, system=system, progress=progress)
    chain, fits = _witness(found, data.records, system=system)
    faults = find_faults(data.records, chain=chain, fits=fits)
    for _ in range(_ROUNDS):
        numbers |= found.repeats.odd
        # Most repeats may be the wrong ones: who is odd shows among the others.
        sound = [record for record in driven if record.id not in faults]
        odd = {**find_outlier_repeats(sound, unit=unit), **numbers}
        if without == odd.keys() | faults.keys():
            break
        without = odd.keys() | faults.keys()
        contradicted += [
            check
            for check in found.repeats.checks
            if check.outcome == "fail"
            and check.id.removeprefix("repeats.") not in found.repeats.undecided
        ]
        found = _identify(data, without=without, system=system, progress=progress)
        # Where nothing is left to identify the carts from, the verdict before stands.
        if (verdict := _witness(found, data.records, system=system))[0]:
            chain, fits = verdict
        faults = find_faults(data.records, chain=chain, fits=fits)
    checks = {check.id: check for check in (*found.repeats.checks, *contradicted)}
    repeats = replace(found.repeats, checks=tuple(checks.values()))
    left_out = {**odd, **faults}
    return (
        replace(found, repeats=repeats),
        [left_out[record.id] for record in data.records if record.id in left_out],
    )


def _witness(
    found: _Identified, records: Sequence[Record], *, system: System
) -> tuple[Chain | None, dict[str, Followed]]:
    """Return the chain that the records follow, and how; or would, with two columns exchanged."""
    chain = found.fit.chain if found.fit else None
    fits = follow(records, chain)
    if chain and follows(fits):
        return chain, fits
    for i, j in combinations(sorted(response.cart for response in found.responses), 2):
        turned = [replace(r, cart={i: j, j: i}.get(r.cart, r.cart)) for r in found.responses]
        try:
            fit = fit_bode(
                sorted(turned, key=lambda response: response.cart),
                n=system.carts,
                springs=system.springs,
            )
        except DataError:
            continue
        if fit.chi_square_per_dof <= CHI_SQUARE_LIMIT:
            return fit.chain, follow(records, fit.chain)
    return chain, fits


def _identify(
    data: Ingested, *, without: Set[str], system: System, progress: Progress
) -> _Identified:
    """Take the records, but for those without, through the stages up to the fit."""
    n, springs, log = system.carts, system.springs, _Log()
    records = [record for record in data.records if record.id not in without]
    driven = _driven(records, n=n, log=log)

    progress("free decays: logarithmic decrement")
    decays = _log_decrements(records, springs=springs, log=log)
    progress("steps: static gains")
    gains = _step_gains(driven, system=system, log=log)
    progress("sine dwells: steady state")
    sines = _sine_points(records, log=log)
    # What a check says of a decay or a step in full is not said twice.
    log.warn(
        _by_note(
            [
                *((f"{d.experiment}, cart {d.cart}", d.note) for d in decays if not _sticks(d)),
                *((f"{g.experiment}, cart {g.cart}", g.note) for g in gains if not g.interval),
                *((f"{p.experiment}, cart {p.cart}", p.note) for p in sines),
            ]
        )
    )
    progress("frequency response")
    responses = _frequency_response(data, sines=sines, driven=driven, log=log)
    resonances = _resonances(responses, system=system, log=log)
    measured = estimate_initially(carts=n, log_decrements=decays, step_gains=gains)

    progress("fitting all carts at once")
    fit, dwells_follow = None, False
    if _is_seen(n, records, responses):
        fit, dwells_follow = _fit(
            responses,
            dwells=[record for record in records if record.kind == "sine"],
            driven=driven,
            initial={**resonances, **measured},
            n=n,
            springs=springs,
            log=log,
        )
    else:
        log.skip("final estimates", f"cart {n} moves in no recording: is `carts = {n}` right?")
    fitted = fit.parameters if fit and fit.converged else {}
    repeats = compare_repeats(
        decays, gains, carts=n, fitted=fitted, dwells=fitted if dwells_follow else {}
    )
    agreed = {name: one for name, one in measured.items() if name not in repeats.undecided}
    return _Identified(
        decays=decays,
        gains=gains,
        sines=sines,
        responses=responses,
        repeats=repeats,
        initial={**resonances, **agreed},
        fit=fit,
        log=log,
    )


def _by_note(notes: Iterable[tuple[str, str]]) -> list[str]:
    """Return one sentence a note, headed by all the runs it is about."""
    runs: dict[str, list[str]] = {}
    for run, note in notes:
        if note:
            runs.setdefault(note, []).append(run)
    return [f"{_listed(list(dict.fromkeys(ids)))}: {note}" for note, ids in runs.items()]


def _counted(carts: Sequence[int]) -> str:
    return ("cart " if len(carts) == 1 else "carts ") + ", ".join(map(str, carts))


def _listed(ids: Sequence[str]) -> str:
    if len(ids) <= _LISTED:
        return ", ".join(ids)
    return f"{ids[0]}, {ids[1]} … {ids[-1]} ({len(ids)} runs)"


def _driven(records: Sequence[Record], *, n: int, log: _Log) -> list[Record]:
    """Return the steps and sweeps of all carts together.

    Runs of single carts are left to the initial estimates, so that initial and final estimates
    come from different data and comparing them is a check.
    """
    runs = [r for r in records if r.kind in ("step", "sweep") and r.u is not None]
    runs = [r for r in runs if len(r.free) == n]
    log.warn(
        _by_note(
            (run.id, f"all carts are free, but of {n} only {_counted(run.carts)} was recorded")
            for run in runs
            if len(run.carts) < n
        )
    )
    return runs


def _is_seen(cart: int, records: Sequence[Record], responses: Sequence[FrequencyResponse]) -> bool:
    """Whether a cart moves in any recording: a last one that does not may not be there."""
    return cart in {response.cart for response in responses} or any(
        cart in record.carts and np.ptp(record.position(cart)) > 0 for record in records
    )


def _log_decrements(
    records: Sequence[Record], *, springs: Sequence[bool], log: _Log
) -> list[LogDecrement]:
    """Each cart alone: its decays, or the ring-down of its steps where there is no decay."""
    decays = []
    for cart, (before, after) in enumerate(pairwise(springs), start=1):
        if not (before or after):
            log.skip(f"log decrement, cart {cart}", f"no spring holds cart {cart}: it cannot swing")
            continue
        alone = [r for r in records if r.free == (cart,) and cart in r.carts]
        runs = [r for r in alone if r.kind == "decay"] or [r for r in alone if r.kind == "step"]
        if not runs:
            log.skip(
                f"log decrement, cart {cart}",
                f"no decay was recorded in which cart {cart} alone is free",
            )
        for run in runs:
            decay = log.attempt(
                f"log decrement, {run.id}, cart {cart}", fit_log_decrement, run, cart=cart
            )
            if decay:
                decays.append(decay)
    return decays


def _sticks(decay: LogDecrement) -> bool:
    return decay.friction is not None and decay.friction.present


def _step_gains(driven: Sequence[Record], *, system: System, log: _Log) -> list[StepGain]:
    if not system.tied:
        log.skip("step gain", _UNTIED)
        return []
    runs = [record for record in driven if record.kind == "step"]
    if not runs:
        log.skip("step gain", "no step was recorded with all carts free")
    gains = []
    for run in runs:
        for cart in run.carts:
            gain = log.attempt(f"step gain, {run.id}, cart {cart}", fit_step_gain, run, cart=cart)
            if gain:
                gains.append(gain)
    return gains


def _sine_points(records: Sequence[Record], *, log: _Log) -> list[SinePoint]:
    points = []
    for run in records:
        dwell = Dwell(run)
        for cart in run.carts if run.kind == "sine" else ():
            stage = f"sine steady state, {run.id}, cart {cart}"
            point = log.attempt(stage, dwell.fit, cart=cart)
            if point and (fault := dwell_fault(point)):
                log.skip(stage, fault)
            elif point:
                points.append(point)
    return points


def _frequency_response(
    data: Ingested,
    *,
    sines: Sequence[SinePoint],
    driven: Sequence[Record],
    log: _Log,
) -> Sequence[FrequencyResponse]:
    """From dwells; else from the students' own table; else from steps and sweeps."""
    if sines:
        return collect_dwells(sines)
    if data.tables:
        return data.tables
    if not any(record.kind == "sine" for record in data.records):
        log.skip("sine steady state", "no sine dwells were recorded")
    if not driven:
        log.skip(
            "frequency response", "no usable dwell, no table, and no step or sweep to take it from"
        )
        return ()
    responses = log.attempt("frequency response", response_from_records, driven)
    if responses:
        log.warn(["the frequency response comes from the step and sweep records, not from dwells"])
    return responses or ()


def _resonances(
    responses: Sequence[FrequencyResponse], *, system: System, log: _Log
) -> dict[str, Estimate]:
    if not system.tied:
        log.skip("resonances", f"{_UNTIED}, and the slowest mode is no resonance")
        return {}
    return log.attempt("resonances", find_resonances, responses, n=system.carts) or {}


def _fit(
    responses: Sequence[FrequencyResponse],
    *,
    dwells: Sequence[Record],
    driven: Sequence[Record],
    initial: dict[str, Estimate],
    n: int,
    springs: tuple[bool, ...],
    log: _Log,
) -> tuple[ChainFit | None, bool]:
    """The Bode fit where the dwells follow it or there is a table, else the joint fit in time.

    Return also whether there are dwells and they follow it.
    """
    has_points = any(response.source != "records" for response in responses)
    fit, by_fit, doubted = None, {}, False
    if has_points:
        values = {name: estimate.value for name, estimate in initial.items()}
        fit = log.attempt(
            "Bode fit",
            fit_bode,
            responses,
            n=n,
            springs=springs,
            initial=values,
            decays=_decay_dampings(initial, n=n),
        )
        by_fit = follow(dwells, fit.chain if fit else None)
        doubted = fit is not None and fit.chi_square_per_dof > CHI_SQUARE_LIMIT
        doubted = doubted and _are_coarse(dwells)
        if fit and (not driven or (follows(by_fit) and not doubted)):
            return fit, follows(by_fit) and bool(dwells)
    if not driven:
        found = "the Bode fit gave none, and there is no" if has_points else "no dwells, table,"
        log.skip("final estimates", f"{found} step or sweep with all carts free to fit them to")
        return None, False
    other = log.attempt("final estimates", fit_records, driven, n=n, springs=springs)
    if fit is None:
        return other, False
    # One that dwells follow gives way only to one that the dwells follow more closely yet.
    better = other is not None and (not follows(by_fit) or _is_closer(other, dwells, by_fit))
    if other and other.converged and better:
        log.warn(["the fit rests on the steps and sweeps: the dwells do not follow one chain"])
        return other, False
    return fit, follows(by_fit) and bool(dwells)


def _is_closer(fit: ChainFit, dwells: Sequence[Record], other: Mapping[str, Followed]) -> bool:
    """Whether a fit explains its own records, and the dwells follow it more closely."""
    lost = [sum(f.share for f in fits.values()) for fits in (follow(dwells, fit.chain), other)]
    return fit.chi_square_per_dof <= CHI_SQUARE_LIMIT and lost[0] < lost[1]


def _are_coarse(dwells: Sequence[Record]) -> bool:
    """Whether most motions are so few encoder steps that rounding hides the rest of a transient.

    Beside a sharp resonance a dwell's amplitude is then off by several of its errors.
    """
    motions = [(r.position(cart), r.encoder_step(cart)) for r in dwells for cart in r.carts]
    counts = [float(np.ptp(y)) / step for y, step in motions if step > 0]
    return bool(counts) and float(np.median(counts)) < 2 * FEW_COUNTS


def _decay_dampings(initial: dict[str, Estimate], *, n: int) -> dict[int, Estimate]:
    """Return by cart the damping ratio it has alone, as far as decays tell."""
    own = {cart: initial.get("zeta" if n == 1 else f"zeta_{cart}") for cart in range(1, n + 1)}
    return {
        cart: zeta
        for cart, zeta in own.items()
        if zeta and zeta.source == "log_decrement" and zeta.value > 0 and zeta.std
    }


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
    return design_feedback(
        fit.chain,
        cart=task.cart,
        reference=task.reference,
        overshoot_percent=task.overshoot_percent,
        settling_time=task.settling_time,
        input_limit=task.input_limit,
        sample_time=task.sample_time,
        method=task.method,
    )


def _design(submission: Submission, fit: ChainFit | None, *, log: _Log) -> FeedbackDesign | None:
    if submission.design is None:
        log.skip("state feedback", "no goal is stated: add a [design] table to submission.toml")
        return None
    return log.attempt("state feedback", reference_design, submission, fit)


def is_reversed(records: Sequence[Record]) -> bool:
    """Whether a positive input, as the bench counts it, drives cart 1 towards negative x."""
    signs = [r.input_scale for r in records if r.u is not None and r.kind != "closed_loop"]
    return sum(1 if sign > 0 else -1 for sign in signs) < 0


def _hardware(
    submission: Submission, records: Sequence[Record], fit: ChainFit | None, *, log: _Log
) -> list[HardwareCheck]:
    runs = {record.id: record for record in records if record.kind == "closed_loop"}
    if not runs:
        log.skip("hardware check", "no closed-loop run was recorded")
        return []
    if fit is None:
        log.skip("hardware check", "the carts are not identified")
        return []
    limit = submission.design.input_limit if submission.design else None
    checks: list[HardwareCheck] = []
    for experiment in submission.experiments:
        if experiment.id in runs:
            checks += (
                log.attempt(
                    f"hardware check, {experiment.id}",
                    check_hardware,
                    runs[experiment.id],
                    fit.chain,
                    controller=experiment.controller,
                    controlled_cart=experiment.controlled_cart,
                    input_limit=limit,
                )
                or ()
            )
    log.warn(_by_note((f"{check.experiment}, cart {check.cart}", check.note) for check in checks))
    return checks
