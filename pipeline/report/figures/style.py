"""The style of all figures, and their SVG.

Measured data are dark points, and single values are diamonds. Models are blue lines. So figures are
clear in greyscale and for colour-blind readers. Text can be searched and selected.
"""

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from itertools import takewhile
from math import fsum
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from pipeline.arrays import Array
from pipeline.report.figures import GRID, MEASURED, MODEL, QUIET, SECOND_LINE, Look
from pipeline.words.numbers import subscript
from pipeline.words.text import clean

WIDTH = 5.2  # inches; as wide as the text of a page (a phone shows three quarters)
_LIFT = 0.22  # inches between the titles of panels and a legend above them
_TITLES = 60  # characters of the titles above panels side by side
_SMALL_TITLE = 0.78  # size of the smallest titles, relative to other titles
_TICK = 2.5  # points; length of small ticks
_NO_PATH = Path(np.empty((0, 2)))
_STYLE: dict[Any, Any] = {
    "font.family": ["DejaVu Sans"],  # matplotlib comes with this font, so the PDF has it too
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.edgecolor": "#444444",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": GRID,
    "grid.linewidth": 0.5,
    "xtick.bottom": False,
    "ytick.left": False,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "lines.linewidth": 1.2,
    "text.parse_math": False,  # a dollar sign in a student's text does not begin a formula
    "svg.fonttype": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
}

# Ids that matplotlib gives to groups. Nothing refers to them, and they would repeat on a page with
# several figures.
_GROUP_ID = re.compile(r' id="[a-zA-Z0-9.]+_\d+"')


@contextmanager
def drawing() -> Iterator[None]:
    """Draw in the report's style, whatever the user's own matplotlib settings are."""
    with matplotlib.rc_context(), warnings.catch_warnings():
        # matplotlib's font may lack characters of a name, such as Chinese; the reader's browser has
        # them.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def panels(
    *heights: float,
    columns: int = 1,
    share_x: bool | Literal["column"] = True,
    share_y: bool = False,
    titled: bool = False,
    left: float = 0.62,
) -> tuple[Figure, list[Axes]]:
    """Return a figure with rows of the given heights (inches), and its axes row by row.

    Margins are set in inches; if matplotlib computed them, it would draw every figure twice. Panels
    with separate time axes each get room for tick labels and a title.

    Parameters
    ----------
    share_x : whether all panels have the same time axis, or only those of the same column.
    left : inches for the label and the tick labels of the vertical axis.
    """
    right, bottom = 0.12, 0.47  # inches for tick labels and axis titles
    top = 0.26 + (_LIFT if titled else 0.0)  # for a legend
    gap = 0.24 if titled else 0.13 if share_x else 0.53
    column_gap = 0.13 if share_y else 0.5
    # `fsum` rounds once. `sum` does so only from Python 3.12 on.
    height = fsum(heights) + gap * (len(heights) - 1) + top + bottom
    width = (WIDTH - left - right - column_gap * (columns - 1)) / columns
    figure = Figure(figsize=(WIDTH, height))
    grid = figure.add_gridspec(
        len(heights),
        columns,
        height_ratios=[round(1000 * one) for one in heights],
        left=left / WIDTH,
        right=1 - right / WIDTH,
        top=1 - top / height,
        bottom=bottom / height,
        hspace=gap * len(heights) / fsum(heights),
        wspace=column_gap / width,
    )
    axes: list[Axes] = []
    for row in range(len(heights)):
        for column in range(columns):
            first = axes[0] if axes else None
            highest = axes[column] if row else None
            ax = figure.add_subplot(
                grid[row, column],
                sharex=highest if share_x == "column" else first if share_x else None,
                sharey=first if share_y else None,
            )
            # Axis labels at fixed positions are aligned, and matplotlib need not measure the tick
            # labels.
            ax.yaxis.set_label_coords((0.16 - left) / width, 0.5)
            ax.xaxis.set_label_coords(0.5, -0.31 / heights[row])
            for axis in (ax.xaxis, ax.yaxis):  # steps of 2.5 would need a digit more
                axis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10]))
            ax.tick_params(
                labelbottom=not share_x or row == len(heights) - 1,
                labelleft=not share_y or column == 0,
            )
            axes.append(ax)
    return figure, axes


