"""Each law is written once; the code generated from it gives the same force and derivatives."""

import ast
import sys
from dataclasses import replace
from importlib import util
from math import inf
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from docs.codegen.__main__ import MADE, ROOM
from docs.codegen.laws import columns_source, laws_source, terms_source
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.effect import Effect
from pipeline.plant.law import ContactLaw, ForceLaw, FrictionLaw, HysteresisLaw, InputLaw, evaluate
from pipeline.plant.simulator import laws, terms
from pipeline.plant.simulator.tables import TABLES
from pipeline.words.math import to_tex
from tests.helpers.effects import SIZES

FOLLOWED = [e for e in CATALOGUE if isinstance(e.law, ForceLaw | FrictionLaw | ContactLaw)]
STATES = [(0.4, 0.7, 0.02, 1.0), (-0.9, -0.3, -0.05, 1.0), (1.3, -1.1, 0.03, 0.0)]  # x, v, u, on


@pytest.mark.parametrize("name", MADE)
def test_generated_files_are_up_to_date(name):
    """The generated files are what `python -m docs.codegen` writes from the laws."""
    stored, made = (ROOM / name).read_text(encoding="utf-8"), MADE[name](CATALOGUE)
    assert ast.dump(ast.parse(stored)) == ast.dump(ast.parse(made)), "run python -m docs.codegen"


def coordinates_of(effect: Effect) -> np.ndarray:
    """Return fit coordinates of an effect at which its law is neither large nor small."""
    shapes = {"end_stop": (2.0, 0.8, 0.1), "cogging": (0.3, -0.2, 0.7)}
    return np.array(shapes.get(effect.key, (0.3, 0.8, 0.5)[: len(effect.grown.coordinates)]))


