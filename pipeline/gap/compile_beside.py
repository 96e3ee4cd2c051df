"""Compile the follower in a second process, while this process compiles the simulator."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipeline.plant.simulator.compiler import is_compiled, kept_in
from pipeline.threads import with_one_thread

_ROOM = Path(__file__).parent / "pem"
_SCRIPT = "from pipeline.gap.pem.run import compile_follower; compile_follower()"


@contextmanager
def follower_compiled() -> Iterator[None]:
    """Compile the follower during this block, unless compiled code is stored or cannot be.

    So the first search on a computer with two cores begins eight seconds earlier. If the second
    process fails, the follower is compiled when it is needed.
    """
    stored = kept_in(_ROOM) is None or is_compiled(_ROOM, function="predict_run")
    if stored or (os.cpu_count() or 1) == 1:
        yield
        return
    command, none = [sys.executable, "-P", "-c", _SCRIPT], subprocess.DEVNULL
    with subprocess.Popen(
        command, stdin=none, stdout=none, stderr=none, env=with_one_thread()
    ) as beside:
        try:
            yield
        except BaseException:
            beside.kill()
            raise
