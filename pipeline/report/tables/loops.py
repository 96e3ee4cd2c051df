"""The designed loop, and model against measurement."""

from collections.abc import Sequence

import numpy as np

from pipeline.report.document import Spans, Table, spans
from pipeline.report.numbers import NOTHING, complex_text, percent, significant, unit_text
from pipeline.report.phrases import phrases
from pipeline.report.tables.cells import cell, make_table
from pipeline.report.words import clean
from pipeline.results import FeedbackDesign, HardwareCheck, Margins

_WORDS = phrases("report")


def feedback_table(design: FeedbackDesign, *, number: int, units: tuple[str, str]) -> Table:
    """Return gains, prefilter and what the simulated step does."""
    position, drive = (clean(unit) for unit in units)
    rows = []
    for i, value in enumerate(design.gains):
        speed = i % 2
        of = "velocity" if speed else "position"
        rows.append(
            (
                spans(f"gain on the {of} of cart {i // 2 + 1}"),
                significant(value),
                f"{drive} s/{position}" if speed else f"{drive}/{position}",
            )
        )
    rows += [
        *_weights(design),
        (spans("prefilter"), significant(design.prefilter), f"{drive}/{position}"),
        (spans("sample time"), significant(design.sample_time), "s"),
        (spans("overshoot"), percent(design.overshoot_percent), ""),
        (spans("settling time, 2 %"), significant(design.settling_time, digits=3), "s"),
        (spans("largest input"), significant(design.peak_input, digits=3), drive),
        *(
            (spans(name), value, f"{unit} {at}".strip())
            for name, value, unit, at in margin_rows(design.margins)
        ),
    ]
    return make_table(
        number,
        _WORDS.text(
            "feedback_table", cart=design.cart, goal=significant(design.reference), unit=position
        ),
        ("Quantity", "Value", "Unit"),
        [[cell(what), cell(value), cell(unit_text(unit))] for what, value, unit in rows],
        "ldl",
    )


def _weights(design: FeedbackDesign) -> list[tuple[Spans, str, str]]:
    """Return what the quadratic regulator weighs; nothing for placed poles."""
    if design.Q is None:
        return []
    diagonal = ", ".join(significant(value, digits=3) for value in np.diag(design.Q))
    return [
        (spans("LQR weights of the state, Q (diagonal)"), diagonal, ""),
        (spans("LQR weight of the input, R"), significant(design.R, digits=3), ""),
    ]


def margin_rows(margins: Margins | None) -> list[tuple[str, str, str, str]]:
    """Return name, number, unit and place of each margin; none where they are unknown."""
    if margins is None:
        return []
    gain, phase = margins.gain, margins.phase_deg
    turn = "of lead " if phase is not None and phase < 0 else "of lag "
    return [
        ("gain margin", significant(gain, digits=3), "", _at(margins.omega_gain)),
        (
            "phase margin",
            significant(phase and abs(phase), digits=3),
            "°",
            ("" if phase is None else turn) + _at(margins.omega_phase),
        ),
        ("modulus margin", significant(margins.modulus, digits=3), "", ""),
    ]


def _at(omega: float | None) -> str:
    return "no limit" if omega is None else f"at {significant(omega, digits=3)} rad/s"


def pole_table(design: FeedbackDesign, *, number: int) -> Table:
    """Return the closed-loop poles, beside the requested ones where some were."""
    order = np.lexsort((design.poles.imag, np.abs(design.poles)))
    poles = design.poles[order]
    head = ["Pole [rad/s]", "Frequency [rad/s]", "Damping ratio"]
    rows = [
        [
            cell(complex_text(pole, digits=3)),
            cell(significant(abs(pole), digits=3)),
            cell(significant(-pole.real / abs(pole), digits=3) if pole != 0 else NOTHING),
        ]
        for pole in poles
    ]
    if (requested := design.requested_poles) is not None:
        head.insert(0, "Requested [rad/s]")
        requested = requested[np.lexsort((requested.imag, np.abs(requested)))]
        for i, cells in enumerate(rows):
            # A delay adds poles that nobody asked for.
            cells.insert(
                0, cell(complex_text(requested[i], digits=3) if i < requested.size else NOTHING)
            )
    return make_table(number, "Poles of the closed loop.", head, rows, "r" * len(head))


def hardware_table(checks: Sequence[HardwareCheck], *, number: int, position_unit: str) -> Table:
    """Return model against measurement of every run and cart."""
    rows = [
        [
            cell(clean(check.experiment)),
            cell(str(check.cart)),
            cell("loop" if check.loop == "closed" else "measured input"),
            cell(percent(100 * check.nrmse)),
            cell(_overshoots(check)),
            cell(_pair(check.settling_model, check.settling_measured)),
            cell(_pair(check.steady_state_model, check.steady_state_measured)),
        ]
        for check in checks
    ]
    return make_table(
        number,
        _WORDS.text("hardware_table"),
        (
            "Record", "Cart", "Simulated", "Difference", "Overshoot [%]", "Settling [s]",
            f"Steady state [{clean(position_unit)}]",
        ),
        rows,
        "lcldrrr",
    )  # fmt: skip


def _overshoots(check: HardwareCheck) -> str:
    pair = (check.overshoot_model, check.overshoot_measured)
    if pair == (None, None):
        return NOTHING
    return " / ".join(percent(value).removesuffix(" %") for value in pair)


def _pair(model: float | None, measured: float | None) -> str:
    if model is None and measured is None:
        return NOTHING
    return f"{significant(model, digits=3)} / {significant(measured, digits=3)}"
