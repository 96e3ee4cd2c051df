"""Virtual benches are forked from a process that has already loaded all they need.

Loading takes two seconds of processor time and happens only once. On systems without fork each
bench loads everything itself.
"""

import json
import os
import signal
import socket
import subprocess
import sys
from functools import cache
from typing import Any
from unittest.mock import patch

from tests.helpers.places import ROOT


def order(**bench: Any) -> None:
    """Request a bench that connects to `port`; the other arguments are those of `be`."""
    if sys.platform == "win32":
        script = f"from tests.helpers.nursery import be; be(**{bench!r})"
        subprocess.Popen([sys.executable, "-c", script], cwd=ROOT)
        return
    wishes = _nursery().stdin
    assert wishes is not None
    print(json.dumps(bench), file=wishes, flush=True)


def be(*, words: list[str], watchdog: float, port: int) -> None:
    """Become the bench with these options; send the pid and then stderr to that port."""
    from pipeline import protocol
    from pipeline.cli import main

    protocol.WATCHDOG = watchdog
    with socket.create_connection(("127.0.0.1", port)) as line:
        with line.makefile("w", buffering=1, encoding="utf-8") as stderr:
            print(os.getpid(), file=stderr)
            try:
                with patch.multiple(sys, argv=words, stderr=stderr):
                    main()
            except SystemExit as end:
                print(json.dumps({"event": "exit", "status": end.code or 0}), file=stderr)
                raise


@cache
def _nursery() -> "subprocess.Popen[str]":
    """Start the process from which benches are forked; it ends together with this process."""
    script = "from tests.helpers.nursery import fork_benches; fork_benches()"
    return subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, text=True, cwd=ROOT
    )


def fork_benches() -> None:
    """Fork a bench for each line of stdin."""
    load_bench()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # so that ended children leave no zombies
    for line in sys.stdin:
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            be(**json.loads(line))


def load_bench() -> None:
    """Import all that a bench needs, and compile its simulator unless that was done before."""
    from pipeline.simulated.emulator import EmulatorOptions, Server
    from pipeline.simulated.hidden import prepare_bench

    Server(prepare_bench(preset="throne-1dof"), EmulatorOptions()).close()
