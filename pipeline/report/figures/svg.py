"""Convert a figure to SVG text, with the data of its lines, so that readers can explore it."""

import io
import json
import re
from base64 import b64encode
from html import escape, unescape

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from pipeline.arrays import Array
from pipeline.report.figures.ticks import TAGS, draw_ticks

_POINTS = 72.0  # units of the drawing per inch
_SAME = 1e-6  # positions that differ by less than this share of the figure's size count as equal

# Ids that matplotlib gives to groups. Nothing refers to them, and they would repeat on a page with
# several figures.
_GROUP_ID = re.compile(r' id="[a-zA-Z0-9.]+_\d+"')
_TAG = re.compile(rf' id="({"|".join(TAGS)})"')
_ATTACHED = re.compile(r""" id=(["'])(\{.*?\})\1""")


def attach_data(artist: Artist, x: Array, y: Array, *, name: str) -> None:
    """Give a drawn series a name and its complete data; the drawing may be thinned out."""
    artist.set_gid(json.dumps({"name": name, "x": packed_time(x), "y": _packed(y)}))


def to_svg(figure: Figure, *, name: str, alt: str) -> str:
    """Return the figure as an SVG element with a text alternative; the bytes are reproducible.

    Limits of panels and data of series are in `data-` attributes, which `plain_svg` removes. The
    canvas is called directly, because `savefig` would draw everything twice.
    """
    for ax in figure.axes:
        # Panels that share an axis have labels only at the bottom of a column and at the left of a
        # row.
        at = ax.get_position()
        column = [
            other for other in ax.get_shared_x_axes().get_siblings(ax)
            if other.figure and abs(other.get_position().x0 - at.x0) < _SAME
        ]  # fmt: skip
        row = [
            other for other in ax.get_shared_y_axes().get_siblings(ax)
            if other.figure and abs(other.get_position().y0 - at.y0) < _SAME
        ]  # fmt: skip
        last = min(column, key=lambda other: other.get_position().y0)
        first = min(row, key=lambda other: other.get_position().x0)
        draw_ticks(ax, label_x=ax is last, label_y=ax is first)
        ax.set_gid(json.dumps(_panel(ax, x_label=last.get_xlabel(), y_label=first.get_ylabel())))
        for line in ax.lines:
            label = str(line.get_label())
            x, y = (np.asarray(v, dtype=float) for v in line.get_data())
            if x.size and line.get_gid() is None and not label.startswith("_"):
                attach_data(line, x, y, name=label)
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": name}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    svg = "<svg " + buffer.getvalue().partition("<svg ")[2]
    svg = re.sub(r"\s*<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = _GROUP_ID.sub("", svg).replace("'DejaVu Sans'", "'DejaVu Sans', sans-serif")
    svg = _ATTACHED.sub(_attributes, _TAG.sub(r' class="\1"', svg))
    title = f"<title>{escape(alt, quote=False)}</title>"
    return svg.replace("<svg ", '<svg role="img" ', 1).replace(">", f">{title}", 1)


def plain_svg(svg: str) -> str:
    """Return the drawing without the data, for print and for separate files."""
    return re.sub(r' data-[a-z]+="[^"]*"', "", svg)


def _panel(ax: Axes, *, x_label: str, y_label: str) -> dict[str, object]:
    """Return position (in points), limits, scales and titles of a panel."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    width, height = _POINTS * figure.get_size_inches()
    at = ax.get_position()
    box = (at.x0 * width, (1 - at.y1) * height, at.width * width, at.height * height)
    return {
        "box": [round(float(v), 2) for v in box],
        "x": [float(v) for v in ax.get_xlim()],
        "y": [float(v) for v in ax.get_ylim()],
        "log": [ax.get_xscale() == "log", ax.get_yscale() == "log"],
        "titles": [x_label, y_label, ax.get_title(loc="left")],
    }


def _packed(values: Array) -> str:
    """Return numbers as base64 of little-endian float32, which has seven digits."""
    # Larger numbers do not fit into float32; only an unstable model has them.
    shown = np.clip(np.asarray(values, dtype=float), -1e38, 1e38)
    return b64encode(shown.astype("<f4").tobytes()).decode()


def packed_time(values: Array) -> str:
    """Return times as "first last" if they are evenly spaced, and otherwise as packed numbers."""
    if values.size < 2:
        return _packed(values)
    even = np.linspace(values[0], values[-1], values.size)
    # A sample that deviates by less than this share of the span still looks evenly spaced.
    if np.max(np.abs(values - even)) > 1e-5 * abs(even[-1] - even[0]):
        return _packed(values)
    return f"{float(values[0]):.9g} {float(values[-1]):.9g}"


def _attributes(match: re.Match[str]) -> str:
    data = json.loads(unescape(match[2]))
    if "box" in data:
        return f' class="panel" data-panel="{escape(json.dumps(data, ensure_ascii=False))}"'
    return f' data-name="{escape(data["name"])}" data-x="{data["x"]}" data-y="{data["y"]}"'
