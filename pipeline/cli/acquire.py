"""The command `acquire`: fill a submission from a bench, or from files as they appear."""

import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli import INTERRUPTED
from pipeline.cli.common import Folder, app
from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.bench.terminal import Terminal


@app.command()
def acquire(
    folder: Folder,
    port: Annotated[
        str | None,
        typer.Option(help="The bench: COM3, /dev/ttyACM0, socket://HOST:PORT, …"),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--import", metavar="FOLDER", help="Import files that another program writes there."
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="ID", help="Record only this part of the plan; may be repeated."),
    ] = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not wait for manual steps to be confirmed.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="With --port: show the session in a browser as well.")
    ] = False,
    once: Annotated[
        bool, typer.Option("--once", help="With --import: import what is there now, then stop.")
    ] = False,
) -> None:
    """Record the plan on a bench, or import files as they appear, into a submission."""
    if (port is None) == (source is None):
        raise ConfigError("state where the data come from: either --port or --import")
    if web and port is None:
        raise ConfigError("--web shows a bench, so it needs --port")
    with watching(folder, web=web, yes=yes) as terminal:
        if source is not None:
            _import(folder, source, terminal, once=once)
        elif port is not None:
            _record(folder, port, terminal, only=only or ())


@contextmanager
def saying_where(folder: Path) -> Iterator[None]:
    """Turn a full disk or a read-only folder into an error that says what to do."""
    try:
        yield
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise ConfigError(
            f"{where}{error.strerror or error}: `acquire` writes into {folder}; free some space "
            "there, or make it writable, and repeat the command. Finished recordings are kept"
        ) from None


@contextmanager
def watching(folder: Path, *, web: bool = False, yes: bool) -> Iterator["Terminal"]:
    """Yield the session, which the terminal shows and perhaps a page."""
    from pipeline.bench.terminal import Terminal

    with saying_where(folder), Terminal(folder, yes=yes, has_page=web) as terminal:
        if not web:
            yield terminal
            return
        from pipeline.bench.live_page import LivePage

        with LivePage(terminal) as page:
            terminal.say(f"watch{'' if yes else ' and confirm'} at {page.url}")
            yield terminal


def _record(folder: Path, port: str, terminal: "Terminal", *, only: Collection[str]) -> None:
    from pipeline.bench.acquire import acquire as carry_out

    try:
        outcomes = carry_out(
            folder, port=port, observer=terminal, only=only, buttons=terminal.buttons
        )
    except KeyboardInterrupt:
        terminal.remark("stopped; repeat the command to continue")
        sys.exit(INTERRUPTED)
    whole = {outcome.recording.id for outcome in outcomes if not outcome.partial}
    failed = {outcome.recording.id for outcome in outcomes} - whole
    report = f": try `cartlab report {folder}`" if whole or not failed else ""
    terminal.remark(f"{len(whole)} recorded into {folder}{report}")
    if not outcomes:
        terminal.remark(
            "everything is recorded already; to record something again, delete its entry from "
            "submission.toml"
        )
    if failed:
        terminal.remark(
            f"not recorded: {', '.join(sorted(failed))}; remove the cause and repeat the command"
        )
        raise typer.Exit(1)


def _import(folder: Path, source: Path, terminal: "Terminal", *, once: bool) -> None:
    from pipeline.bench.importing import Importer
    from pipeline.lock import lock_or_refuse

    if not folder.exists():  # the imported files do not state the number of carts
        raise ConfigError(f"{folder}: no such folder; run `cartlab new {folder} --carts N`")
    taken = 0
    try:
        with lock_or_refuse(folder):
            for imported in Importer(folder, source, observer=terminal).watch(once=once):
                taken += 1
                as_what = f"{imported.file}: {imported.experiment}, a {imported.kind}"
                terminal.remark("; ".join([as_what, *imported.remarks]))
    except KeyboardInterrupt:
        pass  # Ctrl-C is the normal end
    terminal.remark(f"{taken} files imported into {folder}: check its submission.toml")
