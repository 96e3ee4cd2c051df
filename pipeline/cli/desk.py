"""The command `desk`: the local web page."""

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.common import app, progress_line, say
from pipeline.errors import ConfigError


@app.command()
def desk(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER]", help="A submission (existing or new), or the output of `grade`."
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port to serve at; 0: any free one.")
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
    host: Annotated[
        str | None, typer.Option(help="For a lab server: the address to listen at.")
    ] = None,
    users: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="With --host: the users and what each may see."),
    ] = None,
) -> None:
    """Open the desk: all tasks of the other commands in a browser on this computer."""
    if (host is None) != (users is None):
        raise ConfigError("--host and --users need each other: others may only enter by name")
    if folder is not None and users is not None:
        raise ConfigError("with --users, the file lists the folders: do not give one here")
    with progress_line() as progress:
        progress("starting the desk")
        from pipeline.desk.app import DeskServer
        from pipeline.desk.crash_log import CrashLog
        from pipeline.startup import collect_for_hours

        collect_for_hours()
        server = DeskServer(folder=folder, port=port, host=host or "127.0.0.1", users=users)
    with CrashLog(say=say) as ending, server:
        say(f"ready: {server.url}")
        if ending.killed:
            say(f"cartlab: {ending.killed}")
        if browser and host is None:
            webbrowser.open(server.url)
        while not ending.asked.wait(0.5):  # s
            if not server.runs:
                raise ConfigError(f"the desk's server stopped unexpectedly (see {ending.log})")