def terms_of(kind: int, p: np.ndarray, x: float, v: float, u: float, on: float) -> np.ndarray:
    """Return a law's force and its derivatives with respect to x, v, u and each coordinate."""
    out = np.zeros(terms.TERMS)
    terms.terms(kind, p, 0, x, v, 0.1, u, on, out)
    return out


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("effect", FOLLOWED, ids=lambda effect: effect.key)
def test_derivatives_are_those_of_the_law(effect, state):
    """A law's derivatives, also with respect to each coordinate, agree with finite differences."""
    kind, p = CATALOGUE.index(effect), coordinates_of(effect)
    x, v, u, on = state
    out = terms_of(kind, p, *state)
    step = 1e-6
    sides = [
        (terms_of(kind, p, x + s, v, u, on)[0],
         terms_of(kind, p, x, v + s, u, on)[0],
         terms_of(kind, p, x, v, u + s, on)[0],
         *(terms_of(kind, p + s * unit, *state)[0] for unit in np.eye(p.size)))
        for s in (step, -step)
    ]  # fmt: skip
    by = (np.array(sides[0]) - sides[1]) / (2 * step)
    # Differences over 2e-6 have rounding errors of 1e-10 and smaller errors from curvature.
    assert_allclose(out[1 : 4 + p.size], by, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("key", ["end_stop", "slack_spring"])
def test_contacts_give_the_force_of_the_law(key):
    """A contact's stiffness, damping and place in the simulator give the force of its law."""
    effect = find_effect(key)
    law, kind = effect.law, CATALOGUE.index(effect)
    assert isinstance(law, ContactLaw)
    row = np.zeros((1, len(TABLES[effect.place])))
    row[0, 0] = 0.1  # the spring's stiffness
    values = {"r": 0.5, "s": 0.4} if key == "slack_spring" else {"k": 2.0, "p": 0.4, "c": 0.1}
    named = {p.name: values[p.symbol] for p in effect.parameters}
    for column, value in effect.columns(named).items():
        row[0, column] = value
    if key == "slack_spring":
        k, at, share = laws.bilinear_spring(row, 0)
        p, c, sign = np.array([0.5 * 0.1, 0.4]), 0.0, 1.0
        assert share == 0.5
    else:
        k, c, at = laws.end_stop(row, 0)
        p, sign = np.array([2.0, 0.4, 0.1]), -1.0
    past = sign * (k * (0.6 - at) + c * 0.3)
    assert terms_of(kind, p, 0.6, 0.3, 0.0, 0.0)[0] == pytest.approx(past, rel=1e-12)
    assert terms_of(kind, p, 0.3, 0.3, 0.0, 0.0)[0] == 0.0


@pytest.mark.parametrize("v", [0.7, -0.3])
def test_hysteresis_settles_at_the_rate_of_its_law(v):
    """The hysteresis state settles at the rate of its law, in the simulator and in the fit."""
    effect = find_effect("presliding_friction")
    law = effect.law
    assert isinstance(law, HysteresisLaw)
    kind, p = CATALOGUE.index(effect), np.array([0.3, 0.8])

    def settled(p, v):
        out = np.zeros(terms.TERMS)
        terms.settle(kind, p, 0, v, out)
        return out

    out = settled(p, v)
    for z in (-0.4, 0.9):
        named = {"F": p[0], "δ": p[1], "v": v, "z": z, "abs": abs}
        assert out[2] * (out[1] - z) == pytest.approx(evaluate(law.rate, named), rel=1e-12)
        assert -out[0] * z == pytest.approx(evaluate(law.force, named), rel=1e-12)
    cart = np.zeros((1, len(TABLES["cart"])))
    for column, value in effect.columns({"force": p[0], "distance": p[1]}).items():
        cart[0, column] = value
    assert_allclose(laws.hysteresis(cart, 0, v), out[:3], rtol=1e-12)
    assert_allclose(laws.hysteresis_slopes(cart, 0, v), out[3:5], rtol=1e-12)
    step = 1e-6
    by_v = (settled(p, v + step) - settled(p, v - step)) / (2 * step)
    assert_allclose(out[3:5], by_v[1:3], atol=1e-8)
    for q, unit in enumerate(np.eye(2)):
        by_q = (settled(p + step * unit, v) - settled(p - step * unit, v)) / (2 * step)
        assert_allclose(out[5 + 3 * q : 8 + 3 * q], by_q[:3], atol=1e-8)


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(
    "effect",
    [e for e in FOLLOWED if not isinstance(e.law, ContactLaw)],
    ids=lambda effect: effect.key,
)
def test_simulator_and_follower_have_the_same_law(effect, state):
    """For the same parameters, the simulator and the fit compute the same force."""
    kind, p = CATALOGUE.index(effect), coordinates_of(effect)
    x, v, u, on = state
    within = {"F": 0.2} if isinstance(effect.law, FrictionLaw) and effect.law.beyond else {}
    named = dict(zip(effect.grown.coordinates, p.tolist(), strict=True))
    values = effect.grown_values(within | named)
    shared = {q.name: within[q.symbol] for q in effect.parameters if q not in effect.own}
    row = np.zeros(len(TABLES[effect.place]))
    for column, value in effect.columns(values | shared).items():
        row[column] = value
    rows = row[None]
    if effect.place == "spring":
        damping = laws.spring_matrix(rows, 0)[1] * v
        got = laws.spring_force(rows, 0, x, v) + damping
    elif effect.place == "input":
        got = laws.drive_force(row, x, v, u, on) + laws.motor_force(row, x, v, u, on)
    elif isinstance(effect.law, FrictionLaw):
        got = laws.sliding(rows, 0, u) + laws.stribeck(rows, 0, v, u) - sum(shared.values())
    else:
        got = laws.cart_force(rows, 0, x, v, u)
    assert_allclose(got, terms_of(kind, p, *state)[0], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("effect", FOLLOWED, ids=lambda effect: effect.key)
def test_a_law_vanishes_with_its_coefficients(effect):
    """If the coefficients of a law are zero, its force is zero, whatever its shape."""
    kind, p = CATALOGUE.index(effect), coordinates_of(effect)
    p[list(terms.COEFFICIENTS[kind])] = 0.0
    assert all(terms_of(kind, p, *state)[0] == 0.0 for state in STATES)


def test_dead_zone_and_saturation_shape_the_input():
    """A dead zone removes small inputs and reduces larger ones by its width; saturation clips."""
    drive = np.zeros(len(TABLES["input"]))
    for key in ("dead_zone", "saturation"):
        effect = find_effect(key)
        for column, value in effect.columns(SIZES[key]).items():
            drive[column] = value
    got = [laws.shaped_input(drive, u) for u in (0.004, -0.015, 0.05, -0.05)]
    assert_allclose(got, [0.0, -0.010, 0.03, -0.03], atol=1e-18)


def test_friction_at_rest_is_that_of_the_law():
    """If a law of friction has a separate force at rest, this force acts at zero speed."""
    for effect in CATALOGUE:
        if isinstance(effect.law, FrictionLaw) and effect.law.at_rest:
            row = np.zeros((1, len(TABLES["cart"])))
            values = SIZES[effect.key]
            for column, value in effect.columns(values).items():
                row[0, column] = value
            symbols = {p.symbol: values[p.name] for p in effect.parameters}
            held = laws.sliding(row, 0, 0.0) + laws.stribeck(row, 0, 0.0, 0.0)
            assert held == pytest.approx(symbols[effect.law.at_rest], rel=1e-12)


def load(source: str, name: str, folder: Path):
    """Import Python source as a temporary module."""
    path = folder / f"{name}.py"
    path.write_text(source, encoding="utf-8")
    spec = util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


CUBIC_DRAG = replace(
    find_effect("quadratic_drag"), key="cubic_drag", law=ForceLaw("-q * v**3", step=inf)
)
WEAK_ZONE = replace(
    find_effect("dead_zone"), key="weak_zone", law=InputLaw("u - w * u / (1 + u**2)")
)


@pytest.mark.slow
@pytest.mark.sample
def test_a_new_effect_needs_only_its_own_file(tmp_path, monkeypatch):
    """For a new law, the columns, force, derivatives and terms of the fit are all generated."""
    catalogue = (*CATALOGUE, CUBIC_DRAG, WEAK_ZONE)
    load(columns_source(catalogue), "new_columns", tmp_path)
    source = laws_source(catalogue).replace("pipeline.plant.simulator.columns", "new_columns")
    new = load(source, "new_laws", tmp_path)
    followed = load(terms_source(catalogue), "new_terms", tmp_path)
    columns = sys.modules["new_columns"]
    cart = np.zeros((1, len(columns.Cart)))
    cart[0, columns.Cart.CUBIC_DRAG_COEFFICIENT] = 0.5
    drive = np.zeros(len(columns.Drive))
    drive[columns.Drive.WEAK_ZONE_WIDTH] = 0.4

    assert new.cart_force(cart, 0, 0.3, -2.0, 0.0) == pytest.approx(4.0)
    assert new.cart_slopes(cart, 0, 0.3, -2.0, 0.0) == pytest.approx((0.0, -6.0))
    assert new.shaped_input(drive, 1.0) == pytest.approx(0.8)
    assert new.reach_of(cart, np.zeros((2, len(columns.Spring))), drive) == (inf, new.ON_CARTS)
    out = np.zeros(followed.TERMS)
    followed.terms(followed.Kind.CUBIC_DRAG, np.array([0.5]), 0, 0.3, -2.0, 0.0, 0.0, 0.0, out)
    assert_allclose(out[:5], [4.0, 0.0, -6.0, 0.0, 8.0])
    for name in ("new_columns", "new_laws", "new_terms"):
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.parametrize(
    ("key", "equation"),
    [
        ("coulomb_friction", r"f = -F \operatorname{sign} v, \quad |f| \le F \text{ at rest}"),
        ("quadratic_drag", "f = -q v |v|"),
        ("presliding_friction", r"f = -F z, \quad \dot z = (v - |v| z)/\delta"),
        ("cubic_spring", "f = k d + a d^3"),
        ("cogging", r"f = F \sin(2 \pi x_1/\lambda + \phi)"),
        ("drive_damping", r"f = -c v_1 \text{ while } u \ne 0"),
        ("slack_spring", r"f = k d + r k (d - s) \text{ past } s"),
        ("end_stop", r"f = -k (x - p) \text{ past } p, \text{ never pulling}"),
        ("dead_zone", r"u \to \operatorname{sign} u \cdot \max(|u| - w, 0)"),
        (
            "stiction",
            r"f = -\left(F + (S - F) e^{-(v/w)^2}\right) \operatorname{sign} v, "
            r"\quad |f| \le S \text{ at rest}",
        ),
    ],
)
def test_equations_are_written_as_in_a_book(key, equation):
    """Equations have factors side by side, no needless brackets and no details of contacts."""
    assert to_tex(find_effect(key).formula) == equation
