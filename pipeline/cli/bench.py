"""Commands of a bench: plan, acquire, explore, emulate."""

import json
import signal
import sys
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli import INTERRUPTED
from pipeline.cli.common import (
    AsJson,
    Folder,
    Hide,
    Model,
    Preset,
    app,
    progress_line,
    say,
)
from pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pipeline.bench.terminal import Terminal


@app.command()
def plan(
    folder: Folder,
    stock: Annotated[
        bool, typer.Option("--stock", help="The bench has only the stock commands (no chirp).")
    ] = False,
    number: Annotated[
        int | None,
        typer.Option("--next", min=1, max=20, help="Choose this many new experiments, best first."),
    ] = None,
    goal: Annotated[
        str | None,
        typer.Option(
            "--for",
            help="With --next: what to improve: a parameter (zeta_2), `design` (the "
            "predicted overshoot), `worst`, `mean`, `volume`, or `gap` (the right explanation).",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Propose the experiments to record: write plan.toml, or add to it."""
    from pipeline.bench.raw import known_commands
    from pipeline.experiments.information import WORST
    from pipeline.experiments.next_recordings import plan_next
    from pipeline.experiments.plan import load_plan, plan_data, plan_table
    from pipeline.experiments.propose import current_plan, make_plan
    from pipeline.submission import load_submission
    from pipeline.words.text import with_symbols

    if goal and number is None:
        raise ConfigError("--for states the goal of the next experiments, so it needs --next N")
    submission = load_submission(folder)
    before = {recording.id for recording in current_plan(submission).recordings}
    with progress_line() as progress:
        if number is None:
            message, trouble = make_plan(submission, stock=stock, progress=progress)
            words, further = [trouble, message], {}
        else:
            commands = frozenset[str]() if stock else known_commands(folder)
            found, wrote = plan_next(
                submission, n=number, goal=goal or WORST, commands=commands, progress=progress
            )
            words = [wrote, *map(with_symbols, found.sentences)]
            keys = ("now", "errors", "planned") if found.separation is None else ("separation",)
            further = {"next": {"for": found.words} | {key: getattr(found, key) for key in keys}}
    made = load_plan(submission)
    new = {recording.id for recording in made.recordings} - before
    if as_json:
        data = plan_data(made, submission, new=new) | further
        typer.echo(json.dumps(data, indent=1, ensure_ascii=False))
    else:
        typer.echo(plan_table(made, submission, new=new))
    for sentence in filter(None, words):
        say(sentence)


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
    from pipeline.bench.acquire import explore_bench
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


@app.command()
def emulate(
    preset: Preset = None,
    model: Model = None,
    hide: Hide = None,
    port: Annotated[
        str, typer.Option(help="socket://HOST:PORT (port 0: any that is free) or pty.")
    ] = "socket://127.0.0.1:0",
    speed: Annotated[
        float, typer.Option(min=0.01, help="Speed relative to real time, if the computer keeps up.")
    ] = 1.0,
    period: Annotated[
        float, typer.Option(min=0.5, max=20.0, help="True time between lines, ms.")
    ] = 1.0024,
    stock: Annotated[
        bool, typer.Option("--stock", help="Support only the stock commands: d, g and z.")
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=RATE",
            help="Disturb the line: drop=0.01, delay@5, …; may be repeated.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed for noise, hand movements and faults.")
    ] = 0,
    remote: Annotated[
        bool, typer.Option("--remote", help="Listen to other computers too.")
    ] = False,
    key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Be the bench of --team in this answer key."),
    ] = None,
    team: Annotated[str, typer.Option(help="With --key: the name of the team's folder.")] = "",
) -> None:
    """Run a virtual bench that speaks the serial protocol; print its address on stderr."""
    from pipeline.simulated.emulator import EmulatorOptions, Server
    from pipeline.simulated.hidden import prepare_bench
    from pipeline.simulated.links import RunningBench, announced

    if (key is None) == bool(team):
        raise typer.BadParameter("--key and --team belong together")
    bench = prepare_bench(preset=preset, model=model, hide=hide or ())
    if key is not None:
        from pipeline.simulated.answer_key import bench_of_team

        bench = bench_of_team(bench, team=team, key=key)
    options = EmulatorOptions(
        port=port,
        remote=remote,
        speed=speed,
        period=1e-3 * period,
        stock=stock,
        faults=fault or (),
        seed=seed,
    )
    server = Server(bench, options, on_event=lambda event: say(json.dumps(event)))
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    for sentence in bench.effect_sentences:
        say(f"hidden: {sentence}")
    description = server.description
    say(
        f"a duty count is {description.input_per_count:.4g} {description.input_unit}, "
        f"an encoder count {description.position_per_count:.4g} {description.position_unit}"
    )
    try:
        with announced(RunningBench(name=bench.name, address=server.address)):
            say(f"ready: {server.address}")
            server.serve(until=stop.is_set)
    finally:
        server.close()
