"""The tables of a report, as data: numbers formatted, parameter names as mathematics."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pipeline.plant.chain import Chain
from pipeline.report.document import Cell, Span, Spans, Table, plain, spans
from pipeline.report.numbers import (
    NOTHING,
    at_decimal,
    complex_text,
    percent,
    significant,
    unit_text,
    with_error,
)
from pipeline.report.phrases import phrases
from pipeline.report.words import SOURCES, clean, name_span, rich
from pipeline.results import (
    Analysis,
    ChainFit,
    Check,
    Estimate,
    FeedbackDesign,
    HardwareCheck,
    LogDecrement,
    Margins,
    ParameterRow,
    StepGain,
)

_WORDS = phrases("report")
_OUTCOMES = {"pass": "passed", "fail": "failed", "skip": "not checked"}
_TONES = {"pass": "good", "fail": "bad", "skip": "quiet"}


def cell(text: str | Spans | Span, tone: str = "") -> Cell:
    """Return a table cell."""
    return Cell(spans(text), tone)  # type: ignore[arg-type]


def make_table(
    number: int,
    caption: str | Spans,
    head: Iterable[str | Spans],
    rows: Iterable[Sequence[Cell]],
    align: str,
) -> Table:
    """Return a table; `align` has one of l, c, r or d (on the decimal mark) for each column."""
    return Table(
        number=number,
        caption=spans(caption),
        head=tuple(cell(text) for text in head),
        rows=tuple(
            tuple(_cut(c) if how == "d" else c for c, how in zip(row, align, strict=True))
            for row in rows
        ),
        align=align,
    )


def _cut(content: Cell) -> Cell:
    return replace(content, parts=at_decimal(plain(content.text)))


# ------------------------------------------------------------------ parameters


def parameter_table(rows: Sequence[ParameterRow], *, number: int, carts: int) -> Table:
    """Return initial and final estimates as the paper's Tables 1-3, with errors and a verdict."""
    words = {1: "one", 2: "two", 3: "three", 4: "four"}
    return make_table(
        number,
        _WORDS.text("parameter_table", carts=words.get(carts, carts)),
        ("Parameter", "Unit", "Initial estimate", "from", "Final estimate", "Change", "Verdict"),
        [_parameter_row(row) for row in rows],
        "lldlddl",
    )


def _parameter_row(row: ParameterRow) -> list[Cell]:
    source = SOURCES.get(row.initial.source, clean(row.initial.source)) if row.initial else ""
    change = percent(row.change_percent, signed=True)
    if row.change_sigmas is not None:
        change += f" ({significant(row.change_sigmas, digits=2)} σ)"
    return [
        cell(name_span(row.name)),
        cell(unit_text(clean(row.unit)) or "1"),
        cell(_estimate(row.initial)),
        cell(source, "quiet"),
        cell(_estimate(row.final)),
        cell(change),
        _verdict(row.consistent),
    ]


def _estimate(estimate: Estimate | None) -> str:
    if estimate is None:
        return NOTHING
    if estimate.source == "assumed":  # a guess has no more digits than were thought of
        return significant(estimate.value, digits=2)
    return with_error(estimate.value, estimate.std)


def _verdict(consistent: bool | None) -> Cell:
    if consistent is None:
        return cell(NOTHING, "quiet")
    return cell("agree", "good") if consistent else cell("differ", "bad")


def parameter_notes(rows: Sequence[ParameterRow]) -> list[Spans]:
    """Return the remarks on single parameters, equal remarks told once."""
    by_note: dict[str, list[str]] = {}
    for row in rows:
        if row.note:
            by_note.setdefault(row.note, []).append(row.name)
    return [spans(rich(", ".join(names)), ": ", rich(clean(n))) for n, names in by_note.items()]


