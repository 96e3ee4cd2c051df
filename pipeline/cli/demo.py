"""The command `demo`: the whole workflow on shipped examples.

`python -m` runs this module as the second process of the demo: it hides friction in a bench, then
finds it.
"""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import app, progress_line, say
from pipeline.cli.grading import grade
from pipeline.cli.reports import explain, run_report
from pipeline.startup import collect_seldom
from pipeline.words.progress import Progress, silent


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Output folder.")] = Path("cartlab-demo"),
) -> None:
    """Try everything: an example report, a class of three, a bench with hidden friction."""
    from pipeline.output import named_folder
    from pipeline.report.make_report import Files
    from pipeline.resources import EXAMPLES
    from pipeline.simulated.examples import PLANTED, PRESET, write_class

    out = named_folder(out)
    with search_beside(out) as beside:
        say("1 of 3: the report of three carts")
        run_report(EXAMPLES / "three-cart", out=out / "report", files=Files())
        say("2 of 3: grading a class")
        teams = out / "class"
        if not teams.exists():
            write_class(teams)
            for mistake in PLANTED:
                say(f"planted: {mistake}")
        jobs = max(1, (os.cpu_count() or 1) - 1)  # leave one core for the search
        grade([teams], rubric=Path(PRESET), out=out / "grades", jobs=jobs)
        say("3 of 3: the hidden effect of a bench")
        for line in found_beside(beside, out):
            say(line)


@contextmanager
def search_beside(out: Path) -> Iterator[subprocess.Popen[str]]:
    """Search for a hidden effect in a second process; this halves the time of the demo."""
    command = [sys.executable, "-P", "-m", "pipeline.cli.demo", str(out)]
    pipe, none = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=none, text=True) as beside:
        try:
            yield beside
        finally:
            beside.kill()  # it still runs only after an error in the other parts


def found_beside(beside: subprocess.Popen[str], out: Path) -> list[str]:
    """Return the messages of the second process; if it failed, search again in this process."""
    with progress_line() as progress:
        progress("looking for the hidden effect")
        assert beside.stdout is not None
        output = beside.stdout.read()  # the process ends when its stdin is closed
        if beside.wait() == 0:
            return json.loads(output)
        say(f"the second process failed (status {beside.returncode}): searching again here")
        return find_hidden(out, progress=progress)


# ------------------------------------------------------------------- the second process


def find_hidden(out: Path, *, progress: Progress) -> list[str]:
    """Write a bench with hidden friction and its gap analysis; return the messages to print."""
    from pipeline.gap.explain import predictor_compiled
    from pipeline.simulated.hidden import prepare_bench
    from pipeline.simulated.submission import write_submission

    hidden, folder = prepare_bench(preset="throne-2dof", hide=["coulomb_friction"]), out / "bench"
    if not (folder / "submission.toml").exists():
        with predictor_compiled():
            write_submission(folder, hidden, seed=0)
    _, told = explain(folder, out=out / "gap", progress=progress)
    return [*(f"hidden: {sentence}" for sentence in hidden.effect_sentences), *told]


def _end_with_parent() -> None:
    os.read(0, 1)  # returns when the process that started this one has ended
    os._exit(1)  # safe at any time, because files are written whole or not at all


if __name__ == "__main__":
    collect_seldom()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    json.dump(find_hidden(Path(sys.argv[1]), progress=silent), sys.stdout)
