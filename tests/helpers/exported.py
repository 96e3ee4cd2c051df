"""Exported models at work: the C compiled here, the MATLAB function in Octave."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.exchange.model.description import Description
from pipeline.exchange.model.sources import c_sources

COMPILER = shutil.which("cc") or shutil.which("gcc")
OCTAVE = shutil.which("octave-cli") or shutil.which("octave")
no_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
no_octave = pytest.mark.skipif(OCTAVE is None, reason="needs Octave")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-fPIC", "-shared")
_RUN = """
#include "model.h"

int run(const double *t, const double *u, int n, const double *x0, double longest, double *y)
{
    CartModel model = {.p = cart_parameters};
    int fine = 1;

    if (longest > 0.0)
        model.p.max_step = longest;
    cart_model_start(&model, x0 ? x0 : cart_rest);
    for (int k = 0; k < n; k++) {
        for (int i = 0; i < CARTS; i++)
            y[i * n + k] = model.y[i];
        if (k + 1 < n)
            fine = cart_model_step(&model, u[k], t[k + 1] - t[k]) && fine;
    }
    return fine;
}
"""


class CompiledModel:
    """`model.c`, compiled as strictly as the compiler can, in a folder of its own."""

    def __init__(self, description: Description, folder: Path) -> None:
        assert COMPILER is not None
        for name, text in {**c_sources(description), "run.c": _RUN}.items():
            (folder / name).write_text(text, encoding="utf-8")
        files = [folder / "model.c", folder / "run.c"]
        command = [COMPILER, *STRICT, "-o", folder / "model.so", *files, "-lm"]
        done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self._n = description.n
        self._run = ctypes.CDLL(str(folder / "model.so")).run
        self._run.restype = ctypes.c_int

    def simulate(self, t: Array, u: Array, *, x0: Array | None = None, step: float = 0.0) -> Array:
        """Return the readings (carts, samples), from rest at `x0` or where the carts rest."""
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
