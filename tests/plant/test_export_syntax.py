"""An expression of a law has the same value in C and in MATLAB as in Python."""

import ctypes
import re
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.effect import Effect
from pipeline.plant.export import in_c, in_matlab, substitute
from tests.helpers.exported import COMPILER, OCTAVE, no_compiler, no_octave
from tests.plant.test_new_effect import CUBIC_DRAG

VALUES = {"a": 1.3, "b": -0.7, "c": 2.0}
FUNCTIONS = {
    **{"abs": abs, "min": min, "max": max, "exp": np.exp, "sin": np.sin, "cos": np.cos},
    **{"sign": np.sign, "clip": lambda a, low, high: min(max(a, low), high), "π": np.pi},
}
TRICKY = (
    "a - (b - c)", "a / (b * c)", "a / b * c", "-a ** 2", "(-a) ** 2", "a ** c ** c",
    "(a ** c) ** c", "a ** -c", "1 / 2 * a", "a - -b", "a * -b", "min(a, b, c)", "max(a, c, b) - 1",
    "clip(a, -1, 1)", "clip(b, 0, 1)", "sign(b) * max(abs(b) - 0.2, 0)", "sin(2 * π * a / b + c)",
    "exp(-(a / b) ** 2)", "3 * cos(a) ** 2",
)  # fmt: skip


def laws(effect: Effect) -> list[str]:
    """Return the expressions of an effect's law."""
    names = ("force", "size", "rate", "arrives", "past")
    return [text for name in names if (text := getattr(effect.law, name, ""))]


LAWS = sorted({text for effect in (*CATALOGUE, CUBIC_DRAG) for text in laws(effect)})
SYMBOLS = sorted({s for text in LAWS for s in re.findall(r"[^\W\d]+", text)} - {*FUNCTIONS})


def values(text: str) -> float:
    symbols = {name: 0.4 + 0.37 * i for i, name in enumerate(SYMBOLS)}
    return eval(text, {**FUNCTIONS, **symbols, **VALUES})


def named() -> dict[str, float]:
    """Return the value of every symbol under its name in the model, s0, s1 and so on."""
    return {f"s{i}": values(name) for i, name in enumerate(SYMBOLS)} | VALUES


ALL = [*TRICKY, *LAWS]
MODELLED = [substitute(text, {name: f"s{i}" for i, name in enumerate(SYMBOLS)}) for text in ALL]


@no_compiler
def test_expressions_keep_their_value_in_c(tmp_path):
    """In C every law and expression has the same value as in Python."""
    known = "".join(f"static const double {n} = {v!r};\n" for n, v in named().items())
    body = "".join(f"    out[{i}] = {in_c(text)};\n" for i, text in enumerate(MODELLED))
    source = (
        "#include <math.h>\n#define PI 3.14159265358979323846\n"
        f"static double sign(double x) {{ return (x > 0.0) - (x < 0.0); }}\n{known}"
        f"void fill(double *out)\n{{\n{body}}}\n"
    )
    (tmp_path / "laws.c").write_text(source, encoding="ascii")
    command = [str(COMPILER), "-shared", "-fPIC", "-o", "laws.so", "laws.c", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    out = np.zeros(len(ALL))
    pointer = out.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
    ctypes.CDLL(str(tmp_path / "laws.so")).fill(pointer)
    assert_allclose(out, [values(text) for text in ALL], rtol=1e-14, atol=1e-14)


@no_octave
def test_expressions_keep_their_value_in_octave(tmp_path):
    """Expressions written for MATLAB have the same value in Octave as in Python."""
    known = "".join(f"{n} = {v!r};\n" for n, v in named().items())
    body = "".join(
        f"printf('%.17g\\n', {in_matlab(text, bodies=(), bristles=())});\n" for text in MODELLED
    )
    (tmp_path / "laws.m").write_text(known + body, encoding="ascii")
    command = [str(OCTAVE), "--norc", "--no-gui", "laws.m"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    out = np.array(done.stdout.split(), dtype=np.float64)
    assert_allclose(out, [values(text) for text in ALL], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("text", ["a if b else c", "a < b", "[a]", "f(a)", "a @ b", "'a'"])
def test_an_operation_that_laws_may_not_use_is_refused(text):
    """An operation that laws may not use is refused, for C and for MATLAB."""
    with pytest.raises(ValueError, match="no part of"):
        in_c(text)
    with pytest.raises(ValueError, match="no part of"):
        in_matlab(text, bodies=(), bristles=())


def test_numbers_for_symbols_simplify_an_expression():
    """If symbols of a law are replaced by numbers, its expression becomes shorter."""
    rate = "(v - abs(v) * z) / d"
    assert substitute(rate, {"z": "0"}) == "v / d"
    assert substitute(rate, {"z": "1"}) == "(v - abs(v)) / d"
    assert substitute("-F * z", {"z": "0"}) == "0"
