"""Other tools are compared fairly: with the right model, failures counted, free runs judged."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.black_boxes import Model, Part, error
from benchmarks.bode import modes_named
from benchmarks.bode_tools import (
    Dwells,
    curve_fitted,
    factors,
    rational,
    start_of,
)
from benchmarks.gap_tools import Bench, is_named
from benchmarks.identification import measure
from pipeline.plant.chain import PRESETS

OMEGA = 2 * np.pi * np.geomspace(0.3, 7.0, 30)


def _vector(n: int, named: dict[str, float]) -> np.ndarray:
    gains = [named["K"]] if n == 1 else [named[f"K_{i + 1}"] for i in range(n)]
    named = {**named, "zeta_n": named.get("zeta", 0.0)}
    pairs = [
        named[f"{kind}_{key}"] for keys in factors(n) for key in keys for kind in ("omega", "zeta")
    ]
    return np.array([*gains, *pairs])


@pytest.mark.parametrize("chain", PRESETS.values(), ids=list(PRESETS))
def test_the_papers_transfer_functions_are_those_of_the_chain(chain):
    """The paper's transfer functions, which other tools fit, have the chain's response."""
    p = _vector(chain.n, chain.parameters())

    assert p.shape == start_of(chain.n).shape
    assert_allclose(rational(p, OMEGA, n=chain.n), chain.frequency_response(OMEGA), rtol=1e-9)


def test_curve_fit_finds_the_truth_in_dwells_without_noise():
    """From the paper's start, `curve_fit` finds the truth in dwells without noise."""
    chain = PRESETS["throne-2dof"]
    responses = measure(chain, rng=np.random.default_rng(0), phases=True, noise=1e-9)

    found = curve_fitted(Dwells.of(responses))

    truth = modes_named(chain, list(chain.parameters().values()))
    assert_allclose(found.omega, truth.omega, rtol=1e-5)
    assert found.gains is not None
    assert truth.gains is not None
    assert_allclose(found.gains, truth.gains, rtol=1e-5)


def test_a_free_run_is_judged_after_its_start_and_divergence_is_infinite():
    """A free run is judged after its first samples, and one that diverges has an infinite error."""
    y = np.ones(100)
    part = Part(dt=0.01, u=np.zeros(100), y=y, first=10)
    near = np.where(np.arange(100) < 10, 50.0, 1.1)

    assert_allclose(error(Model(run=lambda _: near, every=1, words=""), [part]), 0.1)
    assert error(Model(run=lambda _: 1e9 * y, every=1, words=""), [part]) == np.inf


@pytest.mark.parametrize(
    ("verdict", "hidden", "named"),
    [
        ("none", (), True),
        ("unexplained", (), False),
        ("named", ("cubic_spring",), True),
        ("partial", ("cubic_spring",), False),
        ("ambiguous", ("cubic_spring",), False),
        ("named", ("backlash",), False),
    ],
)
def test_effects_count_only_under_the_verdict_named(verdict, hidden, named):
    """The right effects count as named only under the verdict `named`."""
    found = ("cubic_spring",) if verdict not in ("none", "unexplained") else ()
    effects = tuple(SimpleNamespace(effect=SimpleNamespace(key=key)) for key in found)
    gap: Any = SimpleNamespace(verdict=verdict, effects=effects)

    assert is_named(Bench(hidden=hidden, noise=0.1, gap=gap, answers={})) is named
