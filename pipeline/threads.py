"""One thread for linear algebra: our matrices are small, and more threads only wait for another.

With two, a report takes a fifth more of the processor.
"""

import os

ONE_EACH = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


def one_thread() -> None:
    """Have linear algebra compute in one thread, in a process that is ours alone.

    Called before numpy is loaded; what the user has set stays.
    """
    for name, value in ONE_EACH.items():
        os.environ.setdefault(name, value)
