"""Figures of the feedback: measurements with the curves that the reported numbers give."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from pipeline.arrays import Array
from pipeline.grading.grade import Criterion
from pipeline.names import gain_name, own_omega, own_zeta, read_name
from pipeline.plant.identities import transfer_functions
from pipeline.report.builder import Page
from pipeline.report.figures.grading import (
    reported_bode_figure,
    reported_decay_figure,
    reported_step_figure,
)
from pipeline.report.figures.style import drawing, to_svg
from pipeline.results import Analysis, Record
from pipeline.submission import Reported
from pipeline.words.text import clean, symbol_text

_RESPONSE = "response"  # the names of these figures begin with this
_MOST_CARTS = 3  # with more carts, a table does not determine the transfer functions
_LARGEST = 1e9  # largest gain and frequency in a figure; the reciprocal is the smallest


def draw_figures(analysis: Analysis, reported: Reported | None) -> tuple[tuple[str, str], ...]:
    """Draw the measured response of each cart, with the curve that the final table gives.

    Each figure is a pair of file name and SVG text. The curve is left out if the table is
    incomplete or gives no valid response.
    """
    curve = _response({name: float(v) for name, v in (reported.final if reported else {}).items()})
    if curve and (len(curve[0]) != analysis.bench.n or analysis.bench.n > _MOST_CARTS):
        curve = None
    drawn = []
    with drawing():
        for response in analysis.frequency_responses:
            figure = reported_bode_figure(
                response,
                chain=analysis.chain,
                reported=curve,
                units=Page(analysis).units,
            )
            computed = "the response computed from the reported final table"
            drawn_curve = computed if curve else "no complete final table"
            alt = (
                f"Measured frequency response of cart {response.cart}, its fit, and {drawn_curve}."
            )
            name = f"{_RESPONSE}-{response.cart}"
            drawn.append((f"{name}.svg", to_svg(figure, name=name, alt=alt)))
    return tuple(drawn)


def draw_records(analysis: Analysis, criteria: Iterable[Criterion]) -> tuple[tuple[str, str], ...]:
    """Draw the recordings that show why numbers of the initial table lost points.

    Each figure is a pair of file name and SVG text. If several recordings show the same number, the
    most precise one is drawn. The file name contains the numbers; `numbers_in` reads them.

    Parameters
    ----------
    criteria : the criteria about the initial table.
    """
    off = [c for c in criteria if c.outcome in ("partial", "fail")]
    pairs = {
        name: (float(c.found[name]), float(c.expected[name]))
        for c in off
        for name in c.found
        if name in c.expected
    }
    records = {record.id: record for record in analysis.records}
    unit, drawn = clean(analysis.bench.units.position), []

    def keep(draw: Callable[..., Any], names: Sequence[str], *, record: Record, **how) -> None:
        reported = ", ".join(f"{symbol_text(name)} {pairs[name][0]:.4g}" for name in names)
        recomputed = ", ".join(f"{pairs[name][1]:.4g}" for name in names)
        title = f"reported {reported}; recomputed {recomputed}"
        figure = draw(record=record, title=title, position_unit=unit, **how)
        file = "-".join(("record", *names))
        drawn.append(
            (f"{file}.svg", to_svg(figure, name=file, alt=f"{clean(record.id)}: {title}."))
        )

    with drawing():
        for cart in range(1, analysis.bench.n + 1):
            gain = gain_name(cart, n=analysis.bench.n)
            own = [own(cart, n=analysis.bench.n) for own in (own_omega, own_zeta)]
            steps = [step for step in analysis.step_gains if step.cart == cart]
            decays = [decay for decay in analysis.log_decrements if decay.cart == cart]
            if gain in pairs and steps:
                step = min(steps, key=lambda step: step.gain_std)
                keep(partial(reported_step_figure, step), [gain],
                     record=records[step.experiment], reported=pairs[gain][0])  # fmt: skip
            there = [name for name in own if name in pairs]
            if there and decays:
                decay = min(decays, key=lambda decay: decay.zeta_std)
                measured = dict(zip(own, (decay.omega_n, decay.zeta), strict=True))
                reported = tuple(pairs[n][0] if n in pairs else measured[n] for n in own)
                keep(partial(reported_decay_figure, decay), there,
                     record=records[decay.experiment], reported=reported)  # fmt: skip
    return tuple(drawn)


def numbers_in(file: str) -> frozenset[str]:
    """Return the parameters in the file name of a recording's figure; empty for other figures."""
    kind, *names = file.removesuffix(".svg").split("-")
    return frozenset(names if kind == "record" else ())


def is_response(file: str) -> bool:
    """Return whether a figure is the frequency response of a cart."""
    return file.startswith(f"{_RESPONSE}-")


def _response(values: Mapping[str, float]) -> tuple[Array, Sequence[Array]] | None:
    """Return the gains and polynomials of the transfer functions of a table; None if not valid."""
    sizes = [abs(v) for name, v in values.items() if not read_name(name).is_damping]
    if any(not 1 / _LARGEST < size < _LARGEST for size in sizes):
        return None
    if any(not abs(v) < _LARGEST for v in values.values()):
        return None
    try:
        return transfer_functions(values)
    except KeyError:
        return None
