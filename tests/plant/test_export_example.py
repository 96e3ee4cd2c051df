"""The example of docs/model.md compensates for friction on a virtual bench."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from docs.friction_compensation import main
from pipeline.simulated.emulator import EmulatorOptions, Server
from pipeline.simulated.hidden import prepare_bench
from tests.helpers.commandline import cartlab_here
from tests.helpers.exported import no_compiler
from tests.helpers.places import ROOT

PAGE = (ROOT / "docs" / "model.md").read_text(encoding="utf-8")
BENCH = "--preset throne-1dof --hide coulomb_friction:force=0.006"
HIDDEN = prepare_bench(preset="throne-1dof", hide=("coulomb_friction:force=0.006",))


@contextmanager
def running_bench() -> Iterator[str]:
    """Run the page's virtual bench; yield its address."""
    server, stop = Server(HIDDEN, EmulatorOptions(speed=8.0)), threading.Event()
    serving = threading.Thread(target=server.serve, kwargs={"until": stop.is_set})
    serving.start()
    try:
        yield server.address
    finally:
        stop.set()
        serving.join()
        server.close()


@no_compiler
@pytest.mark.slow
@pytest.mark.sample
def test_the_commands_of_the_page_compensate_the_bench(tmp_path, monkeypatch):
    """The commands of docs/model.md lead from simulated recordings to the compensated bench."""
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^cartlab ((?:simulate|gap) .*bench-4.*)$", PAGE, re.MULTILINE)
    assert [c.split()[0] for c in commands] == ["simulate", "gap"]
    assert f"cartlab emulate {BENCH}\n" in PAGE
    for command in commands:
        done = cartlab_here(*command.split())
        assert done.returncode == 0, done.stderr
    with running_bench() as address:
        errors = main(Path("bench-4/gap/model.fmu"), address)
    assert abs(errors["with friction"]) <= 2 < abs(errors["linear"])
