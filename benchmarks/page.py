"""The page of the benchmarks: its tables, the notes below them, and how a section is replaced.

The page itself stores the results, with each section between two comments. A run replaces only its
own sections, and records the machine and the versions.
"""

import csv
import io
import os
import platform
import re
import textwrap
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as version_of
from pathlib import Path
from types import ModuleType

import numpy as np
import psutil
from matplotlib.figure import Figure

from pipeline import __version__
from pipeline.arrays import Array
from pipeline.output import write_file
from pipeline.report.figures.style import drawing, to_svg

NOT_INSTALLED = "not installed"
_BASIC = ("numpy", "scipy", "numba")
_SECTION = re.compile(r"<!-- (\w+) -->\n.*?<!-- end of \1 -->\n", re.DOTALL)
_HEAD = "# Benchmarks\n"
WIDTH = 118  # characters in a line of the page


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of the page, with its figure and its method.

    Attributes
    ----------
    rows : cells as text; if a tool is not installed, its row comes from `missing`.
    better : in which respect other tools are better, as Markdown above the table.
    note : the method and how each tool was used, as Markdown below the table.
    picture : function that draws the figure in the style of the reports.
    in_file : if true, the page has only the figure, and the rows are in a CSV file beside it.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    better: str = ""
    note: str = ""
    picture: Callable[[], Figure] | None = None
    in_file: bool = False


def installed(tool: str) -> bool:
    """Return whether a distribution is installed."""
    return version(tool) != NOT_INSTALLED


def version(tool: str) -> str:
    """Return the version of a distribution, or `NOT_INSTALLED`."""
    try:
        return version_of(tool)
    except PackageNotFoundError:
        return NOT_INSTALLED


def missing(name: str, *, columns: int) -> list[str]:
    """Return the row of a tool that is not installed."""
    return [name, NOT_INSTALLED, *[""] * (columns - 2)]


def spread(values: Iterable[float] | Array, *, digits: int = 2) -> str:
    """Return the median and, in brackets, the quartiles, as significant digits."""
    found = np.asarray(list(values), dtype=float)
    if not found.size:
        return "–"
    low, middle, high = (
        significant(q, digits=digits) for q in np.quantile(found, [0.25, 0.5, 0.75])
    )
    return f"{middle} ({low}–{high})" if found.size > 1 else middle


def significant(value: float, *, digits: int = 2) -> str:
    """Return a number with `digits` significant digits; only extreme values have an exponent."""
    if not np.isfinite(value) or value == 0 or not 1e-4 < abs(value) < 1e6:
        return f"{value:.{digits}g}"
    places = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{places}f}"


def share(hits: int, of: int) -> str:
    """Return a share in percent, followed by the two counts."""
    if not of:
        return "–"
    digits = 1 if 0 < hits < of and not 0.5 < 100 * hits / of < 99.5 else 0
    return f"{100 * hits / of:.{digits}f} % ({hits} of {of})"


def write_page(page: Path, made: dict[str, str], *, order: Sequence[str]) -> None:
    """Replace the sections that were made; keep the other sections and the head of the page."""
    text = page.read_text(encoding="utf-8") if page.exists() else _HEAD
    sections = {found[1]: found[0] for found in _SECTION.finditer(text)} | made
    head = _SECTION.split(text, maxsplit=1)[0].rstrip() + "\n"
    shown = [sections[name] for name in order if name in sections]
    write_file(page, "\n".join([head, *shown]))


def section(
    name: str, module: ModuleType, tables: Sequence[Table], *, seconds: float, figures: Path | None
) -> str:
    """Return a benchmark's part of the page; write its figures, if a folder is given."""
    parts = [f"<!-- {name} -->", f"## {module.TITLE}", wrapped(module.WORDS)]
    for number, table in enumerate(tables, start=1):
        parts += [f"### {table.title}", wrapped(table.better)]
        file = f"{name}-{number}.csv"
        if table.in_file and figures is not None:
            write_rows(table, figures / file)
            parts.append(f"The numbers are in [{file}](figures/{file}).")
        else:
            parts.append(markdown(table))
        if table.picture is not None:
            with drawing():
                drawn = to_svg(table.picture(), name=f"{name}-{number}", alt=table.title)
            if figures is not None:
                figures.mkdir(parents=True, exist_ok=True)
                write_file(figures / f"{name}-{number}.svg", drawn)
                parts.append(f"![{table.title}](figures/{name}-{number}.svg)")
        parts.append(wrapped(table.note))
    tools = ", ".join(f"{tool} {version(tool)}" for tool in (*_BASIC, *module.TOOLS))
    parts.append(
        f"*To repeat: `python -m benchmarks {name}`. It took {seconds:.0f} s of one core on "
        f"{machine()}. Versions: cartlab {__version__}, {tools}.*"
    )
    return "\n\n".join(filter(None, parts)) + f"\n\n<!-- end of {name} -->\n"


def wrapped(text: str) -> str:
    """Return Markdown with its paragraphs and list items wrapped to the width of the page."""
    blocks = [re.split(r"\n(?=- )", block) for block in text.strip().split("\n\n")]
    return "\n\n".join("\n".join(map(_filled, items)) for items in blocks)


def _filled(text: str) -> str:
    return textwrap.fill(
        " ".join(text.split()),
        WIDTH,
        subsequent_indent="  " if text.startswith("- ") else "",
        break_long_words=False,
        break_on_hyphens=False,
    )


def write_rows(table: Table, file: Path) -> None:
    """Write the rows of a table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table.head, *table.rows])
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, text.getvalue())


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    lines = [table.head, ["---"] * len(table.head), *table.rows]
    assert all(len(line) == len(table.head) for line in lines), table.title
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def machine() -> str:
    """Return the facts about the machine that affect times, without its name.

    The sum is a measure of its speed today: on a shared machine that changes fivefold.
    """
    memory = psutil.virtual_memory().total / 1e9
    began = time.process_time()
    sum(number * number for number in range(10_000_000))
    return (
        f"{os.cpu_count()} cores ({platform.machine()}, 10⁷ squares summed in "
        f"{time.process_time() - began:.1f} s), {memory:.0f} GB, {platform.system()}, "
        f"Python {platform.python_version()}"
    )
