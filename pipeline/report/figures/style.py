"""One style for all figures.

Measured data are points (dark, diamonds for single values), models are lines (blue), so that a
figure reads in grey and for the colour-blind. Text stays text: it can be searched and selected.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import takewhile
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from pipeline.arrays import Array
from pipeline.report.figures.svg import tell
from pipeline.report.numbers import subscript
from pipeline.report.words import clean

WIDTH = 5.2  # inches: as wide as a page of text, on a phone three quarters of it
MEASURED = "#222222"
MODEL = "#0072b2"  # blue and vermillion of Okabe and Ito, apart in grey too
SECOND = "#d55e00"
THIRD = "#009e73"
QUIET = "#8a8a8a"
SHADE = "#ececec"
CART_LINES = ("-", "--", "-.", ":")  # carts that share a panel differ by line style as well
CART_MARKS = {"o": "circles", "s": "squares", "^": "triangles", "D": "diamonds"}  # and points so
CART_COLOURS = (MODEL, SECOND, THIRD, MEASURED)

_BUCKETS = 240  # twice this many points a line: finer than print at this width shows
_MOST_POINTS = 200  # of one record: more would hide the line of the model
# Inches:
_LEFT, _RIGHT = 0.62, 0.12  # for tick labels and axis titles
_TOP, _BOTTOM = 0.26, 0.47  # for a legend or a title above, tick labels and title below
_SHARED_GAP, _OWN_GAP = 0.13, 0.53  # between panels on one time axis, or each with its own
_X_LABEL, _Y_LABEL = 0.31, 0.46  # from the axes to the middle of their titles
_COLUMN_GAP, _TITLE_GAP = 0.5, 0.24
LIFT = 0.22  # of a legend above the titles of panels
_MOST_COLUMNS = 3
_TITLE_LETTERS = 60  # side by side, over the whole width
_DOT = 2.2  # points
_STROKE = 1e-4  # of the time span

_STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],  # comes with matplotlib, so the PDF has it too
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#444444",
    "lines.linewidth": 1.2,
    "text.parse_math": False,  # a dollar sign in a student's text is a dollar sign
    "svg.fonttype": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
}


@contextmanager
def drawing() -> Iterator[None]:
    """Draw in the report's style, whatever the user's own matplotlib settings are."""
    with matplotlib.rc_context(), warnings.catch_warnings():
        # A name in Chinese is fine: the reader's browser has the font that matplotlib lacks.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def panels(*heights: float, columns: int = 1, share_x: bool = True) -> tuple[Figure, list[Axes]]:
    """Return a figure with rows of the given heights (inches), its axes row by row.

    Margins are set in inches, not searched for: a search draws every figure twice. Panels that
    do not share their time axis each get room for tick labels and a title.
    """
    return _grid(
        heights,
        columns,
        gap=_SHARED_GAP if share_x else _OWN_GAP,
        column_gap=_COLUMN_GAP,
        top=_TOP,
        share_x=share_x,
        share_y=False,
    )


def small_multiples(
    titles: Sequence[str], *, height: float, share_y: bool
) -> tuple[Figure, list[Axes]]:
    """Return a panel under each title, on one time axis: repeats are seen to be alike, or not."""
    columns = min(len(titles), _MOST_COLUMNS)
    if len(titles) == _MOST_COLUMNS + 1:  # two and two
        columns -= 1
    rows = -(-len(titles) // columns)
    figure, axes = _grid(
        [height] * rows,
        columns,
        gap=_TITLE_GAP,
        column_gap=_SHARED_GAP if share_y else _COLUMN_GAP,
        top=_TOP + LIFT,
        share_x=True,
        share_y=share_y,
    )
    for spare in axes[len(titles) :]:
        figure.delaxes(spare)
    for ax, title in zip(axes, _short(titles, most=_TITLE_LETTERS // columns), strict=False):
        ax.set_title(title, loc="left", y=1.0)
    return figure, axes[: len(titles)]


def _short(titles: Sequence[str], *, most: int) -> list[str]:
    """Return titles of so many letters; long ones lose first what they all begin with."""
    titles = [clean(title) for title in titles]
    if len(titles) > 1 and max(map(len, titles)) > most:
        pairs = zip(min(titles), max(titles), strict=False)  # what these two share, all do
        same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
        titles = [f"…{title[same:]}" for title in titles] if same > 1 else titles
    return [title if len(title) <= most else f"{title[: most - 1]}…" for title in titles]


def _grid(
    heights: Sequence[float],
    columns: int,
    *,
    gap: float,
    column_gap: float,
    top: float,
    share_x: bool,
    share_y: bool,
) -> tuple[Figure, list[Axes]]:
    height = sum(heights) + gap * (len(heights) - 1) + top + _BOTTOM
    width = (WIDTH - _LEFT - _RIGHT - column_gap * (columns - 1)) / columns
    figure = Figure(figsize=(WIDTH, height))
    grid = figure.add_gridspec(
        len(heights),
        columns,
        height_ratios=heights,
        left=_LEFT / WIDTH,
        right=1 - _RIGHT / WIDTH,
        top=1 - top / height,
        bottom=_BOTTOM / height,
        hspace=gap * len(heights) / sum(heights),
        wspace=column_gap / width,
    )
    axes: list[Axes] = []
    for row in range(len(heights)):
        for column in range(columns):
            first = axes[0] if axes else None
            ax = figure.add_subplot(
                grid[row, column],
                sharex=first if share_x else None,
                sharey=first if share_y else None,
            )
            # Given places for labels save a search among all tick labels, and line them up.
            ax.yaxis.set_label_coords(-_Y_LABEL / width, 0.5)
            ax.xaxis.set_label_coords(0.5, -_X_LABEL / heights[row])
            axes.append(ax)
    return figure, axes


def log_frequency_axis(ax: Axes, omega: Array) -> None:
    """Make x a logarithmic frequency axis around the measured points."""
    ax.set_xscale("log")
    ax.set_xlim(0.9 * float(omega.min()), 1.1 * float(omega.max()))


def legend_above(ax: Axes, *, columns: int = 4, lift: float = 0.0) -> None:
    """Put the legend above the axes, where it hides no data; `lift` (inches) clears a title."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    tall = ax.get_position().height * figure.get_size_inches()[1]
    handles, labels = ax.get_legend_handles_labels()
    order = sorted(range(len(labels)), key=lambda i: labels[i] != "measured")  # first what is
    ax.legend(
        [handles[i] for i in order],
        [labels[i] for i in order],
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0 + lift / tall),
        ncols=columns,
        borderpad=0.0,
        borderaxespad=0.3,
        handlelength=1.6,
        columnspacing=1.4,
    )


