"""Free-body diagrams of the carts, with every force on them."""

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle

from pipeline.report.figures.colours import MEASURED, MODEL, QUIET
from pipeline.report.figures.style import WIDTH
from pipeline.words.numbers import subscript

# Inches:
_CART = 0.54  # width and height of a cart in the drawing
_GAP = 0.05  # distance between an arrow and its name
_ROW = 0.9  # height of the figure for each cart


def free_body_figure(springs: Sequence[bool]) -> Figure:
    """Draw each cart alone with the forces on it and the positive direction.

    The figure has no axes, because there is nothing to zoom into.
    """
    n = len(springs) - 1
    figure = Figure(figsize=(WIDTH, _ROW * n))
    for i in range(1, n + 1):
        _draw_cart(figure, i, springs, y=_ROW * (n - i) + 0.4 * _ROW)
    return figure


def _draw_cart(figure: Figure, i: int, springs: Sequence[bool], *, y: float) -> None:
    n = len(springs) - 1
    middle, half = WIDTH / 2, _CART / 2
    cart = Rectangle(
        (middle - half, y - half),
        _CART,
        _CART,
        facecolor="#ececec",
        edgecolor=MEASURED,
        lw=1.0,
        transform=figure.dpi_scale_trans,
    )
    figure.add_artist(cart)
    _write(figure, middle, y, f"m{'' if n == 1 else subscript(i)}", "center")
    top = y + half + 0.08
    _arrow(figure, (middle - half / 2, top), half, colour=QUIET)
    _write(figure, middle + half / 2 + _GAP, top, _x(i), "left", colour=QUIET)
    reach = 0.68  # length of an arrow
    for sign, forces in ((-1, _left_forces(i, springs)), (1, _right_forces(i, springs))):
        for k, label in enumerate(forces):
            level = y + (0.5 - (k + 0.5) / len(forces)) * _CART
            start = middle + sign * half
            _arrow(figure, (start, level), sign * reach, colour=MODEL)
            side = "left" if sign > 0 else "right"
            _write(figure, start + sign * (reach + _GAP), level, label, side)


def _left_forces(i: int, springs: Sequence[bool]) -> list[str]:
    """Return the forces to the left while the cart is right of its rest and moves right."""
    n = len(springs) - 1
    index = "" if n == 1 else subscript(i)
    forces = []
    if n == 1:
        forces += ["k x₁"] if any(springs) else []
    elif springs[i - 1]:
        k = f"k{subscript(i)}"
        forces.append(f"{k} x₁" if i == 1 else f"{k} ({_x(i)} − {_x(i - 1)})")
    forces.append(f"c{index} d{_x(i)}/dt")
    if n > 1 and i == n and springs[n]:
        forces.append(f"k{subscript(n + 1)} {_x(i)}")
    return forces


def _right_forces(i: int, springs: Sequence[bool]) -> list[str]:
    n = len(springs) - 1
    forces = ["u"] if i == 1 else []
    if i < n and springs[i]:
        k = f"k{subscript(i + 1)}"
        forces.append(f"{k} ({_x(i + 1)} − {_x(i)})")
    return forces


def _x(i: int) -> str:
    return f"x{subscript(i)}"


def _arrow(figure: Figure, start: tuple[float, float], length: float, *, colour: str) -> None:
    arrow = FancyArrowPatch(
        start,
        (start[0] + length, start[1]),
        arrowstyle="-|>",
        mutation_scale=8.0,
        color=colour,
        lw=1.2,
        shrinkA=0,
        shrinkB=0,
        transform=figure.dpi_scale_trans,
    )
    figure.add_artist(arrow)


def _write(
    figure: Figure, x: float, y: float, text: str, side: str, *, colour: str = MEASURED
) -> None:
    figure.text(x, y, text, ha=side, va="center", color=colour, transform=figure.dpi_scale_trans)
