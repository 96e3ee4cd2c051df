"""The simulator's derivatives agree with differences of its readings."""

import numpy as np
import pytest

from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.simulator.kernel import StartState, describe_run
from pipeline.plant.simulator.kernel import simulate as simulate_run
from pipeline.plant.simulator.sensitivity import (
    BY_DAMPING,
    BY_FRICTION,
    BY_MASS,
    BY_POSITION,
    BY_STIFFNESS,
    BY_VELOCITY,
)
from pipeline.plant.simulator.tables import Cart, Spring, Tables
from tests.helpers.effects import SIZES, make_term

# The effects are small, so that a difference neither adds nor removes a contact or jump.
CASES = {
    **SIZES,
    "nothing": {},
    "slack_spring": {"stiffness_change": 0.5, "stretch": 0.2},
    "saturation": {"limit": 0.025},
    "input_delay": {"delay": 0.011},
    "sensor_gain": {"gain": 1.1},
    "end_stop": {"position": 0.45, "stiffness": 1.0},
    "extra_mode": {"mass": 3e-5, "stiffness": 0.006, "damping": 2e-5},
}


# Carts that start at rest test effects that act only while the motor pulls.
@pytest.mark.parametrize(
    ("effect", "speed"), [*((effect, 1.0) for effect in CASES), ("load_friction", 0.0)]
)
@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof"])
def test_derivatives_are_those_of_the_readings(preset, effect, speed):
    """Derivatives by mass, damping, stiffness, friction and start agree with differences."""
    chain = PRESETS[preset]
    n = chain.n
    terms = ()
    if CASES[effect]:
        law = find_effect(effect)
        places = law.places(tuple(bool(k) for k in chain.k))
        if not places:
            pytest.skip("no such effect on one cart")
        terms = (make_term(law, place=places[-1], values=CASES[effect], chain=chain),)
    cart, spring, drive = AugmentedChain(chain=chain, terms=terms).tables()
    t = np.arange(700) / 250.0
    u = np.where((t > 0.05) & (t < 1.4), 0.03, 0.0)
    x0, v0, scatter = np.full((1, n), 0.1 * speed), np.full((1, n), speed), np.ones(n)
    lanes = [(BY_MASS, i) for i in range(n)] + [(BY_DAMPING, i) for i in range(n)]
    lanes += [(BY_STIFFNESS, int(j)) for j in np.flatnonzero(chain.k)]
    lanes += [(kind, i) for kind in (BY_FRICTION, BY_POSITION, BY_VELOCITY) for i in range(n)]

    def simulate(by=-1, at=0, change=0.0):
        """Return readings and derivatives after a change of one number."""
        tables = [cart.copy(), spring.copy(), x0.copy(), v0.copy(), scatter.copy()]
        if by in (BY_MASS, BY_DAMPING):
            tables[0][at, Cart.MASS if by == BY_MASS else Cart.DAMPING] += change
        elif by == BY_STIFFNESS:
            # The change of stiffness after a stretch is stored as a share of the stiffness.
            tables[1][at, Spring.STIFFNESS] += change
        elif by in (BY_POSITION, BY_VELOCITY):
            tables[2 if by == BY_POSITION else 3][0, at] += change
        elif by == BY_FRICTION:
            tables[4][at] += change
        start = StartState(tables[2], tables[3], tables[4])
        run = describe_run(t, u, free=np.ones(n, dtype=bool))
        acting = Tables(tables[0], tables[1], drive)
        y, derivatives = simulate_run([(acting, start)], run, of=np.array(lanes).T)
        return y[0], derivatives

    _, derivatives = simulate()
    for (by, at), derivative in zip(lanes, derivatives, strict=True):
        size = {
            BY_MASS: chain.m[min(at, n - 1)],
            BY_DAMPING: chain.c[min(at, n - 1)],
            BY_STIFFNESS: chain.k[at],
        }.get(by, 1.0)
        # Small enough that no event appears or disappears, but well above the rounding errors.
        step = 1e-5 * size
        difference = (simulate(by, at, step)[0] - simulate(by, at, -step)[0]) / (2.0 * step)
        scale = max(float(np.linalg.norm(difference)) * size, 1e-6)
        error = float(np.linalg.norm(derivative - difference)) * size / scale
        # Impulses in place of forces err by (omega h)² / 12, at most 4e-3. The change of friction
        # within a step is a tenth of its part in the derivative.
        assert error < 0.03, (by, at, error)
