"""Amplitude ratios that students reduced themselves, against what their own dwells say.

A table stands in for dwells, so a slip in it goes unseen into every number that is fitted to it.
Where the dwells are handed in too they tell; else the steps and decays do, by the fit's numbers.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.grading.mistakes.transient import early_readings
from pipeline.grading.references.reference import is_explained
from pipeline.plant.chain import Array
from pipeline.results import Analysis, SinePoint
from pipeline.schemas.grade import Code, Flag

_SAME_FREQUENCY = 0.02  # relative: a row of the table is of this dwell
_MET = 0.06  # relative: a ratio read off the right way, or by one slip
_MOST = 0.8  # of the rows must be met by a slip
_FEW = 0.6  # of the rows met as they stand: the table is right but for odd rows
_FEWEST = 4  # rows; fewer single nothing out
_LEAST_COUNTS = 20.0  # encoder steps: smaller amplitudes are not read well
_OFF = 1.3  # factor, median over the rows: a table wrong by an unknown slip
_TURN = 2 * np.pi


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """The rows of the table that a dwell stands for; each (n,).

    `measured` is by their dwell, `early` what its first swings give, one array a way to read them.
    """

    cart: Array
    reported: Array
    measured: Array
    early: tuple[Array, ...]


def diagnose_reduced(analysis: Analysis) -> list[Flag]:
    """Return a flag where the reduced table is not what the dwells, or steps and decays, say."""
    if not analysis.tables:
        return []
    if not analysis.sine_points:
        return _against_time_records(analysis)
    rows = _rows(analysis, stretch=1.0)
    if rows is not None and _share(rows.reported, rows.measured) >= _FEW:
        return []
    found = []
    for code, text, predicted, seen in _slips(analysis, rows):
        share = _share(seen.reported, predicted)
        if share >= _MOST:
            found.append((share, code, text, seen))
    if found:
        _, code, text, seen = max(found, key=lambda one: one[0])
        return [_flag(code, text, seen)]
    if rows is None:
        return []
    ratio = float(np.median(np.abs(np.log(rows.reported / rows.measured))))
    text = "the table is not what your own dwells give; reduce them again"
    return [_flag("data_problem", text, rows)] if ratio > np.log(_OFF) else []


def _rows(analysis: Analysis, *, stretch: float) -> _Rows | None:
    """Match rows with dwells, the table's frequencies multiplied; None where few match."""
    runs = {record.id: record for record in analysis.records}
    matched: list[tuple[int, float, SinePoint]] = []
    for table in analysis.tables:
        points = [
            p for p in analysis.sine_points if p.cart == table.cart and _is_clear(p, analysis)
        ]
        for omega, ratio in zip(table.omega * stretch, table.magnitude, strict=True):
            near = [p for p in points if abs(p.omega / omega - 1) <= _SAME_FREQUENCY]
            if near:
                best = min(near, key=lambda p: abs(p.omega - omega))
                matched.append((table.cart, float(ratio), best))
    if len(matched) < _FEWEST:
        return None
    return _Rows(
        cart=np.array([cart for cart, _, _ in matched]),
        reported=np.array([ratio for _, ratio, _ in matched]),
        measured=np.array([p.gain for _, _, p in matched]),
        early=tuple(
            np.array(
                [
                    reading(runs[p.experiment], runs[p.experiment].position(p.cart))
                    / p.input_amplitude
                    for _, _, p in matched
                ]
            )
            for reading in early_readings()
        ),
    )


def _is_clear(point: SinePoint, analysis: Analysis) -> bool:
    steps = [r.encoder_step(point.cart) for r in analysis.records if r.id == point.experiment]
    return point.settled and point.amplitude > _LEAST_COUNTS * max(steps, default=0.0)


def _share(reported: Array, predicted: Array) -> float:
    """Return the share of the rows that are what is predicted."""
    with np.errstate(all="ignore"):
        return float(np.mean(np.abs(np.log(reported / predicted)) <= _MET))


