"""For every effect, the equation of motion for python-control agrees with the simulator."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain, Effect, chain_scales
from pipeline.plant.motion import EquationsOfMotion
from tests.helpers.effects import model_with

CHAIN = PRESETS["throne-2dof"]
T = np.arange(0.0, 1.5, 0.002)
ON, OFF, LEVEL = 0.1, 0.9, 0.05  # switch-on and switch-off in s, level in V


def usual(effect: Effect) -> AugmentedChain:
    """Return the carts with one effect of a clearly visible size."""
    place = (effect.places((True, True, True)) or (0,))[-1]
    scales = chain_scales(CHAIN, place=effect.place, at=place, input=LEVEL)
    values = {p.name: p.size(scales) * p.typical for p in effect.parameters}
    return model_with(effect.key, CHAIN, place=place, **values)


def respond(model: AugmentedChain, x0, *, driven: bool):
    """Return readings (carts, samples), integrated from python-control's system."""
    motion = EquationsOfMotion(model)
    system = motion.to_control()
    state, readings = motion.start(x0), []
    edges = [T[0], ON, OFF, T[-1]] if driven else [T[0], T[-1]]
    for first, last in pairwise(edges):
        u = np.array([LEVEL if driven and first == ON else 0.0])
        found = solve_ivp(
            lambda t, x, u=u: system.dynamics(t, x, u),
            (first, last),
            state,
            method="LSODA",
            dense_output=True,
            rtol=1e-7,
            atol=1e-9,
        )
        state = found.y[:, -1]
        here = T[(T >= first) & ((T < last) | (last == T[-1]))]
        readings += [system.output(t, found.sol(t), u) for t in here]
    return np.array(readings).T


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
@pytest.mark.parametrize("driven", [True, False], ids=["step", "release"])
def test_the_system_moves_as_the_simulator_does(effect, driven):
    """python-control's system and the simulator agree to half a percent, in steps and releases.

    In python-control's system a stuck cart creeps, at up to about 0.01 cm/s.
    """
    model = usual(effect)
    x0 = np.zeros(2) if driven else np.array([1.5, 0.5])
    u = np.where((T >= ON) & (T < OFF), LEVEL, 0.0) if driven else np.zeros(T.size)

    expected = simulate_augmented(model, T, u, x0=x0)

    off = respond(model, x0, driven=driven) - expected
    assert np.sqrt(np.mean(off**2) / np.mean(expected**2)) < 5e-3
