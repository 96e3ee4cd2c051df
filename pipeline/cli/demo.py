"""The whole job on what is shipped."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import app, progress_line, say
from pipeline.cli.grading import grade
from pipeline.cli.reports import run_report


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Where to write.")] = Path("cartlab-demo"),
) -> None:
    """Run the whole job: a shipped example, a class of three, a bench that hides friction."""
    from pipeline.output import named_folder
    from pipeline.report.draft.write import Files
    from pipeline.resources import EXAMPLES
    from pipeline.simulated.classroom import PLANTED, PRESET, write_class

    out = named_folder(out)
    with search_beside(out) as beside:
        say("1 of 3: the report of three carts")
        run_report(EXAMPLES / "three-cart", out=out / "report", files=Files())
        say("2 of 3: a class, graded")
        teams = out / "class"
        if not teams.exists():
            write_class(teams)
            for mistake in PLANTED:
                say(f"planted: {mistake}")
        jobs = max(1, (os.cpu_count() or 1) - 1)  # a core is taken
        grade([teams], rubric=Path(PRESET), out=out / "grades", jobs=jobs)
        say("3 of 3: what a bench hides")
        for line in found_beside(beside, out):
            say(line)


@contextmanager
def search_beside(out: Path) -> Iterator[subprocess.Popen[str]]:
    """Look for what a bench hides meanwhile: it takes as long as all else together."""
    command = [sys.executable, "-P", "-m", "pipeline.cli.hidden_bench", str(out)]
    pipe, none = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=none, text=True) as beside:
        try:
            yield beside
        finally:
            beside.kill()  # where it has not ended


def found_beside(beside: subprocess.Popen[str], out: Path) -> list[str]:
    """Return what is to be said of the bench; what the other process could not do is done here."""
    with progress_line() as progress:
        progress("looking for what the bench hides")
        assert beside.stdout is not None
        told = beside.stdout.read()  # its stdin stays open: at the end of that it ends
        if beside.wait() == 0:
            return json.loads(told)
        say(f"the process beside this one failed (status {beside.returncode}): once more, here")
        from pipeline.cli.hidden_bench import find_hidden

        return find_hidden(out, progress=progress)
