"""Laws that are not in the catalogue are found from the unexplained force."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.arrays import Array
from pipeline.gap.explain import explain_gap
from pipeline.gap.fit import fit_baseline, fit_nuisance
from pipeline.gap.residual import (
    LIBRARY,
    map_residual,
    residual_forces,
    windowed_residual_forces,
)
from pipeline.gap.runs import prepare, split_holdout
from pipeline.gap.types import Residual
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import Chain
from pipeline.results import ExperimentKind, Record
from pipeline.setup import Setup
from tests.helpers.gaps import make_gap
from tests.helpers.time_records import COUNT, record_of

# Arguments: position, velocity and input of each run at one time; result: the force in each run.
Law = Callable[[Array, Array, Array], Array]

RATE, SUBSTEPS, DURATION = 250.0, 4, 8.0
CARTS = {
    1: Chain(m=np.array([2e-4]), c=np.array([4e-4]), k=np.array([0.035, 0.0])),
    2: Chain(m=np.array([2e-4, 3e-4]), c=np.array([4e-4, 3e-4]), k=np.array([0.035, 0.02, 0.03])),
}


PLAN: tuple[tuple[ExperimentKind, float], ...] = (
    ("sweep", 0.05), ("sweep", 0.03), ("step", 0.08), ("step", 0.05), ("decay", 2.0),
    ("decay", 1.2),
)  # fmt: skip


def recordings(law: Law, *, carts: int = 1, cart: int = 1) -> list[Record]:
    """Return the recordings of a lab with sweeps, steps and decays.

    One cart has an additional force. All runs are simulated at once by Heun's method with steps of
    1 ms. Readings are whole encoder steps, with noise of 0.3 steps.
    """
    chain = CARTS[carts]
    t = np.arange(int(DURATION * RATE)) / RATE
    shapes = {
        "sweep": np.sin(2 * np.pi * (0.8 * t + 0.2 * t**2)),
        "step": np.where((t > 0.3) & (t < 4.0), 1.0, 0.0),
        "decay": np.zeros(t.size),
    }
    u = np.array([size * shapes[kind] for kind, size in PLAN])
    x, v = np.zeros((carts, len(PLAN))), np.zeros((carts, len(PLAN)))
    x[cart - 1] = [size if kind == "decay" else 0.0 for kind, size in PLAN]

    def acceleration(x, v, push):
        force = -chain.stiffness @ x - chain.c[:, None] * v
        force[0] += push
        force[cart - 1] += law(x[cart - 1], v[cart - 1], push)
        return force / chain.m[:, None]

    y, h = np.zeros((len(PLAN), carts, t.size)), 1.0 / RATE / SUBSTEPS
    for sample, push in enumerate(u.T):
        y[..., sample] = x.T
        for _ in range(SUBSTEPS):
            a = acceleration(x, v, push)
            b = acceleration(x + h * v, v + h * a, push)
            x, v = x + h * v + 0.5 * h * h * a, v + 0.5 * h * (a + b)
    records = []
    for seed, (kind, _) in enumerate(PLAN):
        noisy = y[seed] + 0.3 * COUNT * np.random.default_rng(seed).standard_normal(y[seed].shape)
        driven = None if kind == "decay" else u[seed]
        records.append(record_of(t, driven, noisy, kind=kind, id=f"{kind}-{seed}"))
    return records


def left_by_the_chain(records: list[Record], *, springs: tuple[bool, ...]) -> tuple[Residual, ...]:
    """Return the force that the best linear chain leaves unexplained."""
    runs = prepare(records, springs=springs, interventions=(), notes=[])
    training, held_out = split_holdout(runs, notes=[])
    fit, training = fit_baseline(training, springs=springs, start=None)
    nuisance = [*fit.nuisance, *fit_nuisance(fit, held_out).nuisance]
    forces = windowed_residual_forces(fit, [*training, *held_out], nuisance)
    return map_residual(forces, Setup(springs=springs))


@pytest.mark.parametrize(
    ("law", "terms"),
    [
        (lambda x, v, u: -6e-5 * v * abs(v), {"v|v|": -6e-5}),
        (lambda x, v, u: -8e-4 * np.sign(v) * abs(v) ** 0.5, {"sqrt|v| sign v": -8e-4}),
        (lambda x, v, u: -3e-4 * x * x * v, {"x^2 v": -3e-4}),
        (lambda x, v, u: -0.15 * u * x, {"u x": -0.15}),
        (lambda x, v, u: -2e-3 * x**3 - 5e-5 * v * abs(v), {"x^3": -2e-3, "v|v|": -5e-5}),
    ],
    ids=["drag", "root friction", "van der Pol", "force by place", "two laws"],
)
def test_a_law_is_found_from_the_unexplained_force(law, terms):
    """From the unexplained force, exactly the terms of a law are found, within 6 %.

    The least certain term, the square root, has a standard error of 2 %.
    """
    (residual,) = left_by_the_chain(recordings(law), springs=(True, False))

    assert residual.formula is not None
    found = {term.term: term.coefficient for term in residual.formula.terms}
    assert found == pytest.approx(terms, rel=0.06)
    assert residual.formula.explains > 0.9
    assert [shown.quantity for shown in residual.against] == ["position", "velocity", "input"]


def test_noise_has_no_formula():
    """If the model is right, the residual gets no formula."""
    (residual,) = left_by_the_chain(recordings(lambda x, v, u: 0.0 * x), springs=(True, False))

    assert residual.formula is None
    assert all(shown.formula is None for shown in residual.against)


@pytest.mark.slow
@pytest.mark.sample
def test_an_effect_that_the_catalogue_lacks_is_described():
    """If the catalogue lacks drag, drag is not named, but its formula is found."""
    catalogue = [effect for effect in CATALOGUE if effect.key != "quadratic_drag"]

    gap = explain_gap(
        recordings(lambda x, v, u: -6e-5 * v * abs(v)),
        Setup(springs=(True, False)),
        catalogue=catalogue,
    )

    assert gap.verdict in ("unexplained", "partial")
    (residual,) = gap.residual
    assert residual.formula is not None
    assert residual.formula.terms[0].term == "v|v|"
    assert residual.formula.terms[0].unit == "V s^2/cm^2"
    assert {force.experiment for force in gap.left_forces} == {*gap.training, *gap.held_out}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("1", "V"),
        ("x^2", "V/cm^2"),
        ("v|v|", "V s^2/cm^2"),
        ("x v", "V s/cm^2"),
        ("|u|", "1"),
        ("u x", "1/cm"),
        ("u v", "s/cm"),
    ],
)
def test_the_unit_of_a_coefficient_makes_a_force(name, expected):
    """Coefficient times term is a force, so the unit of a term with the input has no volt."""
    (term,) = (one for one in LIBRARY if one.name == name)
    assert term.unit(position="cm", drive="V") == expected


def test_the_zero_of_an_encoder_is_no_force():
    """`residual_forces` are the same if all readings of a run are shifted with their zero."""
    gap, free = make_gap(), {"step-a": (1, 2), "step-b": (1, 2)}
    shifted = tuple(
        replace(t, measured=t.measured + 0.3, final=t.final + 0.3, zero=0.3) for t in gap.traces
    )
    plain, moved = (residual_forces(one, free=free) for one in (gap, replace(gap, traces=shifted)))
    for before, after in zip(plain, moved, strict=True):
        for name in ("measured", "model", "position", "neighbours"):
            assert_allclose(getattr(after, name), getattr(before, name), atol=1e-12)