def _slips(analysis: Analysis, rows: _Rows | None) -> Iterator[tuple[Code, str, Array, _Rows]]:
    """Yield (code, in words, what it makes of the rows, the rows)."""
    # A column headed in Hz that holds rad/s, and the other way round.
    for stretch, text in (
        (1 / _TURN, "its frequencies are in rad/s; the column is for Hz"),
        (_TURN, "its frequencies were divided by 2π once too often"),
    ):
        moved = _rows(analysis, stretch=stretch)
        if moved is not None:
            yield "hz_for_rad_s", text, moved.measured, moved
    if rows is None:
        return
    peak = "its ratios are {} those of your own dwells: the amplitudes of input and position are "
    peak += "both half of the distance from peak to peak"
    yield "peak_to_peak", peak.format("twice"), 2 * rows.measured, rows
    yield "peak_to_peak", peak.format("half of"), rows.measured / 2, rows
    counts = [r.encoder_step(int(c)) for r in analysis.records for c in r.carts]
    count = float(np.median(counts)) if counts else 0.0
    if count not in (0.0, 1.0):
        text = "its ratios are in encoder counts: multiply by the length of a count"
        yield "counts_for_length", text, rows.measured / count, rows
    decibel = 20 * np.log10(rows.measured)
    text = "its ratios look like decibels: say so in the heading, as in 'x1 [dB]'"
    yield "data_problem", text, np.where(decibel > 0, decibel, np.nan), rows
    gains = {(p.cart, round(p.omega, 6)): p.gain for p in analysis.sine_points}
    if analysis.carts == 2:
        other = _other_cart(analysis, rows, gains)
        yield "carts_swapped", "its columns belong to the other cart each", other, rows
    for early in rows.early:
        if _share(early, rows.measured) < _FEW:
            text = "its ratios are those of the first swings: wait for the steady state"
            yield "transient_used", text, early, rows


def _other_cart(analysis: Analysis, rows: _Rows, gains: Mapping[tuple[int, float], float]) -> Array:
    """Return what the dwell of each row says of the other of two carts; NaN where nothing."""
    omega = {p.gain: round(p.omega, 6) for p in analysis.sine_points}
    return np.array(
        [
            gains.get((3 - int(cart), omega[gain]), np.nan)
            for cart, gain in zip(rows.cart, rows.measured.tolist(), strict=True)
        ]
    )


def _flag(code: Code, text: str, rows: _Rows) -> Flag:
    worst = int(np.argmax(np.abs(np.log(rows.reported / rows.measured))))
    carts = sorted(set(rows.cart.tolist()))
    return Flag(
        code=code,
        parameters=tuple(f"bode.x{cart}" for cart in carts),
        message=f"the reduced table: {text} (cart {rows.cart[worst]}: {rows.reported[worst]:.4g}, "
        f"your dwell gives {rows.measured[worst]:.4g}).",
        evidence={
            "cart": int(rows.cart[worst]),
            "reported": float(rows.reported[worst]),
            "recomputed": float(rows.measured[worst]),
            "ratio": float(rows.reported[worst] / rows.measured[worst]),
        },
    )


def _against_time_records(analysis: Analysis) -> list[Flag]:
    """Return the flags that the fit to the table, against steps and decays, gives rise to."""
    if not is_explained(analysis):
        return []
    ratios: dict[str, list[float]] = {"K": [], "omega": []}
    measured = {"K": "step", "omega": "log_decrement"}
    for row in analysis.rows:
        symbol = row.name.partition("_")[0]
        if symbol in ratios and row.initial and row.final and row.initial.value > 0:
            if row.initial.source == measured[symbol]:
                ratios[symbol].append(row.final.value / row.initial.value)
    slips: tuple[tuple[Code, str, float, str], ...] = (
        ("peak_to_peak", "K", 2.0, "twice"),
        ("peak_to_peak", "K", 0.5, "half of"),
        ("hz_for_rad_s", "omega", _TURN, "2π times"),
        ("hz_for_rad_s", "omega", 1 / _TURN, "1/2π of"),
    )
    for code, symbol, factor, words in slips:
        values = np.array(ratios[symbol])
        if values.size and np.all(np.abs(np.log(values / factor)) <= _MET):
            what = "gains" if symbol == "K" else "frequencies"
            return [
                Flag(
                    code=code,
                    parameters=tuple(f"bode.x{table.cart}" for table in analysis.tables),
                    message=f"the reduced table: fitted, its {what} are {words} those of your "
                    "steps and decays; look again at how amplitudes and frequencies were read.",
                    evidence={"ratio": float(values[0])},
                )
            ]
    return []
