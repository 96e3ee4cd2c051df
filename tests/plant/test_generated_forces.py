"""Each law is written once; the code generated from it gives the same force and derivatives."""

import ast

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.effect import ContactLaw, Effect, ForceLaw, FrictionLaw, HysteresisLaw, evaluate
from pipeline.plant.simulator import generated_forces, terms
from pipeline.plant.simulator.codegen import FOLDER, GENERATED
from pipeline.plant.simulator.tables import TABLES
from pipeline.words.math import to_tex

FOLLOWED = [e for e in CATALOGUE if isinstance(e.law, ForceLaw | FrictionLaw | ContactLaw)]
STATES = [(0.4, 0.7, 0.02, 1.0), (-0.9, -0.3, -0.05, 1.0), (1.3, -1.1, 0.03, 0.0)]  # x, v, u, on


@pytest.mark.parametrize("name", GENERATED)
def test_generated_files_are_up_to_date(name):
    """The generated files are what `pipeline.plant.simulator.codegen` writes from the laws."""
    stored, made = (FOLDER / name).read_text(encoding="utf-8"), GENERATED[name](CATALOGUE)
    assert ast.dump(ast.parse(stored)) == ast.dump(ast.parse(made))


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
    assert_allclose(generated_forces.hysteresis(cart, 0, v), out[:3], rtol=1e-12)
    assert_allclose(generated_forces.hysteresis_slopes(cart, 0, v), out[3:5], rtol=1e-12)
    step = 1e-6
    by_v = (settled(p, v + step) - settled(p, v - step)) / (2 * step)
    assert_allclose(out[3:5], by_v[1:3], atol=1e-8)
    for q, unit in enumerate(np.eye(2)):
        by_q = (settled(p + step * unit, v) - settled(p - step * unit, v)) / (2 * step)
        assert_allclose(out[5 + 3 * q : 8 + 3 * q], by_q[:3], atol=1e-8)


@pytest.mark.parametrize("effect", FOLLOWED, ids=lambda effect: effect.key)
def test_a_law_vanishes_with_its_coefficients(effect):
    """If the coefficients of a law are zero, its force is zero, whatever its shape."""
    kind, p = CATALOGUE.index(effect), coordinates_of(effect)
    p[list(terms.COEFFICIENTS[kind])] = 0.0
    assert all(terms_of(kind, p, *state)[0] == 0.0 for state in STATES)


@pytest.mark.parametrize(
    ("key", "equation"),
    [
        ("coulomb_friction", r"f = -F \operatorname{sign} v, \quad |f| \le F \text{ at rest}"),
        ("quadratic_drag", "f = -q v |v|"),
        ("presliding_friction", r"f = -F z, \quad \dot z = (v - |v| z)/\delta"),
        ("cubic_spring", "f = k d + a d^3"),
        ("asymmetric_spring", "f = k d + b d^2"),
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
