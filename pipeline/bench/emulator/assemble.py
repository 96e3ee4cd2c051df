"""Put a virtual bench together: carts, a controller, faults, a line."""

import re
from collections.abc import Callable, Sequence

from pipeline.bench.emulator.carts import TRUE_PERIOD, VirtualCarts
from pipeline.bench.emulator.core import Core, ReferenceCore
from pipeline.bench.emulator.faults import Faults, read_fault
from pipeline.bench.emulator.links import open_link
from pipeline.bench.emulator.serve import Server
from pipeline.bench.protocol.messages import EXTENSIONS, Description
from pipeline.errors import ConfigError
from pipeline.synthesis.hidden import HiddenBench


def open_bench(
    bench: HiddenBench,
    *,
    port: str = "socket://127.0.0.1:0",
    remote: bool = False,
    speed: float = 1.0,
    period: float = TRUE_PERIOD,
    stock: bool = False,
    faults: Sequence[str] = (),
    seed: int = 0,
    core: Callable[[Description], Core] = ReferenceCore,
    tell: Callable[[dict], None] = lambda event: None,
) -> Server:
    """Return a bench whose line is open; `serve` keeps it going.

    Parameters
    ----------
    port, remote : as `open_link` takes them.
    period : true s from tick to tick; the controller believes in whole ms.
    stock : it knows no extension of the protocol, nor does it answer a query.
    faults : each as `read_fault` takes it.
    core : makes the controller of a bench so described.

    Raises
    ------
    ConfigError : the port or a fault will not do.
    DataError : no spring ties the carts to a wall, or what is hidden makes them run away.
    """
    struck = Faults([read_fault(text) for text in faults], seed=seed, period=period)
    if port == "pty" and any(text.startswith("disconnect") for text in faults):
        raise ConfigError("--fault disconnect: a pty cannot be pulled out; take --port socket://…")
    carts = VirtualCarts(bench, seed=seed, period=period)
    carts.move(0)  # compiles what moves them, before anybody waits for it
    description = Description(
        name=re.sub(r"[^\w.-]", "_", bench.name, flags=re.ASCII),
        encoders=carts.encoders,
        carts=bench.chain.n,
        period=max(1, round(1e3 * period)) / 1e3,
        commands=frozenset() if stock else EXTENSIONS,
        input_unit=bench.input_unit,
        input_per_count=carts.input_per_count,
        position_unit=bench.position_unit,
        position_per_count=bench.count,
    )
    return Server(
        core(description),
        carts,
        open_link(port, remote=remote),
        description=description,
        faults=struck,
        period=period,
        speed=speed,
        tell=tell,
    )
