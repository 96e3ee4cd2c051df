"""The command `emulate`: a virtual bench on a serial line."""

import json
import signal
import threading
from typing import Annotated

import typer

from pipeline.cli.common import Hide, Model, Preset, app, say


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
) -> None:
    """Run a virtual bench that speaks the serial protocol; print its address on stderr."""
    from pipeline.simulated.emulator import EmulatorOptions, Server
    from pipeline.simulated.hidden import prepare_bench
    from pipeline.simulated.links import RunningBench, announced

    bench = prepare_bench(preset=preset, model=model, hide=hide or ())
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
