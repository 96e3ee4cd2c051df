"""Measure cartlab, and what people use in its place, on this machine; write `benchmarks/README.md`.

    python -m benchmarks [NAME…] [--quick] [--out PAGE.md]

Without a name all are made; the sections of the others stay as they are. `--quick` makes small ones
that show only that everything runs: they go to stdout, or where `--out` says, never into the page.

A benchmark is a module of this folder whose name stands in `BENCHMARKS`, which is the order of the
page. It has

    TITLE = "…"             heading of its section
    WORDS = "…"             what is compared, on which data (Markdown)
    TOOLS = ("pysindy",)    distributions whose versions are printed, whether installed or not
    def tables(*, quick: bool) -> list[Table]

`benchmarks/page.py` has `Table`, and what its cells are made with: `spread` (median and quartiles),
`share`, `missing` (the row of a tool that is not installed). Times are of the processor
(`time.process_time`), as a machine may have other work. Quick, one takes seconds.
"""

import argparse
import os
import sys
from importlib import import_module
from pathlib import Path

# One thread a tool, set before numpy is loaded: a time of the processor is then one of a core.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

from benchmarks.page import section, write_page

PAGE = Path(__file__).with_name("README.md")
BENCHMARKS = (
    "bode",
    "gap_tools",
    "silverbox",
    "emps",
    "grading",
    "report",
    "feedback",
    "time_fit",
    "time_stages",
)


def main() -> None:
    """Make the sections asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="small, to see that all runs")
    parser.add_argument("--out", type=Path, metavar="PAGE", help="another page than README.md")
    asked = parser.parse_args()
    if strange := sorted(set(asked.names) - set(BENCHMARKS)):
        parser.error(f"no benchmark {', '.join(strange)}; there are {', '.join(BENCHMARKS)}")
    page = asked.out or (None if asked.quick else PAGE)
    for name in asked.names or BENCHMARKS:
        module = import_module(f"benchmarks.{name}")
        began = _spent()
        tables = module.tables(quick=asked.quick)
        seconds = _spent() - began
        figures = page.parent / "figures" if page else None
        made = section(name, module, tables, seconds=seconds, figures=figures)
        if page:
            write_page(page, {name: made}, order=BENCHMARKS)
        else:
            print(made)
        print(f"{name}: {seconds:.0f} s of the processor", file=sys.stderr)


def _spent() -> float:
    """Return the seconds of the processor so far, of programs started and ended too."""
    return sum(os.times()[:4])


if __name__ == "__main__":
    main()
