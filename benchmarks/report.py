"""Time and memory of a report, by number of carts and of records, and of a notebook."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from matplotlib.figure import Figure

from benchmarks.page import Table, installed, missing, spread
from pipeline.report.figures import MODEL, SECOND
from pipeline.report.figures.style import legend_above, log_scale, panels
from pipeline.resources import EXAMPLES
from pipeline.simulated.submission import write_submission
from pipeline.submission.load import NAME
from pipeline.submission.models import MOST_EXPERIMENTS

TITLE = "Report"
WORDS = """
**How long does a report take?** Each number is for a separate `cartlab report` command, with its
start and imports. "First" is the first report after an installation from source, without compiled
Python files and without matplotlib's list of fonts.
"""
TOOLS = ("matplotlib", "typst", "nbconvert", "quarto-cli")
EVERY = ("one-cart", "two-cart", "three-cart")
RECORDS = (10, 30, 100, 300, MOST_EXPERIMENTS)
_ROOT = Path(__file__).parents[1]
_REPORT = (sys.executable, "-m", "pipeline", "report")
_DOCUMENT = Path(__file__).with_name("lab_document.py")


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Processor seconds, seconds on the clock, and the largest memory of a process in MB."""

    cpu: float
    clock: float
    memory: float


def tables(*, quick: bool) -> list[Table]:
    """Return the costs of a report by carts and by records, and of a notebook with its figures."""
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        return [
            by_carts(base, runs=1 if quick else 5, examples=EVERY[:1] if quick else EVERY),
            by_records(base, records=RECORDS[:1] if quick else RECORDS),
            documents(base, runs=1 if quick else 3),
        ]


def run(command: Sequence[str | Path], *, cwd: Path = _ROOT, **environment: str) -> Cost:
    """Run a command and return its cost, including the processes that it waited for."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [*map(str, command)],
        cwd=cwd,
        env=os.environ | environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):  # status 1: done, but a check of the recordings failed
        raise RuntimeError(f"{' '.join(map(str, command))}: exit status {process.returncode}")
    kilo = 1024 if sys.platform == "darwin" else 1
    return Cost(
        cpu=used.ru_utime + used.ru_stime,
        clock=time.perf_counter() - began,
        memory=used.ru_maxrss / kilo / 1e3,
    )


# ---------------------------------------------------------------------------------- carts


def by_carts(base: Path, *, runs: int, examples: Sequence[str]) -> Table:
    rows = []
    for example in examples:
        out = ("--out", base / example)
        command = (*_REPORT, EXAMPLES / example, *out)
        empty = base / f"{example}-empty"
        first = run(command, PYTHONPYCACHEPREFIX=str(empty), MPLCONFIGDIR=str(empty))
        warm = [run(command) for _ in range(runs)]
        page = [run((*command, "--no-pdf")) for _ in range(runs)]
        rows.append(
            [
                f"`submissions/{example}`",
                f"{first.cpu:.1f}",
                *(spread(cost.cpu for cost in costs) for costs in (warm, page)),
                spread(cost.clock for cost in warm),
                f"{max(cost.memory for cost in warm):.0f}",
            ]
        )
    return Table(
        title="The three examples",
        head=["report of", "first, s", "next, s", "without PDF, s", "next, clock s", "MB"],
        rows=rows,
    )


# --------------------------------------------------------------------------------- records


def by_records(base: Path, *, records: Sequence[int]) -> Table:
    """Return the costs of submissions with these numbers of records, which are all different."""
    costs = []
    for count in records:
        folder = base / f"records-{count}"
        write_records(folder, count)
        costs.append(run((*_REPORT, folder, "--out", base / f"out-{count}")))
        shutil.rmtree(folder)
    seconds = np.array([cost.cpu for cost in costs])
    memory = np.array([cost.memory for cost in costs])

    def picture() -> Figure:
        figure, (above, below) = panels(1.3, 1.3)
        for ax, values, unit in ((above, seconds, "s of a core"), (below, memory, "MB")):
            slope, level = np.polyfit(records, values, 1)
            line = np.geomspace(records[0], records[-1])
            ax.plot(line, level + slope * line, color=SECOND, ls="--", label="straight line")
            ax.plot(records, values, "o", color=MODEL, label="measured")
            log_scale(ax, "x", "y")
            ax.set_ylabel(unit)
        below.set_xlabel("records")
        legend_above(above)
        return figure

    each = 1e3 * np.diff(seconds) / np.diff(records)
    said = f"{each.min():.0f} to {each.max():.0f} ms of a core" if each.size else ""
    said = said and f"Each further record costs {said}."
    return Table(
        title="By records",
        head=["records", "s of a core", "s on the clock", "MB"],
        rows=[
            [f"{n:,}", f"{cost.cpu:.1f}", f"{cost.clock:.1f}", f"{cost.memory:.0f}"]
            for n, cost in zip(records, costs, strict=True)
        ],
        note=f"""
