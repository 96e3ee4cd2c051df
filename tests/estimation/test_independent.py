"""The fast pseudo-inverse is numpy's."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.estimation.sine import inverse_of

T = np.linspace(0.0, 1.0, 300)
WAVES = np.array([np.sin(40 * T), np.cos(40 * T), np.ones_like(T), T]).T


@pytest.mark.parametrize("part", [slice(None), slice(100, 200), slice(-12, None)])
def test_the_inverse_of_independent_columns_is_exact(part):
    """Long and short parts have numpy's inverse, to rounding times the condition number."""
    columns = WAVES[part]
    size = np.abs(np.linalg.pinv(columns)).max()

    # The condition number is at most 2000, so rounding may reach 2000 · 1e-16 · 100 products.
    assert_allclose(inverse_of(columns), np.linalg.pinv(columns), rtol=0, atol=2e-11 * size)


@pytest.mark.parametrize(
    "dependent", [2.0 * WAVES[:, 0], np.zeros_like(T), WAVES[:, 2] + 1e-9 * WAVES[:, 3]]
)
def test_dependent_columns_get_the_least_solution(dependent):
    """If a column repeats others, the inverse is numpy's, which shares the contribution."""
    columns = np.column_stack([WAVES, dependent])

    assert_allclose(inverse_of(columns), np.linalg.pinv(columns), rtol=0, atol=0)
