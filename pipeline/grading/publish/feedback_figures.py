"""Figures of the feedback: what was measured, and what the reported numbers make of it."""

from collections.abc import Mapping, Sequence

from pipeline.arrays import Array
from pipeline.plant.linear.recovery import transfer_functions
from pipeline.report.figures.grading import reported_bode_figure
from pipeline.report.figures.style import drawing
from pipeline.report.figures.svg import to_svg
from pipeline.report.words import clean
from pipeline.results import Analysis
from pipeline.submission import Reported

_MOST_CARTS = 3  # whose table stands for transfer functions
_LARGEST = 1e9  # of gains and frequencies, and its reciprocal the least: no figure shows more


def draw_figures(analysis: Analysis, reported: Reported | None) -> tuple[tuple[str, str], ...]:
    """Return file names and SVG: the response of each cart, with the curve of the final table.

    Without the curve where the table is not complete or stands for no response.
    """
    curve = _response({name: float(v) for name, v in (reported.final if reported else {}).items()})
    if curve and (len(curve[0]) != analysis.carts or analysis.carts > _MOST_CARTS):
        curve = None
    drawn = []
    with drawing():
        for response in analysis.frequency_responses:
            figure = reported_bode_figure(
                response,
                chain=analysis.chain,
                reported=curve,
                units=(clean(analysis.position_unit), clean(analysis.input_unit)),
            )
            told = "the curve of the reported final table" if curve else "no complete final table"
            alt = f"Measured frequency response of cart {response.cart}, its fit, and {told}."
            name = f"response-{response.cart}"
            drawn.append((f"{name}.svg", to_svg(figure, name=name, alt=alt)))
    return tuple(drawn)


def _response(values: Mapping[str, float]) -> tuple[Array, Sequence[Array]] | None:
    """Return the gains and polynomials that a table stands for, None where it stands for none."""
    sizes = [abs(v) for name, v in values.items() if name.startswith(("K", "omega"))]
    if any(not 1 / _LARGEST < size < _LARGEST for size in sizes):
        return None
    if any(not abs(v) < _LARGEST for v in values.values()):
        return None
    try:
        return transfer_functions(values)
    except KeyError:
        return None
