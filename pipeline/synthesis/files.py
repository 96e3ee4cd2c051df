"""Write the submission's files: data as CSV, everything else as TOML."""

import json
import math
from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.submission.toml_file import Value
from pipeline.synthesis.rig import Run
from pipeline.synthesis.runs import INPUT_DECIMALS


class Typed(str):
    """A number as a student typed it: its digits stand in the file as they are."""


def csv_text(run: Run, *, u: Array, y: Array, time_decimals: int, count: float) -> str:
    """Return the log of one run: time, input, in a closed loop the reference, and x1 … xn.

    `u` is (n,), `y` (n_carts, n) whole counts, in position units; they are written with one digit
    more than it takes to tell a count from the next.
    """
    kept = run.t >= run.keep_from
    columns = {"time": _fixed(run.t[kept] - run.t[kept][0], time_decimals)}
    columns["input"] = _fixed(u[kept], INPUT_DECIMALS)
    if run.reference is not None:
        columns["reference"] = _fixed(run.reference[kept], INPUT_DECIMALS)
    position_decimals = max(0, math.ceil(-math.log10(count)) + 1)
    for cart, positions in enumerate(y, start=1):
        columns[f"x{cart}"] = _fixed(positions[kept], position_decimals)
    rows = zip(*columns.values(), strict=True)
    return "\n".join(",".join(row) for row in [tuple(columns), *rows]) + "\n"


def _fixed(values: Array, decimals: int) -> list[str]:
    """Format with fixed decimals, without the zeros that say nothing and without -0."""
    texts = [f"{value:.{decimals}f}" for value in np.round(values, decimals) + 0.0]
    return [text.rstrip("0").rstrip(".") for text in texts] if decimals else texts


def toml_section(heading: str, entries: Mapping[str, Value]) -> str:
    """Return one table of a TOML file; no heading: the keys at its top."""
    lines = [f"{key} = {_toml(value)}" for key, value in entries.items()]
    return "\n".join([heading, *lines] if heading else lines) + "\n"


def _toml(value: Value) -> str:
    if isinstance(value, Typed):
        return value
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False)  # TOML's basic strings are JSON's
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, Sequence):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)
