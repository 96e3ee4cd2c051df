"""Draw the ticks of each axis as a single line for the whole grid and a few texts.

matplotlib makes seven objects for every tick, which takes half the time of drawing a figure.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullLocator
from matplotlib.transforms import ScaledTranslation

from pipeline.arrays import Array
from pipeline.report.figures.colours import GRID

# Parts that a page redraws when a reader zooms: grids, tick labels, letters that mark a place.
TAGS = ("grid-x", "grid-y", "tick-x", "tick-y", "mark")
_SIZE = 7.5  # size of the tick labels in points


def draw_ticks(ax: Axes, *, label_x: bool, label_y: bool = True) -> None:
    """Draw grid and labels of both axes, with the limits that the data have set so far."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    sizes = ax.get_position().size * figure.get_size_inches()
    for direction, size in enumerate(sizes):
        axis = (ax.xaxis, ax.yaxis)[direction]
        if not axis.get_visible():
            continue
        low, high = sorted((ax.get_xlim, ax.get_ylim)[direction]())
        scale = (ax.get_xscale, ax.get_yscale)[direction]()
        most = max(2, int(size / (0.45, 0.18)[direction]))  # smallest distances of ticks in inches
        own = axis.get_major_locator()
        # A figure may choose some ticks itself, such as right angles or whole numbers.
        if type(own) in (MultipleLocator, MaxNLocator):
            ticks = np.asarray(own())
            ticks = ticks[(ticks >= low) & (ticks <= high)]
        elif scale == "log":
            ticks = log_ticks(low, high)
        else:
            ticks = linear_ticks(low, high, most=most)
        for set_locator in (axis.set_major_locator, axis.set_minor_locator):
            set_locator(NullLocator())
        _grid(ax, ticks, direction=direction)
        if (label_x, label_y)[direction]:
            pad = -3.5 / 72  # inches
            away = (0.0, pad) if direction == 0 else (pad, 0.0)
            shift = ScaledTranslation(*away, figure.dpi_scale_trans)
            _labels(ax, ticks, direction=direction, shift=shift)


def _grid(ax: Axes, ticks: Array, *, direction: int) -> None:
    along = np.repeat(ticks, 3)
    across = np.tile([0.0, 1.0, np.nan], ticks.size)
    x, y = (along, across) if direction == 0 else (across, along)
    transform = ax.get_xaxis_transform() if direction == 0 else ax.get_yaxis_transform()
    grid = Line2D(x, y, transform=transform, color=GRID, lw=0.5, zorder=0.5)
    grid.set_gid(TAGS[direction])
    ax.add_artist(grid)


def _labels(ax: Axes, ticks: Array, *, direction: int, shift: ScaledTranslation) -> None:
    for tick, label in zip(ticks, tick_labels(ticks), strict=True):
        if direction == 0:
            text = ax.text(tick, 0.0, label, transform=ax.get_xaxis_transform() + shift,
                           fontsize=_SIZE, ha="center", va="top")  # fmt: skip
        else:
            text = ax.text(0.0, tick, label, transform=ax.get_yaxis_transform() + shift,
                           fontsize=_SIZE, ha="right", va="center_baseline")  # fmt: skip
        text.set_gid(TAGS[2 + direction])


def linear_ticks(low: float, high: float, *, most: int) -> Array:
    """Return at least two round numbers between two limits, and if possible at most `most`."""
    magnitude = 10.0 ** np.floor(np.log10((high - low) / most))
    ticks = np.array([low, high])
    for factor in (1.0, 2.0, 5.0, 10.0):  # from fine to coarse
        step = factor * magnitude
        # The small numbers allow for rounding errors.
        first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
        if last - first < 1:
            break
        ticks = step * np.arange(first, last + 1)
        if ticks.size <= most:
            break
    return ticks


def log_ticks(low: float, high: float) -> Array:
    """Return 1, 2, 5, 10 … between two limits; fewer over many decades, more within one decade."""
    exponents = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    factors = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0) if high <= 7 * low else (1.0, 2.0, 5.0)
    factors = (1.0,) if high > 200 * low else factors
    ticks = np.sort(np.outer(10.0**exponents, factors).ravel())
    inside = ticks[(ticks >= low) & (ticks <= high)]
    return inside if inside.size > 1 else linear_ticks(low, high, most=6)


def tick_labels(ticks: Array) -> list[str]:
    """Return the numbers as text with equal numbers of decimals and with a true minus sign."""
    if ticks.size == 0:
        return []
    step = np.min(np.diff(ticks)) if ticks.size > 1 else abs(ticks[0]) or 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    # Very large and very small numbers are clearer as powers of ten.
    if decimals > 4 or np.abs(ticks).max() >= 1e6:
        texts = [f"{tick + 0.0:.3g}" for tick in ticks]
    elif decimals and np.ptp(np.diff(ticks)) > 0.5 * step:  # the ticks of a logarithmic axis
        texts = [f"{tick:g}" for tick in ticks]
    else:
        texts = [f"{tick + 0.0:.{decimals}f}" for tick in ticks]
    return [text.replace("-", "−") for text in texts]