def small_multiples(
    titles: Sequence[str], *, height: float, share_y: bool
) -> tuple[Figure, list[Axes]]:
    """Return a panel for each title, all with the same time axis, to compare repeats."""
    columns = 2 if len(titles) == 4 else min(len(titles), 3)
    rows = -(-len(titles) // columns)
    figure, axes = panels(*[height] * rows, columns=columns, share_y=share_y, titled=True)
    for spare in axes[len(titles) :]:
        figure.delaxes(spare)
    for lowest in axes[: len(titles)][-columns:]:
        lowest.tick_params(labelbottom=True)
    name_panels(axes[: len(titles)], titles, columns=columns)
    return figure, axes[: len(titles)]


def name_panels(axes: Sequence[Axes], names: Sequence[str], *, columns: int) -> None:
    """Write the names of recordings above panels.

    If they are too long, the words that all names begin with are left out, and the print is
    smaller.
    """
    most = _TITLES // columns
    names = [clean(name) for name in names]
    if max(map(len, names)) > most:
        # What the first and last name in alphabetical order share, all names share.
        pairs = zip(min(names), max(names), strict=False)
        same = "".join(one for one, _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
        words = max(same.rfind(mark) for mark in "_-. ") + 1
        names = [name[words:] or name for name in names]
    longest = max(map(len, names))
    size = _STYLE["axes.titlesize"] * min(1.0, max(most / longest, _SMALL_TITLE))
    for ax, name in zip(axes, names, strict=True):
        ax.set_title(shorten(name, most=int(most / _SMALL_TITLE)), loc="left", y=1.0, size=size)


def shorten(text: str, *, most: int) -> str:
    """Return a text with at most `most` characters; an ellipsis replaces the middle.

    Names of recordings differ at their ends: `sweep_cart1_low`, `sweep_cart1_high`.
    """
    if len(text) <= most:
        return text
    head = (most - 1) // 2
    return f"{text[:head]}…{text[head + 1 - most :]}"


def name_rows(ax: Axes, rows: Sequence[tuple[str, str]]) -> None:
    """Write coloured names in place of the axis numbers; row i is at y = -i."""
    ax.set_ylim(1 - len(rows) - 0.7, 0.7)
    ax.yaxis.set_visible(False)
    for i, (name, colour) in enumerate(rows):
        ax.text(-0.02, -i, name, transform=ax.get_yaxis_transform(), fontsize=7.5, ha="right",
                va="center", color=colour)  # fmt: skip
    box = ax.get_position()
    ax.set_position((0.36, box.y0, box.x1 - 0.36, box.height))


class _LogTicks(LogLocator):
    """Powers of ten, with 2 and 5 between them if there is room, and more within one decade."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        between = (2.0, 5.0) if vmax > 7 * vmin else (1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
        self.set_params(subs=(1.0,) if vmax > 200 * vmin else (1.0, *between))
        return super().tick_values(vmin, vmax)


class DigitTicks(PathPatch):
    """Small ticks at 1, 2, … 9 times each power of ten on a logarithmic axis.

    They are one path. Ticks of matplotlib would take 40 ms in a figure with three panels.
    """

    def __init__(self, ax: Axes, direction: Literal["x", "y"]) -> None:
        across = direction == "x"
        blended = ax.get_xaxis_transform() if across else ax.get_yaxis_transform()
        super().__init__(_NO_PATH, fill=False, color="#444444", lw=0.6, transform=blended)
        self._ax, self._across = ax, across

    def draw(self, renderer: Any) -> None:
        """Draw the ticks that the axis shows."""
        points = renderer.points_to_pixels(_TICK)
        long = points / (self._ax.bbox.height if self._across else self._ax.bbox.width)
        at = self.positions().repeat(2)
        ends = np.tile([0.0, long], at.size // 2)
        columns = (at, ends) if self._across else (ends, at)
        codes = np.tile([Path.MOVETO, Path.LINETO], at.size // 2)
        self.set_path(Path(np.column_stack(columns), codes))
        super().draw(renderer)

    def positions(self) -> Array:
        """Return where the axis has ticks."""
        low, high = sorted((self._ax.get_xlim if self._across else self._ax.get_ylim)())
        powers = np.arange(np.floor(np.log10(low)), np.log10(high) + 1.0)
        at = np.outer(10.0**powers, np.arange(1, 10)).ravel()
        return at[(at >= low) & (at <= high)]


def log_scale(ax: Axes, *directions: Literal["x", "y"]) -> None:
    """Make axes logarithmic, with round numbers as labels and ticks at all digits."""
    for direction in directions:
        ax.set(**{f"{direction}scale": "log"})
        axis = ax.xaxis if direction == "x" else ax.yaxis
        axis.set_major_locator(_LogTicks())
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
        ax.add_artist(DigitTicks(ax, direction))


def log_frequency_axis(ax: Axes, omega: Array) -> None:
    """Make x a logarithmic frequency axis with the range of the measured points."""
    log_scale(ax, "x")
    ax.set_xlim(0.9 * float(omega.min()), 1.1 * float(omega.max()))


def legend_above(ax: Axes, *, columns: int = 4) -> None:
    """Put the legend above the axes and the title, where it covers no data."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    tall = ax.get_position().height * figure.get_size_inches()[1]
    lift = _LIFT if ax.get_title(loc="left") else 0.0
    handles, labels = ax.get_legend_handles_labels()
    # The measurement comes first.
    order = sorted(range(len(labels)), key=lambda i: labels[i] != "measured")
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
    """Keep the smallest and largest value of each stretch of a long line, in order of time.

    So every peak stays visible, and so does the envelope of a fast oscillation.
    """
    buckets = 240  # A line gets at most twice as many points, which is finer than print.
    if t.size <= 2 * buckets:
        return t, y
    starts = np.linspace(0, t.size, buckets + 1).astype(int)[:-1]
    size = int(np.ceil(t.size / buckets)) + 1
    index = np.minimum(
        starts[:, None] + np.arange(size), np.append(starts[1:], t.size)[:, None] - 1
    )
    values = y[index]
    rows = np.arange(buckets)
    least, most = index[rows, values.argmin(1)], index[rows, values.argmax(1)]
    keep = np.unique(np.concatenate([least, most]))
    return t[keep], y[keep]


def plot_measured(ax: Axes, t: Array, y: Array, *, most: int = 200) -> None:
    """Draw a measured time series as points, with an entry in the legend."""
    plot_points(ax, t, y, most=most)
    ax.plot([], [], ".", color=MEASURED, ms=3 * 2.2, mew=0, label="measured")


def plot_points(ax: Axes, t: Array, y: Array, *, most: int = 200, color: str = MEASURED) -> None:
    """Draw a time series as points, at most `most` of them, evenly spread.

    More points would hide the model's line. The points are drawn below the thinner line of the
    model, so that both are visible where they agree.
    """
    shown = np.linspace(0, t.size - 1, min(t.size, most)).astype(int)
    # Points are drawn as very short strokes with round ends, all in one path. This needs a fifth of
    # the time and a third of the text that markers need. Some viewers leave out strokes of zero
    # length. Adding the path as an artist saves matplotlib a loop over all strokes.
    points = np.column_stack([t[shown], y[shown]])
    strokes = points.repeat(2, axis=0)
    strokes[1::2, 0] += 1e-4 * (points[-1, 0] - points[0, 0])
    path = Path(strokes, np.tile([Path.MOVETO, Path.LINETO], shown.size))
    dots = PathPatch(path, fill=False, color=color, lw=2.2, capstyle="round", zorder=1.9)
    ax.add_artist(dots)
    ax.update_datalim(points)
    ax.autoscale_view()  # A patch does not do this by itself, and it may be the only artist.


def plot_line(ax: Axes, t: Array, y: Array, look: Look, *, label: str | None = None) -> None:
    """Draw a line, thinned to what the eye can see; with a label, it is in the legend."""
    ax.plot(*thin(t, y), label=label, **look)


def plot_model(ax: Axes, t: Array, y: Array, *, label: str = "model") -> None:
    """Draw a model as a line."""
    plot_line(ax, t, y, {"color": MODEL, "lw": 1.0}, label=label)


def plot_second(ax: Axes, t: Array, y: Array, *, label: str) -> None:
    """Draw the model with which the main model is compared, for example the one without effects."""
    plot_line(ax, t, y, SECOND_LINE, label=label)


def plot_residuals(ax: Axes, t: Array, *residuals: Array) -> None:
    """Draw the residuals of one or two models, in the colours of these models."""
    ax.axhline(0.0, color=QUIET, lw=0.6)
    looks = ({"color": MODEL, "lw": 0.8}, SECOND_LINE | {"lw": 0.8})
    for y, look in zip(residuals, looks, strict=False):
        plot_line(ax, t, y, look)


def keep_in_sight(ax: Axes, measured: Array) -> None:
    """Limit the axis to the measured range, extended on both sides by its span.

    The motion of an unstable model may leave this range.
    """
    low, high = float(np.min(measured)), float(np.max(measured))
    span = high - low or 1.0
    bottom, top = ax.get_ylim()
    ax.set_ylim(max(low - span, bottom), min(high + span, top))


def position_label(cart: int, unit: str) -> str:
    """Return the title of a position axis: "x₁ [cm]"."""
    return f"x{subscript(cart)} [{unit}]"


def to_svg(figure: Figure, *, name: str, alt: str) -> str:
    """Return the figure as an SVG element with a text alternative; the bytes are reproducible.

    The canvas is called directly, because `savefig` would draw everything twice.
    """
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    svg = "<svg " + buffer.getvalue().partition("<svg ")[2]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = _GROUP_ID.sub("", svg).replace("'DejaVu Sans'", "'DejaVu Sans', sans-serif")
    title = f"<title>{escape(alt, quote=False)}</title>"
    return svg.replace("<svg ", '<svg role="img" ', 1).replace(">", f">{title}", 1)
