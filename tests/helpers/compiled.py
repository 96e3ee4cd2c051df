"""Compile the tests' simulators once before the tests begin, instead of in each process."""

import os
import subprocess
import sys

import psutil

from tests.helpers.places import ROOT
from tests.helpers.waiting import until

_COMPILER = "CARTLAB_TESTS_COMPILER"  # process id, for other processes that wait for the end


def start_compiler() -> "subprocess.Popen[bytes]":
    """Start compiling in another process; later child processes can wait for its end."""
    script = "from tests.helpers.compiled import compile_all; compile_all()"
    compiler = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.DEVNULL, cwd=ROOT)
    os.environ[_COMPILER] = str(compiler.pid)
    return compiler


def await_compiler() -> None:
    """Wait until the other process has compiled."""

    def ended() -> bool:
        try:
            compiler = psutil.Process(int(os.environ[_COMPILER]))
            return compiler.status() == psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            return True

    if _COMPILER in os.environ:
        until(ended, "the end of the compiler")


def compile_all() -> None:
    """Compile the workflow's simulators and the tests' independent one."""
    import numpy as np

    from pipeline.gap.explain import predictor_compiled
    from pipeline.plant.augmented import compile_simulator
    from tests.truth.bench import simulate_truth

    with predictor_compiled():
        compile_simulator()
        t = 1e-3 * np.arange(2)
        simulate_truth(m=[1.0], c=[0.0], k=[1.0, 0.0], t=t, u=np.zeros(2), free=(1,))
