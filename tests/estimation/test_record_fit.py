"""The force on a cart comes from the input and through the springs on its two sides."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.estimation.record_fit import force_on
from pipeline.plant.chain import Chain
from tests.helpers.time_records import step_record

CHAIN = Chain(m=np.full(3, 3e-4), c=np.full(3, 1e-3), k=np.array([0.1, 0.2, 0.3, 0.4]))
RUN = step_record(CHAIN, rng=np.random.default_rng(1))


@pytest.mark.parametrize(
    ("cart", "input", "springs"),
    [(1, 1.0, [0.0, 0.2, 0.0]), (2, 0.0, [0.2, 0.0, 0.3]), (3, 0.0, [0.0, 0.3, 0.0])],
)
def test_each_spring_pulls_the_carts_at_its_ends(cart, input, springs):
    """Each neighbour acts through the spring between the two carts, and the input on cart 1."""
    found = force_on(RUN, CHAIN, cart=cart)
    assert found is not None
    assert RUN.u is not None
    expected = input * RUN.u + np.array(springs) @ RUN.y
    # Sums of three products in another order differ by rounding.
    assert_allclose(found, expected, atol=1e-12)