def thin(t: Array, y: Array) -> tuple[Array, Array]:
    """Keep the least and greatest value of each stretch of a long line, in their order in time.

    What the eye sees stays: every peak, and the envelope of what is too fast to see.
    """
    if t.size <= 2 * _BUCKETS:
        return t, y
    starts = np.linspace(0, t.size, _BUCKETS + 1).astype(int)[:-1]
    size = int(np.ceil(t.size / _BUCKETS)) + 1
    index = np.minimum(
        starts[:, None] + np.arange(size), np.append(starts[1:], t.size)[:, None] - 1
    )
    values = y[index]
    rows = np.arange(_BUCKETS)
    least, most = index[rows, values.argmin(1)], index[rows, values.argmax(1)]
    keep = np.unique(np.concatenate([least, most]))
    return t[keep], y[keep]


def plot_measured(
    ax: Axes,
    t: Array,
    y: Array,
    *,
    most: int = _MOST_POINTS,
    name: str = "measured",
    color: str = MEASURED,
    in_legend: bool = True,
) -> None:
    """Draw a measured time series as points, of a long one `most` spread evenly.

    They lie below the lines of models, which are thinner: both are seen where they agree.
    """
    shown = np.linspace(0, t.size - 1, min(t.size, most)).astype(int)
    # Round-ended strokes too short to see as such: one path for all points takes a fifth of the
    # time and a third of the text that markers do. (Some readers drop strokes of no length at
    # all.) Added as an artist, or matplotlib walks every stroke.
    points = np.column_stack([t[shown], y[shown]])
    strokes = points.repeat(2, axis=0)
    strokes[1::2, 0] += _STROKE * (points[-1, 0] - points[0, 0])
    path = Path(strokes, np.tile([Path.MOVETO, Path.LINETO], shown.size))
    dots = PathPatch(path, fill=False, color=color, lw=_DOT, capstyle="round", zorder=1.9)
    tell(dots, t, y, name=name)
    ax.add_artist(dots)
    ax.update_datalim(points)
    ax.autoscale_view()  # a patch does not ask for it, and nothing else may be drawn here
    if in_legend:
        ax.plot([], [], ".", color=color, ms=3 * _DOT, mew=0, label=name)


def plot_line(
    ax: Axes,
    t: Array,
    y: Array,
    *,
    name: str,
    color: str = MODEL,
    ls: str = "-",
    lw: float = 1.2,
    in_legend: bool = True,
) -> None:
    """Draw a long line as thin as the eye cannot tell; a reader who zooms gets all of it."""
    label = name if in_legend else None
    (line,) = ax.plot(*thin(t, y), color=color, ls=ls, lw=lw, label=label)
    tell(line, t, y, name=name)


def plot_model(ax: Axes, t: Array, y: Array, *, label: str = "model") -> None:
    """Draw a model as a line."""
    plot_line(ax, t, y, name=label, lw=1.0)


def plot_second(ax: Axes, t: Array, y: Array, *, label: str) -> None:
    """Draw what a model is set against: another model, the same without effects."""
    plot_line(ax, t, y, name=label, color=SECOND, ls="--", lw=1.0)


def plot_residuals(ax: Axes, t: Array, residuals: Mapping[str, Array]) -> None:
    """Draw the residuals of one or two models, by their names, in the models' colours."""
    ax.axhline(0.0, color=QUIET, lw=0.6)
    looks = ((MODEL, "-"), (SECOND, "--"))
    for (name, y), (colour, ls) in zip(residuals.items(), looks, strict=False):
        plot_line(ax, t, y, name=name, color=colour, ls=ls, lw=0.8, in_legend=False)


def keep_in_sight(ax: Axes, measured: Array) -> None:
    """Limit the axis to one span beyond what was measured: an unstable model may leave any."""
    low, high = float(np.min(measured)), float(np.max(measured))
    span = high - low or 1.0
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(low - span, bottom), min(high + span, top))


def position_label(cart: int, unit: str) -> str:
    """Return the title of a position axis, "x₁ [cm]"."""
    return f"x{subscript(cart)} [{unit}]"
