"""Settings of a process at its start: one thread for linear algebra, seldom garbage collection."""

import atexit
import gc
import os
from pathlib import Path

# ---------------------------------------------------------------------- one thread
#
# With two threads a report takes a fifth more processor time.

_ONE_EACH = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def one_thread() -> None:
    """Make linear algebra use one thread, in a process that only cartlab uses.

    Call it before numpy is loaded. Settings of the user are kept.
    """
    for name, value in _ONE_EACH.items():
        os.environ.setdefault(name, value)


def with_one_thread() -> dict[str, str]:
    """Return the environment of a child process: one thread, and the same package as here."""
    package = str(Path(__file__).resolve().parents[1])
    before = os.environ.get("PYTHONPATH")
    path = f"{package}{os.pathsep}{before}" if before else package
    return {**os.environ, **_ONE_EACH, "PYTHONPATH": path}


# --------------------------------------------------------------------- seldom garbage collection

# Number of new containers that triggers a search for garbage. With Python's default of 700, a
# report searches a few hundred thousand objects 500 times. This takes a tenth of the report's time
# and frees nothing.
_NEW_OBJECTS = 300_000
_NEW_OBJECTS_SERVER = 30_000  # the same for a process that runs for hours


def collect_seldom() -> None:
    """Search for cycles of dead objects less often, in a process that only cartlab uses.

    Skip the search at exit as well: the system frees the memory anyway, and the search takes an
    eighth of a report's time.
    """
    gc.set_threshold(_NEW_OBJECTS)
    atexit.register(gc.freeze)


def collect_for_hours() -> None:
    """Search for dead objects more often than `collect_seldom`, in a process that runs for hours.

    Saving rows in a desk leaves many dead objects. With `collect_seldom` alone, 120 rows filled 30
    MB before the first search.
    """
    gc.set_threshold(_NEW_OBJECTS_SERVER)
