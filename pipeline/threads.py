"""One thread for linear algebra: our matrices are small, so a second thread only waits.

With two threads a report takes a fifth more processor time.
"""

import os

ONE_EACH = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def one_thread() -> None:
    """Make linear algebra use one thread, in a process that only cartlab uses.

    Call it before numpy is loaded. Settings of the user are kept.
    """
    for name, value in ONE_EACH.items():
        os.environ.setdefault(name, value)