def fitted_chain_table(fit: ChainFit, *, number: int, position_unit: str, input_unit: str) -> Table:
    """Return masses, dampings and springs of a joint fit."""
    std = dict(zip(fit.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    return chain_table(
        fit.chain, std=std, number=number, position_unit=position_unit, input_unit=input_unit
    )


def chain_table(
    chain: Chain, *, std: Mapping[str, float], number: int, position_unit: str, input_unit: str
) -> Table:
    """Return masses, dampings and springs, each with its standard error where it was fitted."""
    kinds = (
        ("m", "mass", chain.m, f"{input_unit} s²/{position_unit}"),
        ("c", "damping", chain.c, f"{input_unit} s/{position_unit}"),
        ("k", "spring", chain.k, f"{input_unit}/{position_unit}"),
    )
    rows = []
    for letter, noun, values, unit in kinds:
        for i, value in enumerate(values, start=1):
            if chain.n == 1 and letter == "k" and i > 1:
                continue  # only the sum of a lone cart's springs is known
            name = f"{letter}_{i}" if chain.n > 1 else letter
            error = std.get(f"{letter}_{i}")
            absent = value == 0 and not error
            rows.append(
                [
                    cell(name_span(name)),
                    cell(_where(noun, i, chain.n)),
                    cell("none" if absent else with_error(float(value), error)),
                    cell(unit_text(clean(unit))),
                ]
            )
    return make_table(
        number,
        _WORDS.text("chain_table"),
        ("Symbol", "Meaning", "Value", "Unit"),
        rows,
        "lldl",
    )


def _where(noun: str, i: int, n: int) -> str:
    if noun != "spring":
        return f"{noun} of cart {i}" if n > 1 else noun
    if n == 1:
        return "springs, together"
    left, right = ("wall" if i == 1 else str(i - 1)), ("wall" if i == n + 1 else str(i))
    return f"spring {left}–{right}"


# ---------------------------------------------------------------- single stages


def decay_table(decays: Sequence[LogDecrement], *, number: int, position_unit: str) -> Table:
    """Return frequency and damping of every decay, by both methods, with the friction test."""
    rows = []
    for decay in decays:
        friction = decay.friction
        if friction is None:
            verdict = cell("not tested", "quiet")
        elif friction.present:
            verdict = cell(with_error(friction.drop, friction.drop_std), "bad")
        else:
            verdict = cell("none seen", "good")
        rows.append(
            [
                cell(clean(decay.experiment)),
                cell(str(decay.cart)),
                cell(with_error(decay.omega_n, decay.omega_n_std)),
                cell(with_error(decay.zeta, decay.zeta_std)),
                cell(with_error(decay.zeta_peaks, decay.zeta_peaks_std)),
                cell(str(decay.peak_t.size)),
                verdict,
            ]
        )
    return make_table(
        number,
        _WORDS.text("decay_table"),
        (
            "Record", "Cart", spans(name_span("omega_n"), " [rad/s]"),
            spans(name_span("zeta"), " of the fit"), spans(name_span("zeta"), " of the extrema"),
            "Extrema", f"Dry friction d [{clean(position_unit)}]",
        ),
        rows,
        "lcdddcr",
    )  # fmt: skip


def step_table(gains: Sequence[StepGain], *, number: int, units: tuple[str, str]) -> Table:
    """Return the static gain of every step record and cart."""
    position, drive = (clean(unit) for unit in units)
    rows = []
    for gain in gains:
        value = with_error(gain.gain, gain.gain_std)
        if gain.interval is not None:
            low, high = (significant(v, digits=3) for v in gain.interval)
            value = f"{low} to {high}"
        rows.append(
            [
                cell(clean(gain.experiment)),
                cell(str(gain.cart)),
                cell(str(len(gain.edges))),
                cell(value),
                cell(significant(gain.rest_shift, digits=2)),
            ]
        )
    return make_table(
        number,
        _WORDS.text("step_table"),
        ("Record", "Cart", "Edges", f"K [{position}/{drive}]", f"Rest moved by [{position}]"),
        rows,
        "lccdd",
    )


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


# ----------------------------------------------------------------- housekeeping


def check_table(checks: Sequence[Check], caption: str, *, number: int) -> Table:
    """Return consistency checks, failed ones first."""
    order = {"fail": 0, "pass": 1, "skip": 2}
    return make_table(
        number,
        caption,
        ("Outcome", "Check", "What was found"),
        [
            [
                cell(_OUTCOMES[check.outcome], _TONES[check.outcome]),
                cell(Span(clean(check.id), "code")),
                cell(rich(clean(check.message))),
            ]
            for check in sorted(checks, key=lambda check: order[check.outcome])
        ],
        "lll",
    )


def file_table(analysis: Analysis, *, number: int) -> Table:
    """Return the data files with their SHA-256."""
    return make_table(
        number,
        _WORDS.text("file_table"),
        ("File", "SHA-256"),
        [
            [cell(Span(clean(name), "code")), cell(Span(clean(digest), "code"))]
            for name, digest in sorted(analysis.files.items())
        ],
        "ll",
    )
