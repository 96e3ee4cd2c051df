"""The whole job on what is shipped."""

from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import app, say
from pipeline.cli.grading import grade
from pipeline.cli.models import simulate
from pipeline.cli.reports import gap, run_report


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Where to write.")] = Path("cartlab-demo"),
) -> None:
    """Run the whole job: a shipped example, a class of three, a bench that hides friction."""
    from pipeline.output import check_folder
    from pipeline.resources import EXAMPLES
    from pipeline.synthesis.classroom import PLANTED, PRESET, write_class

    out = check_folder(out)
    # On a new machine the simulator is compiled beside what does without it.
    compiling = get_context("spawn").Process(target=_compile, daemon=True)
    compiling.start()
    say("1 of 3: the report of three carts")
    run_report(EXAMPLES / "three-cart", out=out / "report", pdf=True)
    say("2 of 3: a class, graded")
    teams = out / "class"
    if not teams.exists():
        write_class(teams)
        for mistake in PLANTED:
            say(f"planted: {mistake}")
    grade([teams], rubric=Path(PRESET), out=out / "grades")
    say("3 of 3: what a bench hides")
    bench = out / "bench"
    compiling.join()
    if not (bench / "submission.toml").exists():
        simulate(out=bench, preset="throne-2dof", hide=["coulomb_friction"])
    gap(bench, out=out / "gap")


def _compile() -> None:
    from pipeline.plant.nonlinear.augmented import compile_simulator

    compile_simulator()
