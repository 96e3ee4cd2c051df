"""A new effect needs its own file and a line in the catalogue; all other code is generated."""

import ast
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import pipeline
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.effect import Effect, EffectParameter, ForceLaw, FrictionLaw, HysteresisLaw
from pipeline.plant.simulator.codegen import GENERATED

ROOM = Path(pipeline.__file__).parent
CUBIC_DRAG = Effect(
    key="cubic_drag",
    title="Cubic drag",
    sentence="The resistance grows with the third power of the speed.",
    place="cart",
    law=ForceLaw("-q * v**3"),
    parameters=(EffectParameter("coefficient", "q", "input s^3/position^3", scale="damping"),),
    fingerprint="Large swings die faster than small ones.",
    deciding_run="Free decay from two release heights.",
    shown_by="large motions",
    reference="none: it stands here for any new law",
    axis="velocity",
)


def function_of(name: str, source: str, **known: object) -> Any:
    """Return one function of a generated file, without compiling it."""
    tree = ast.parse(source)
    (found,) = (n for n in tree.body if isinstance(n, ast.FunctionDef) and n.name == name)
    found.decorator_list = []
    space: dict[str, Any] = dict(known)
    exec(compile(ast.Module(body=[found], type_ignores=[]), name, "exec"), space)
    return space[name]


def kinds_of(source: str, name: str) -> dict[str, int]:
    """Return the members of an enumeration in a generated file."""
    (found,) = (n for n in ast.parse(source).body if isinstance(n, ast.ClassDef) and n.name == name)
    return {
        one.targets[0].id: ast.literal_eval(one.value)
        for one in found.body
        if isinstance(one, ast.Assign) and isinstance(one.targets[0], ast.Name)
    }


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    """Return the generated source for a catalogue with one more effect."""
    return {name: source((*CATALOGUE, CUBIC_DRAG)) for name, source in GENERATED.items()}


def test_columns_force_and_derivatives_are_generated(made):
    """The simulator gets a column for the new parameter, and the new law with derivatives."""
    columns = kinds_of(made["columns.py"], "Cart")
    Cart = type("Cart", (), columns)
    row = np.zeros((1, len(columns)))
    row[0, columns["CUBIC_DRAG_COEFFICIENT"]] = 2.0

    force = function_of("cart_force", made["generated_forces.py"], Cart=Cart)
    slopes = function_of("cart_slopes", made["generated_forces.py"], Cart=Cart)

    assert_allclose(force(row, 0, 0.3, 0.5, 0.0), -2.0 * 0.5**3)
    assert_allclose(slopes(row, 0, 0.3, 0.5, 0.0), (0.0, -6.0 * 0.5**2))


def test_the_fit_gets_the_new_law(made):
    """The fit gets the new law and its derivatives, also with respect to its coefficient."""
    source = made["terms.py"]
    kinds = kinds_of(source, "EffectKind")
    terms = function_of("terms", source, EffectKind=type("EffectKind", (), kinds))
    out = np.zeros(11)

    terms(kinds["CUBIC_DRAG"], np.array([2.0]), 0, 0.3, 0.5, 0.0, 0.1, 1.0, out)

    assert_allclose(out[:5], (-2.0 * 0.5**3, 0.0, -6.0 * 0.5**2, 0.0, -(0.5**3)))


PLAIN = [
    effect
    for effect in CATALOGUE
    if isinstance(effect.law, ForceLaw | FrictionLaw | HysteresisLaw)
    and effect.place != "input"
    and not effect.only_rest
]


@pytest.mark.parametrize("effect", PLAIN, ids=lambda effect: effect.key)
def test_only_its_own_file_names_an_effect(effect):
    """Only an effect's own file names it, except for effects whose law has its own state.

    Laws that need trial shapes are also named in `gap.pem.fit`.
    """
    files = {
        path.relative_to(ROOM).as_posix()
        for room in ("plant", "gap")
        for path in (ROOM / room).rglob("*.py")
        if re.search(rf"\b({effect.key}|{effect.key.upper()}\w*)\b", path.read_text("utf-8"))
    }
    allowed = {f"plant/simulator/{name}" for name in GENERATED} | {"gap/pem/fit.py"}
    assert files - {"plant/catalogue.py"} <= allowed
