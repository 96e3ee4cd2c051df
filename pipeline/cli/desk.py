"""The command `desk`: the local web page."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import app, say
from pipeline.errors import ConfigError


@app.command()
def desk(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER]", help="A submission, there or to be made; a grading's output."
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="To serve at; 0: a free one.")] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    host: Annotated[
        str | None, typer.Option(help="Of a lab server: the address to listen at.")
    ] = None,
    users: Annotated[
        Path | None, typer.Option(metavar="FILE", help="With --host: who may see what.")
    ] = None,
) -> None:
    """Open the desk, a page in the browser of this computer, for what the other commands do."""
    from pipeline.desk.app import DeskServer
    from pipeline.desk.ending import Ending
    from pipeline.garbage import collect_for_hours

    if (host is None) != (users is None):
        raise ConfigError("--host and --users go together: who listens to others asks who they are")
    if folder is not None and users is not None:
        raise ConfigError("with --users, the file says which folders there are")
    collect_for_hours()
    server = DeskServer(folder=folder, port=port, host=host or "127.0.0.1", users=users)
    with Ending(say=say) as ending, server:
        say(f"ready: {server.url}")
        if browser and host is None:
            webbrowser.open(server.url)
        while not ending.asked.wait(0.5):  # s
            if not server.runs:
                raise ConfigError(f"the desk's server ended by itself ({ending.log} says more)")
