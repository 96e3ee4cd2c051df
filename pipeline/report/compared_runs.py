"""Every recording of a submission with its models: measured, and simulated by each model.

Driven runs are simulated as in the report's section "Model and measurement": from rest, by the
measured input. A decay is simulated from the moment of release, with its start fitted to the run.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.hardware_check import check_hardware, released_run
from pipeline.gap.replay import Replay, replay_driven, replay_fitted
from pipeline.gap.runs import GapRun, prepare
from pipeline.gap.types import Gap
from pipeline.plant.chain import Chain
from pipeline.results import Analysis, ExperimentKind, HardwareCheck, Record
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress

ModelName = Literal["linear", "loop", "effects"]
_WORDS = phrases("plots")


@dataclass(frozen=True, kw_only=True, eq=False)
class Simulated:
    """One cart of a run, simulated by one model.

    Attributes
    ----------
    y : readings (n,), NaN where nothing is simulated.
    nrmse : rms of measured minus simulated position, divided by the rms of measured minus rest
        position, over the simulated samples.
    """

    model: ModelName
    y: Array
    nrmse: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedCart:
    """One cart of a run: its measured positions (n,), and its simulation by each model."""

    cart: int
    measured: Array
    models: tuple[Simulated, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedRun:
    """One run: each cart as measured and as simulated by each model.

    Attributes
    ----------
    note : why a model is missing, or what else a reader must know.
    """

    id: str
    kind: ExperimentKind
    t: Array
    u: Array | None
    carts: tuple[ComparedCart, ...]
    note: str = ""


def compare_runs(
    analysis: Analysis, *, gap: Gap | None, progress: Progress
) -> tuple[ComparedRun, ...]:
    """Return every recording with its models; the note of a run without a model says why.

    Parameters
    ----------
    gap : the gap analysis of the same data, whose model with effects is simulated too.
    """
    if gap is not None and not gap.model.terms:
        gap = None
    if gap is not None:
        from pipeline.plant.augmented import compile_simulator

        progress("preparing the simulator")
        compile_simulator()
    left_out = {one.experiment: one.reason for one in analysis.left_out}
    found = []
    for record in analysis.records:
        progress(f"simulating {record.id}")
        run = _compare(record, analysis, gap)
        if reason := left_out.get(record.id):
            text = _WORDS.text("left_out", reason=reason)
            run = replace(run, note="; ".join(filter(None, (text, run.note))))
        found.append(run)
    return tuple(found)


def _compare(record: Record, analysis: Analysis, gap: Gap | None) -> ComparedRun:
    """Return one recording with its models."""
    models: Mapping[int, Sequence[Simulated]] = {}
    note = ""
    if analysis.chain is None:
        note = _WORDS.text("no_chain")
    else:
        try:
            if record.kind == "decay":
                models, note = _released(record, analysis, analysis.chain, gap)
            else:
                models, note = _driven(record, analysis, analysis.chain, gap)
        except DataError as error:
            note = _WORDS.text("no_model", reason=str(error).removeprefix(f"{record.id}: "))
    return ComparedRun(
        id=record.id,
        kind=record.kind,
        t=record.t,
        u=record.u,
        carts=tuple(
            ComparedCart(
                cart=cart, measured=record.position(cart), models=tuple(models.get(cart, ()))
            )
            for cart in record.measured_free
        ),
        note=note,
    )


def _driven(
    record: Record, analysis: Analysis, chain: Chain, gap: Gap | None
) -> tuple[dict[int, list[Simulated]], str]:
    """Return the simulations of each cart, and a note for the reader of the plot.

    Models are driven by the measured input. If a loop ran, it is simulated as well.
    """
    checks = [check for check in analysis.hardware if check.experiment == record.id]
    checks = checks or list(check_hardware(record, chain))
    opened = [check for check in checks if check.loop == "open"]
    by_cart: dict[int, list[Simulated]] = {check.cart: [] for check in checks}
    for check in [*opened, *(check for check in checks if check.loop == "closed")]:
        by_cart[check.cart].append(_simulated(check))
    note = "; ".join(check.note for check in checks if check.note)
    if gap is not None and opened:
        with_effects = _with_effects(record, opened, gap, springs=analysis.bench.springs)
        for cart, simulated in with_effects.items():
            by_cart[cart].insert(1, simulated)
        if not with_effects:
            note = "; ".join(filter(None, (note, _WORDS.text("effects_run_away"))))
    return by_cart, note


def _with_effects(
    record: Record, opened: Sequence[HardwareCheck], gap: Gap, *, springs: tuple[bool, ...]
) -> dict[int, Simulated]:
    """Return, for each cart, the model with effects simulated on the measured input.

    The simulation starts from rest or from a state fitted to the run, whichever agrees better with
    the measurement. A dwell, for example, begins in motion.
    """
    replays = replay_driven(record, opened, gap.model)
    found = {one.check.cart: one.model for one in replays}
    measured = {one.check.cart: one.check.measured for one in replays}
    if record.kind != "closed_loop" and replays:
        with suppress(DataError):
            run = prepare([record], springs=springs, notes=[])[0]
            readings = replay_fitted(run, gap.model, springs=springs)
            carts = [row + 1 for row in run.rows]
            fitted = {**found, **dict(zip(carts, readings, strict=True))}
            found = min((found, fitted), key=lambda one: _squares(measured, one))
    return {
        one.check.cart: Simulated(
            model="effects", y=found[one.check.cart], nrmse=_nrmse(one, found[one.check.cart])
        )
        for one in replays
    }


def _squares(measured: Mapping[int, Array], model: Mapping[int, Array]) -> float:
    return sum(float(np.sum((y - model[cart]) ** 2)) for cart, y in measured.items())


def _nrmse(replay: Replay, model: Array) -> float:
    measured = replay.check.measured
    motion = np.sum((measured - replay.rest) ** 2)
    return float(np.sqrt(np.sum((measured - model) ** 2) / motion))


def _simulated(check: HardwareCheck) -> Simulated:
    model = "linear" if check.loop == "open" else "loop"
    return Simulated(model=model, y=check.model, nrmse=check.nrmse)


def _released(
    record: Record, analysis: Analysis, chain: Chain, gap: Gap | None
) -> tuple[dict[int, list[Simulated]], str]:
    """Return the simulations of each cart in a decay from the moment of release, and a note."""
    springs = analysis.bench.springs
    run = prepare([record], springs=springs, notes=[])[0]
    motion = replace(run.record.part(slice(-run.t.size, None)), reference=None)
    linear = released_run(motion, chain)
    y = linear.unforced() + (linear.forced() if linear.driven else 0.0)
    rest = dict(zip(linear.free, linear.rest, strict=True))
    rows = {cart: y[linear.free.index(cart)] for cart in (row + 1 for row in run.rows)}
    models: list[tuple[ModelName, Mapping[int, Array]]] = [("linear", rows)]
    note = ""
    if gap is not None:
        try:
            with_effects = replay_fitted(run, gap.model, springs=springs)
            carts = [row + 1 for row in run.rows]
            models.append(("effects", dict(zip(carts, with_effects, strict=True))))
        except DataError:
            note = _WORDS.text("effects_run_away")
    return dict(_from_release(run, record, models, rest)), note


def _from_release(
    run: GapRun,
    record: Record,
    models: Sequence[tuple[ModelName, Mapping[int, Array]]],
    rest: Mapping[int, float],
) -> Iterator[tuple[int, list[Simulated]]]:
    """Yield each cart with the models' positions over the whole recording."""
    before = np.full(record.t.size - run.t.size, np.nan)
    for j, cart in enumerate(row + 1 for row in run.rows):
        measured = run.y[j]
        motion = float(np.sum((measured - rest[cart]) ** 2))
        if motion > 0.0:
            yield (
                cart,
                [
                    Simulated(
                        model=model,
                        y=np.concatenate([before, rows[cart]]),
                        nrmse=float(np.sqrt(np.sum((measured - rows[cart]) ** 2) / motion)),
                    )
                    for model, rows in models
                ],
            )
