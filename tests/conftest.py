"""Fixtures shared by the tests."""

import atexit
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.helpers.benches import Emulator, emulator
from tests.helpers.compiled import await_compiler, start_compiler
from tests.helpers.places import REAL_DATA
from tests.helpers.waiting import PATIENCE

# Let Python store compiled code, even in containers that forbid it. Otherwise every program that
# the tests start would compile the package again.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Desks started by tests write no log into the user's home folder.
os.environ["XDG_STATE_HOME"] = tempfile.mkdtemp(prefix="cartlab-tests-")
atexit.register(shutil.rmtree, os.environ["XDG_STATE_HOME"], ignore_errors=True)

if "PYTEST_XDIST_WORKER" in os.environ:  # this worker shares the machine with others
    os.environ.setdefault("OMP_NUM_THREADS", "1")

# Hypothesis draws the same examples every time and sets no time limit, as a machine may be busy.
settings.register_profile(
    "cartlab", deadline=None, derandomize=True, max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)  # fmt: skip
settings.load_profile("cartlab")

_BENCHES = "benches"  # group of the files that mostly wait for virtual benches
_WITH_BENCHES = {
    "bench/test_acquire", "bench/test_mistakes", "bench/test_safety",
    "simulated/test_emulator", "system/test_live_page",
}  # fmt: skip
_PAGES = "pages"  # group of the files that share a browser
_WITH_BROWSER = {
    "system/test_desk", "system/test_desk_check", "system/test_desk_feedback",
    "system/test_desk_grades", "system/test_desk_rooms", "system/test_plots_page",
    "system/test_report_pages",
}  # fmt: skip
_LONGEST = {  # each takes ten seconds or more, so it must not start late
    "desk/test_bench", "desk/test_login", "desk/test_grades", "desk/test_student",
    "experiments/test_exploration", "gap/test_explain",
    "grading/test_gradescope", "grading/batch/test_faults_of_the_computer",
    "grading/mistakes/test_faults", "grading/similarity/test_shared_data",
    "grading/test_class_changes", "report/test_gap", "report/test_report", "report/test_solution",
    "simulated/test_hidden", "statistics/test_gap",
}  # fmt: skip
_FEW = 2  # up to this many files, starting other processes takes more time than it saves

# A shell starts background jobs with Ctrl-C ignored, and their children inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _silent_progress() -> Iterator[None]:
    """Show no progress, so that what a command prints does not depend on how long it takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.cli.common.FIRST_WORD", PATIENCE)
        yield


def pytest_configure(config: pytest.Config) -> None:
    """Compile the simulators while the workers collect their tests."""
    if config.getoption("numprocesses") and "PYTEST_XDIST_WORKER" not in os.environ:
        until_the_end = ExitStack()
        config.add_cleanup(until_the_end.close)
        until_the_end.enter_context(start_compiler())


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Use no workers for one or two files.

    With more files, use one worker more than there are processors, as tests often wait for a bench.
    """
    few = len(config.args) <= _FEW and all(".py" in argument for argument in config.args)
    return 0 if few else (os.cpu_count() or 1) + 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests that wait for benches first, then those with a browser, then the longest files.

    The short files come last, so that no worker is busy with a long file at the end.
    """
    groups = [_group(item.nodeid) for item in items]
    size = Counter(groups)
    order = {
        group: (group != _BENCHES, group != _PAGES, group not in _LONGEST, size[group], group)
        for group in size
    }
    items.sort(key=lambda item: order[_group(item.nodeid)])


def pytest_collection_finish() -> None:
    """Exclude the collected tests and modules from later garbage collections."""
    gc.freeze()
    if "PYTEST_XDIST_WORKER" in os.environ:
        await_compiler()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> object:
    """Give each file to one worker; files that wait for benches share one, as do those of pages."""
    if config.getoption("dist") != "loadscope":
        return None  # the user chose another distribution of the tests
    from xdist.scheduler import LoadScopeScheduling

    class ByGroup(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _group(nodeid)

    return ByGroup(config, log)


def _group(nodeid: str) -> str:
    file = nodeid.partition("::")[0].removesuffix(".py").removeprefix("tests/")
    return _BENCHES if file in _WITH_BENCHES else _PAGES if file in _WITH_BROWSER else file


@pytest.fixture(scope="session", autouse=True)
def _patient_host() -> Iterator[None]:
    """Give virtual benches more time to answer, since they may have to wait for a processor."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.bench.run.SILENCE", 3.0)
        for module in ("run", "serial_line"):
            patch.setattr(f"pipeline.bench.{module}.FIRST_LINE", 5.0)
        yield


@contextmanager
def _working_here() -> Iterator[None]:
    from tests.helpers.desks import WorkerHere

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipeline.desk.jobs.Supervisor", WorkerHere)
        yield


@pytest.fixture
def work_here() -> Iterator[None]:
    """Run the desk's jobs in this process instead of in new ones."""
    with _working_here():
        yield


@pytest.fixture(scope="module")
def all_work_here() -> Iterator[None]:
    """Run the jobs of all desks of a module in this process, also of those that its tests share."""
    with _working_here():
        yield


@pytest.fixture(scope="session")
def fast() -> Iterator[Emulator]:
    """Return a virtual bench that runs twenty times as fast as a real one and sends fewer lines."""
    with emulator("--speed", "20", "--period", "5.003") as bench:
        yield bench


@pytest.fixture(scope="session")
def real_bench() -> Iterator[Emulator]:
    """Return a virtual bench as fast as a real one."""
    with emulator() as bench:
        yield bench


@pytest.fixture
def real(real_bench: Emulator) -> Emulator:
    """Return `real_bench`, with its carts at rest and no faults left from earlier tests.

    A run of ten lines, which no test records, marks the end of the earlier tests' events.
    """
    from pipeline.bench.serial_line import open_line
    from pipeline.protocol import Hands, Start, Wave

    with open_line(real_bench.address, baud=115_200) as line:
        line.send(Hands(), Start(wave=Wave.DELTA, frequency=100.0, amplitude=0))
        while real_bench.event("run")["lines"] > 10:
            pass
    return real_bench


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real measurements; tests that need it are skipped if it is absent."""
    if not REAL_DATA.is_dir():
        pytest.skip(f"real measurements are not here ({REAL_DATA})")
    return REAL_DATA
