"""The command that explores a bench by itself."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.acquire import saying_where, watching
from pipeline.cli.common import INTERRUPTED, Folder, app


@app.command()
def explore(
    folder: Folder,
    port: Annotated[str, typer.Option(help="The bench, as for `acquire`.")],
    until: Annotated[
        str,
        typer.Option(metavar="GOAL", help='How well what is to be known: "zeta 1%", "all 0.1%".'),
    ] = "all 1%",
    limit: Annotated[
        str, typer.Option("--time", help="At the bench at most, rests included: 20min, 90s.")
    ] = "20min",
    yes: Annotated[
        bool, typer.Option("--yes", help="Take what hands are asked to do as done.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="Show the session in a browser, with buttons to stop it.")
    ] = False,
) -> None:
    """Record, identify, look for the gap, choose the next recording, again, until it is known."""
    from pipeline.bench.explore.explore import Recorded, read_time, read_wish
    from pipeline.bench.explore.explore import explore as go
    from pipeline.bench.host.acquire import acquire
    from pipeline.bench.live.terminal import Terminal
    from pipeline.bench.planning.plan_words import session_time
    from pipeline.report.exploration.page import NAME

    wish, seconds = read_wish(until), read_time(limit)
    with (
        Terminal(yes=yes) as terminal,
        saying_where(folder),
        watching(folder, terminal, web=web, yes=yes) as (observers, buttons),
    ):

        def record(ids: Sequence[str]) -> Recorded:
            outcomes = acquire(folder, port=port, observers=observers, only=ids, buttons=buttons)
            ids = tuple(o.recording.id for o in outcomes if not o.partial)
            tried = [o.recording for o in outcomes if o.lines]
            return Recorded(ids=ids, seconds=session_time(tried))

        try:
            turns = go(folder, record=record, wish=wish, seconds=seconds, tell=terminal.remark)
        except KeyboardInterrupt:
            terminal.remark("stopped; what was recorded is in the submission")
            raise typer.Exit(INTERRUPTED) from None
        terminal.remark(f"{len(turns)} turns; wrote {Path(folder) / NAME}")
    if not turns[-1].reached:
        raise typer.Exit(1)
