"""Run exported models: the C code compiled here, the MATLAB function in Octave."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.plant.export import Description, c_sources

COMPILER = shutil.which("cc") or shutil.which("gcc")
OCTAVE = shutil.which("octave-cli") or shutil.which("octave")
no_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
no_octave = pytest.mark.skipif(OCTAVE is None, reason="needs Octave")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-fPIC", "-shared")
_RUN = Path(__file__).with_name("run_model.c")


class CompiledModel:
    """`model.c` in a folder of its own, compiled with all of the compiler's warnings."""

    def __init__(self, description: Description, folder: Path) -> None:
        assert COMPILER is not None
        for name, text in c_sources(description).items():
            (folder / name).write_text(text, encoding="ascii")
        files = [folder / "model.c", _RUN]
        command = [COMPILER, *STRICT, f"-I{folder}", "-o", folder / "model.so", *files, "-lm"]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self._n = description.n
        self._run = ctypes.CDLL(str(folder / "model.so")).run
        self._run.restype = ctypes.c_int

    def simulate(self, t: Array, u: Array, *, x0: Array | None = None, step: float = 0.0) -> Array:
        """Return the readings (carts, samples) of a motion from rest, at `x0` or at equilibrium."""
        y = np.zeros((self._n, t.size))
        given = [np.ascontiguousarray(a, dtype=np.float64) for a in (t, u)]
        start = None if x0 is None else np.asarray(x0, dtype=np.float64)
        pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in given]
        fine = self._run(
            *pointers,
            t.size,
            None if start is None else start.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_double(step),
            y.ctypes.data_as(ctypes.c_void_p),
        )
        assert fine
        return y
