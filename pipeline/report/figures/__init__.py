"""The figures of reports; here their colours and line styles, which load without matplotlib."""

from typing import Any

MEASURED = "#222222"
MODEL = "#0072b2"  # the blue and vermillion of Okabe and Ito; they also differ in grey
SECOND = "#d55e00"
THIRD = "#009e73"
QUIET = "#8a8a8a"
SHADE = "#ececec"
GRID = "#e4e4e4"
# For carts in the same panel: colour, line style, marker, and name of the marker.
CARTS = (
    (MODEL, "-", "o", "circles"),
    (SECOND, "--", "s", "squares"),
    (THIRD, "-.", "^", "triangles"),
    (MEASURED, ":", "D", "diamonds"),
)

Look = dict[str, Any]  # matplotlib options of a line, such as colour, style and width (points)
SECOND_LINE: Look = {"color": SECOND, "ls": "--", "lw": 1.0}
