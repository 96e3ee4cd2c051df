"""Read the numbers behind each figure from matplotlib's artists, in every process of a command.

Python imports this file first if its folder is in PYTHONPATH. Each figure becomes one JSON file in
the folder that CARTLAB_FIGURES names. No module of cartlab is imported here.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

_DIGITS = 8
_LABEL = 14  # characters of a label
_STATIONS = 200  # points at which a line is read


def summary(values: Any) -> list[float]:
    """Return up to eight numbers as they are; otherwise their count, ends, mean, spread and slope.

    The slope is the mean product with a ramp from -1 to 1, which also notices another order.
    Numbers that are not finite only lower the count.
    """
    v = np.asarray(values, dtype=float).ravel()
    v = v[np.isfinite(v)]
    if v.size > 8:
        slope = np.mean(v * np.linspace(-1, 1, v.size))
        v = np.array([v.size, v[0], v[-1], v.mean(), v.std(), slope])
    return [float(f"{one:.{_DIGITS}g}") for one in v]


def line_summary(x: Any, y: Any) -> dict[str, Any]:
    """Return a line's numbers; of a long line that runs to the right, at equally spaced points.

    The last bits of its numbers decide which points of a long line are drawn, but not the line.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    known = np.isfinite(x) & np.isfinite(y)
    if known.sum() > 8 and np.all(np.diff(x[known]) > 0):
        at = np.linspace(x[known][0], x[known][-1], _STATIONS)
        x, y = at, np.interp(at, x[known], y[known])
    shown = {"x": summary(x), "y": summary(y)}
    return shown if shown["x"] else {}


def read_back(figure: Any) -> dict[str, Any]:
    """Return what a figure shows: limits of each panel, and the numbers of each artist in it."""
    panels = [
        {
            "x limits": summary(ax.get_xlim()),
            "y limits": summary(ax.get_ylim()),
            "drawn": [
                drawn
                for artist in (*ax.lines, *ax.patches, *ax.collections, *ax.texts, *ax.artists)
                if (drawn := _drawn(artist))
            ],
        }
        for ax in figure.axes
    ]
    free = (*figure.lines, *figure.patches, *figure.texts, *figure.artists)
    return {"panels": panels, "free": [drawn for one in free if (drawn := _drawn(one))]}


def _drawn(artist: Any) -> dict[str, Any]:
    if hasattr(artist, "get_xdata"):
        return line_summary(artist.get_xdata(), artist.get_ydata())
    if hasattr(artist, "get_text"):
        at, text = summary(getattr(artist, "xy", artist.get_position())), artist.get_text()
        # A short text is a label, such as that of a force.
        return {"at": at, "says": text} if len(text) <= _LABEL else {"at": at}
    if getattr(artist, "_posA_posB", None) is not None:  # an arrow between two points
        return {"from": summary(artist._posA_posB[0]), "to": summary(artist._posA_posB[1])}
    if hasattr(artist, "get_patch_transform"):
        points = artist.get_patch_transform().transform(artist.get_path().vertices)
    else:
        paths = [path.vertices for path in artist.get_paths()]
        points = np.concatenate([np.reshape(p, (-1, 2)) for p in (artist.get_offsets(), *paths)])
    return {"x": summary(points[:, 0]), "y": summary(points[:, 1])}


def watch_figures() -> None:
    """From now on, write a JSON file for each figure that this process writes as SVG."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    draw = FigureCanvasSVG.print_svg

    def print_svg(canvas: Any, *arguments: Any, **named: Any) -> Any:
        if "CARTLAB_FIGURES" not in os.environ:
            return draw(canvas, *arguments, **named)
        folder = Path(os.environ["CARTLAB_FIGURES"])
        name = matplotlib.rcParams["svg.hashsalt"] or "figure"
        number = len(list(folder.glob(f"{name}.*.json"))) + 1
        text = json.dumps(read_back(canvas.figure), ensure_ascii=False)
        (folder / f"{name}.{number}.json").write_text(text, encoding="utf-8")
        return draw(canvas, *arguments, **named)

    setattr(FigureCanvasSVG, "print_svg", print_svg)  # noqa: B010


if "CARTLAB_FIGURES" in os.environ:
    watch_figures()
