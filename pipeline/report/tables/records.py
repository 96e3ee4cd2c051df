"""What single records gave: decays, steps, dwells."""

from collections.abc import Sequence

import numpy as np

from pipeline.report.document import Table, spans
from pipeline.report.numbers import significant, with_error
from pipeline.report.phrases import phrases
from pipeline.report.tables.cells import cell, make_table
from pipeline.report.words import clean, name_span
from pipeline.results import LogDecrement, SinePoint, StepGain

_WORDS = phrases("report")


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


def dwell_table(points: Sequence[SinePoint], *, number: int, units: tuple[str, str]) -> Table:
    """Return frequency, amplitudes, ratio and phase of every dwell and cart; whether it settled."""
    position, drive = (clean(unit) for unit in units)
    rows = [
        [
            cell(clean(point.experiment)),
            cell(significant(point.omega / (2 * np.pi))),
            cell(str(point.cart)),
            cell(significant(point.input_amplitude)),
            cell(with_error(point.amplitude, point.amplitude_std)),
            cell(with_error(point.gain, point.gain_std)),
            cell(with_error(np.degrees(point.phase), np.degrees(point.phase_std))),
            cell(significant(point.steady_from, digits=3)) if point.settled
            else cell("not settled", "bad"),
        ]
        for point in points
    ]  # fmt: skip
    head = (
        "Record", "f [Hz]", "Cart", f"|U| [{drive}]", f"|X| [{position}]",
        f"|X|/|U| [{position}/{drive}]", "Phase [°]", "Steady from [s]",
    )  # fmt: skip
    return make_table(number, _WORDS.text("dwell_table"), head, rows, "ldcddddr")
