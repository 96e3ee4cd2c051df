"""One thread for linear algebra: our matrices are small, so a second thread only waits.

With two threads a report takes a fifth more processor time.
"""

import os
from pathlib import Path

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
