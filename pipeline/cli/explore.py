"""The command `explore`: record at a bench until the carts are known."""

import sys
from typing import Annotated

import typer

from pipeline.cli import INTERRUPTED
from pipeline.cli.acquire import watching
from pipeline.cli.common import Folder, app
from pipeline.errors import ConfigError


@app.command()
def explore(
    folder: Folder,
    port: Annotated[str, typer.Option(help="The bench, as for `acquire`.")],
    until: Annotated[
        str,
        typer.Option(metavar="GOAL", help='Accuracy to reach: "zeta 1%", "all 0.1%".'),
    ] = "all 1%",
    limit: Annotated[
        str, typer.Option("--time", help="Time limit, including rests: 20min, 90s.")
    ] = "20min",
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for manual steps to be confirmed.")
    ] = False,
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask before each chosen recording; v vetoes it.")
    ] = False,
    web: Annotated[
        bool,
        typer.Option("--web", help="Show the session in a browser, with buttons to veto and stop."),
    ] = False,
) -> None:
    """Record, identify, analyse the gap and choose the next recording, until the goal is met."""
    from pipeline.bench.explore import explore_bench
    from pipeline.experiments.information import read_error_goal, read_time
    from pipeline.report.exploration import NAME, write_diary

    goal, seconds = read_error_goal(until), read_time(limit)
    if ask and not sys.stdin.isatty():
        raise ConfigError("--ask needs a terminal to answer at")
    with watching(folder, web=web, yes=yes) as terminal:
        try:
            turns = explore_bench(
                folder,
                port=port,
                observer=terminal,
                buttons=terminal.buttons,
                goal=goal,
                write_diary=write_diary,
                seconds=seconds,
                vetoes=terminal.vetoes if ask else lambda recording: False,
            )
        except KeyboardInterrupt:
            terminal.remark("stopped; finished recordings are in the submission")
            sys.exit(INTERRUPTED)
        terminal.remark(f"{len(turns)} turns; wrote {folder / NAME}")
    if not turns[-1].reached:
        raise typer.Exit(1)
