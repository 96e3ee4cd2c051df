"""The carts cut free, with every force that acts on them."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipeline.report.figures import MEASURED, MODEL, QUIET, WIDTH
from pipeline.report.numbers import subscript

_CART, _HIGH = 1.5, 1.5  # width and height of a cart
_REACH = 1.9  # length of an arrow
_APART = 1.9  # between the arrows of one side
_ROW = 2.5  # height of the figure, in its own units, for a cart
_INCH = 0.36  # a unit of the drawing


def free_body_figure(springs: Sequence[bool]) -> Figure:
    """Draw each cart alone: what pushes it, what pulls it back, which way is positive."""
    n = len(springs) - 1
    height = _ROW * n * _INCH
    figure = Figure(figsize=(WIDTH, height))
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set_axis_off()
    ax.grid(visible=False)
    half = WIDTH / _INCH / 2
    ax.set_xlim(-half, half)
    ax.set_ylim(-_ROW * n, 0.0)
    for i in range(1, n + 1):
        _draw_cart(ax, i, springs, y=-_ROW * (i - 0.5) - 0.15)
    return figure


def _draw_cart(ax: Axes, i: int, springs: Sequence[bool], *, y: float) -> None:
    n = len(springs) - 1
    index = "" if n == 1 else subscript(i)
    half = _CART / 2
    ax.fill(
        [-half, half, half, -half],
        [y - _HIGH / 2, y - _HIGH / 2, y + _HIGH / 2, y + _HIGH / 2],
        facecolor="#ececec",
        edgecolor=MEASURED,
        lw=1.0,
    )
    ax.text(0.0, y, f"m{index}", ha="center", va="center")
    _arrow(ax, (-0.5, y + _HIGH / 2 + 0.22), (0.5, y + _HIGH / 2 + 0.22), colour=QUIET)
    ax.text(0.65, y + _HIGH / 2 + 0.22, _x(i, n), ha="left", va="center", color=QUIET)
    left, right = _left_forces(i, springs), _right_forces(i, springs)
    for k, label in enumerate(left):
        level = _level(k, len(left), y)
        _arrow(ax, (-half, level), (-half - _REACH, level), colour=MODEL)
        ax.text(-half - _REACH - 0.15, level, label, ha="right", va="center")
    for k, label in enumerate(right):
        level = _level(k, len(right), y)
        _arrow(ax, (half, level), (half + _REACH, level), colour=MODEL)
        ax.text(half + _REACH + 0.15, level, label, ha="left", va="center")


def _level(k: int, count: int, y: float) -> float:
    return y if count == 1 else y + _HIGH * (0.36 - 0.72 * k / (count - 1))


def _left_forces(i: int, springs: Sequence[bool]) -> list[str]:
    """Return what acts towards negative x when the cart stands right of rest and moves right."""
    n = len(springs) - 1
    index = "" if n == 1 else subscript(i)
    forces = []
    if n == 1:
        forces += ["k x₁"] if any(springs) else []
    elif springs[i - 1]:
        k = f"k{subscript(i)}"
        forces.append(f"{k} x₁" if i == 1 else f"{k} ({_x(i, n)} − {_x(i - 1, n)})")
    forces.append(f"c{index} d{_x(i, n)}/dt")
    if n > 1 and i == n and springs[n]:
        forces.append(f"k{subscript(n + 1)} {_x(i, n)}")
    return forces


def _right_forces(i: int, springs: Sequence[bool]) -> list[str]:
    n = len(springs) - 1
    forces = ["u"] if i == 1 else []
    if i < n and springs[i]:
        k = f"k{subscript(i + 1)}"
        forces.append(f"{k} ({_x(i + 1, n)} − {_x(i, n)})")
    return forces


def _x(i: int, n: int) -> str:
    return f"x{subscript(i)}"


def _arrow(ax: Axes, start: tuple[float, float], end: tuple[float, float], *, colour: str) -> None:
    ax.annotate(
        "",
        xy=end,
        xytext=start,
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2, "shrinkA": 0, "shrinkB": 0},
    )