One cart: steps, decays and dwells of many sessions on one bench, up to the limit of a submission.
{said}
""",
        picture=picture if len(records) > 1 else None,
        in_file=len(records) > 1,
    )


def write_records(folder: Path, count: int) -> None:
    """Write a submission of `count` different records, taken from several sessions on one bench."""
    kept: list[Any] = []
    document: Any = None
    for session in range(count):  # because one session has about thirty records
        part = folder.with_name(f"{folder.name}-part")
        write_submission(part, "throne-1dof", seed=session, compact=True)
        document = tomlkit.parse((part / NAME).read_text(encoding="utf-8"))
        (folder / "data").mkdir(parents=True, exist_ok=True)
        for one in document["experiments"].unwrap():
            if len(kept) < count and one["kind"] in ("decay", "step", "sine"):
                file = f"data/{session}-{Path(one['file']).name}"
                shutil.move(part / one["file"], folder / file)
                kept.append(one | {"id": f"{one['id']} of {session}", "file": file})
        shutil.rmtree(part)
        if len(kept) == count:
            break
    document["experiments"] = kept
    (folder / NAME).write_text(tomlkit.dumps(document), encoding="utf-8", newline="\n")


# ------------------------------------------------------------------------------- documents


def documents(base: Path, *, runs: int) -> Table:
    """Return the cost of a document with the same figures, written by hand for one cart."""
    folder = base / "document"
    shutil.copytree(EXAMPLES / "one-cart", folder)
    shutil.copy(Path(__file__).with_name("lab_reference.py"), folder)
    cells = _DOCUMENT.read_text(encoding="utf-8").split("# %%\n")[1:]
    _write_notebook(folder / "lab.ipynb", cells)
    head = '---\ntitle: "One cart"\nformat:\n  html:\n    embed-resources: true\n---\n\n'
    blocks = "\n".join(f"```{{python}}\n{cell}```\n" for cell in cells)
    (folder / "lab.qmd").write_text(head + blocks, encoding="utf-8")
    convert = (sys.executable, "-m", "nbconvert", "--execute", "--to", "html", "lab.ipynb")
    ways: list[tuple[str, str, Sequence[str | Path]]] = [
        ("cartlab, page only", "", (*_REPORT, folder, "--out", base / "page", "--no-pdf")),
        ("cartlab, page and PDF", "", (*_REPORT, folder, "--out", base / "both")),
        ("nbconvert, page only", "nbconvert", convert),
        ("Quarto, page only", "quarto-cli", ("quarto", "render", "lab.qmd", "--to", "html")),
    ]
    rows = []
    for name, tool, command in ways:
        if tool and not installed(tool):
            rows.append(missing(name, columns=4))
            continue
        cwd = folder if tool else _ROOT
        warmed = runs > 1  # the first run is not counted
        costs = [run(command, cwd=cwd) for _ in range(runs + warmed)][warmed:]
        rows.append(
            [
                name,
                spread(cost.cpu for cost in costs),
                spread(cost.clock for cost in costs),
                f"{max(cost.memory for cost in costs):.0f}",
            ]
        )
    return Table(
        title="Beside a document of the same figures",
        head=["document", "s of a core", "s on the clock", "MB"],
        rows=rows,
        better="""
**Others are better** if you want your own words: a document contains what its author writes.
""",
        note="""
The document (`benchmarks/lab_document.py`, about forty lines) draws the decays, steps, dwells,
frequency response with a fit, and closed loop of `submissions/one-cart`. It has no checks,
standard errors or controller design. nbconvert runs it in a Jupyter kernel; Quarto also uses
pandoc to make the page (its installation downloads a program). MB are those of the largest
process.
""",
    )


def _write_notebook(file: Path, cells: Sequence[str]) -> None:
    made = [
        {"cell_type": "code", "id": f"c{i}", "execution_count": None, "metadata": {},
         "outputs": [], "source": source}
        for i, source in enumerate(cells)
    ]  # fmt: skip
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = {"cells": made, "metadata": {"kernelspec": kernel}}
    file.write_text(json.dumps(notebook | {"nbformat": 4, "nbformat_minor": 5}), encoding="utf-8")
