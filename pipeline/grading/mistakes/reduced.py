"""Check a table of amplitude ratios that students reduced themselves from their dwells.

A mistake in this table affects every number fitted to it. If the dwells are submitted too, they
show the mistake. Otherwise, steps and decays show it, because they disagree with the fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.grading import limits
from pipeline.grading.grade import Code, Flag
from pipeline.grading.mistakes.factors import FACTORS, MISREAD_RATIO
from pipeline.grading.reference import is_explained
from pipeline.grading.words import WORDS
from pipeline.names import read_name
from pipeline.results import Analysis, SinePoint


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Rows with a matching dwell: amplitude ratios as reported and as measured, of shape (n,)."""

    cart: Array
    reported: Array
    measured: Array


def diagnose_reduced(analysis: Analysis) -> list[Flag]:
    """Return a flag if the reduced table contradicts the dwells, or the steps and decays."""
    if not analysis.tables:
        return []
    if not analysis.sine_points:
        return _against_time_records(analysis)
    rows = _rows(analysis, stretch=1.0)
    if rows is not None and _share(rows.reported, rows.measured) >= limits.ENOUGH_ROWS:
        return []
    share, best = max(_slips(analysis, rows), key=lambda one: one[0], default=(0.0, None))
    if best is not None and share >= limits.MOST_ROWS:
        return [_flag(*best)]
    if rows is None:
        return []
    ratio = float(np.median(np.abs(np.log(rows.reported / rows.measured))))
    off = ratio > np.log(1.3)  # wrong, but by no known mistake
    return [_flag("data_problem", "reduced_off", rows)] if off else []


def _rows(analysis: Analysis, *, stretch: float) -> _Rows | None:
    """Match rows of the table with dwells; return None if fewer than four match.

    Parameters
    ----------
    stretch : factor by which the frequencies of the table are multiplied before the comparison.
    """
    matched: list[tuple[int, float, SinePoint]] = []
    for table in analysis.tables:
        points = [
            p for p in analysis.sine_points if p.cart == table.cart and _is_clear(p, analysis)
        ]
        for omega, ratio in zip(table.omega * stretch, table.magnitude, strict=True):
            near = [p for p in points if abs(p.omega / omega - 1) <= limits.SAME_FREQUENCY]
            if near:
                best = min(near, key=lambda p: abs(p.omega - omega))
                matched.append((table.cart, float(ratio), best))
    if len(matched) < 4:  # fewer rows cannot show which mistake it is
        return None
    return _Rows(
        cart=np.array([cart for cart, _, _ in matched]),
        reported=np.array([ratio for _, ratio, _ in matched]),
        measured=np.array([p.gain for _, _, p in matched]),
    )


def _is_clear(point: SinePoint, analysis: Analysis) -> bool:
    steps = [r.encoder_step(point.cart) for r in analysis.records if r.id == point.experiment]
    return point.settled and point.amplitude > limits.LEAST_COUNTS * max(steps, default=0.0)


def _share(reported: Array, predicted: Array) -> float:
    """Return the share of the rows that match the prediction."""
    with np.errstate(all="ignore"):
        return float(np.mean(np.abs(np.log(reported / predicted)) <= MISREAD_RATIO))


def _slips(
    analysis: Analysis, rows: _Rows | None
) -> Iterator[tuple[float, tuple[Code, str, _Rows]]]:
    """Yield the known mistakes that affect the whole table: code, key of the sentence, and rows.

    Each comes after the share of the rows that it predicts.
    """
    for row in [row for row in FACTORS if row.of == "frequencies of rows"]:
        if moved := _rows(analysis, stretch=row.factor):
            yield _share(moved.reported, moved.measured), (row.code, row.advice_key, moved)
    if rows is None:
        return
    for row in [row for row in FACTORS if row.of == "ratios of rows"]:
        share = _share(rows.reported, row.factor * rows.measured)
        yield share, (row.code, row.advice_key, rows)
    counts = [r.encoder_step(int(c)) for r in analysis.records for c in r.carts]
    count = float(np.median(counts)) if counts else 0.0
    if count not in (0.0, 1.0):
        share = _share(rows.reported, rows.measured / count)
        yield share, ("counts_for_length", "reduced_counts", rows)


def _flag(code: Code, advice_key: str, rows: _Rows) -> Flag:
    worst = int(np.argmax(np.abs(np.log(rows.reported / rows.measured))))
    carts = sorted(set(rows.cart.tolist()))
    return Flag(
        code=code,
        parameters=tuple(f"bode.x{cart}" for cart in carts),
        message=WORDS.text(
            "reduced",
            slip=WORDS.text(advice_key),
            cart=rows.cart[worst],
            reported=f"{rows.reported[worst]:.4g}",
            recomputed=f"{rows.measured[worst]:.4g}",
        ),
        evidence={
            "cart": int(rows.cart[worst]),
            "reported": float(rows.reported[worst]),
            "recomputed": float(rows.measured[worst]),
            "ratio": float(rows.reported[worst] / rows.measured[worst]),
        },
    )


def _against_time_records(analysis: Analysis) -> list[Flag]:
    """Return a flag if the fit differs from steps and decays by the factor of a known mistake."""
    if not is_explained(analysis):
        return []
    ratios: dict[str, list[float]] = {"fitted gains": [], "fitted frequencies": []}
    for row in analysis.rows:
        read = read_name(row.name)
        of, measured = "fitted frequencies", "log_decrement"
        if read.is_gain:
            of, measured = "fitted gains", "step"
        elif not read.is_frequency:
            continue
        if row.initial and row.final and row.initial.value > 0 and row.initial.source == measured:
            ratios[of].append(row.final.value / row.initial.value)
    for slip in [row for row in FACTORS if row.of in ratios]:
        values = np.array(ratios[slip.of])
        if values.size and np.all(np.abs(np.log(values / slip.factor)) <= slip.tolerance):
            return [
                Flag(
                    code=slip.code,
                    parameters=tuple(f"bode.x{table.cart}" for table in analysis.tables),
                    message=WORDS.text("reduced_fitted", slip=WORDS.text(slip.advice_key)),
                    evidence={"ratio": float(values[0])},
                )
            ]
    return []
