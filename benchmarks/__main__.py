"""Compare cartlab with other tools on this machine; write the pages of this folder.

    python -m benchmarks [NAME…] [--quick] [--out PAGE.md]

Without a name all benchmarks run. With names, only their sections change. `--quick` runs small
versions, only to show that everything works. Their results are printed, or written to `--out`.

A benchmark is a module of this folder that is listed in `PAGES`, which also sets the order of
sections on each page. The module defines four names.

    TITLE = "…"             heading of its section
    WORDS = "…"             the question, and the data (Markdown)
    TOOLS = ("pysindy",)    distributions whose versions are printed
    def tables(*, quick: bool) -> list[Table]

`benchmarks/page.py` has `Table`, and helpers for its cells: `spread` (median and quartiles),
`share`, `missing` (the row of a tool that is not installed). Times are processor times
(`time.process_time`), because a machine may have other work.
"""

import argparse
import os
import sys
from importlib import import_module
from pathlib import Path

# With one thread per tool, processor time is that of one core. This must be set before numpy is
# loaded.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

from benchmarks.page import section, write_page

# comparisons with other tools, on published data, and of what cartlab promises about itself
PAGES = {
    "README.md": ("bode", "gap_tools", "grading", "report"),
    "published.md": ("silverbox", "emps", "friction"),
    "own.md": ("feedback", "new_rubric", "time_fit", "time_stages"),
}
BENCHMARKS = tuple(name for names in PAGES.values() for name in names)
FOLDER = Path(__file__).parent


def main() -> None:
    """Run the benchmarks that the user names, and write their sections."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="small, to test that it runs")
    parser.add_argument("--out", type=Path, metavar="PAGE", help="write to this page instead")
    asked = parser.parse_args()
    if strange := sorted(set(asked.names) - set(BENCHMARKS)):
        parser.error(f"no benchmark {', '.join(strange)}; choose from {', '.join(BENCHMARKS)}")
    for name in asked.names or BENCHMARKS:
        page = asked.out or (None if asked.quick else page_of(name))
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


def page_of(name: str) -> Path:
    """Return the page that has a benchmark's section."""
    return next(FOLDER / page for page, names in PAGES.items() if name in names)


def _spent() -> float:
    """Return the processor seconds so far, including those of finished child processes."""
    return sum(os.times()[:4])


if __name__ == "__main__":
    main()
