"""The catalogue is complete and documented, and an effect of zero size has no effect."""

from collections.abc import Callable

import numpy as np
import pytest

from pipeline.errors import ConfigError
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.effect import AugmentedChain, Effect, EffectTerm, chain_scales
from tests.helpers.effects import SIZES, make_term


def test_catalogue_has_the_agreed_names():
    """The catalogue has the effects and parameters whose names files and users rely on."""
    found = {e.key: {p.name for p in e.parameters if p.reported} for e in CATALOGUE}
    assert found == {key: set(sizes) for key, sizes in SIZES.items()}


def faint_term(effect: Effect, *, share: float, chain: Chain) -> EffectTerm:
    """Return an effect with `share` of a clearly visible size, and with the same shape."""
    place = {"cart": 1, "spring": 2, "input": 0}[effect.place]
    scales = chain_scales(chain, place=effect.place, at=place, input=0.05)
    sized = {p.unit for p in effect.parameters if p.neutral is not None}
    values = {}
    for parameter in effect.parameters:
        value, neutral = parameter.typical * parameter.size(scales), parameter.neutral or 0.0
        if not sized:  # a limit that is never reached changes nothing
            value /= share
        elif parameter.neutral is not None or (parameter.reported and parameter.unit in sized):
            value = neutral + share * (value - neutral)
        elif not parameter.reported:  # a contact is as stiff as allowed, or scaled like the rest
            stiff = parameter.upper < np.inf
            value = parameter.upper * parameter.size(scales) if stiff else share * value
        values[parameter.name] = value
    return make_term(effect, place=place, values=values, chain=chain)


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.key)
def test_an_effect_of_zero_size_is_the_linear_bench(effect):
    """As the size of an effect goes to zero, the motion becomes that of the linear chain."""
    chain = PRESETS["throne-2dof"]
    t = np.linspace(0.0, 3.0, 601)
    u = np.where(t < 1.5, 0.05, -0.025)
    linear = simulate_augmented(AugmentedChain(chain=chain), t, u, x0=np.array([0.3, 0.0]))

    def departs(share: float) -> float:
        model = AugmentedChain(chain=chain, terms=(faint_term(effect, share=share, chain=chain),))
        y = simulate_augmented(model, t, u, x0=np.array([0.3, 0.0]))
        return float(np.abs(y - linear).max() / np.abs(linear).max())

    plain = departs(1.0)
    assert plain > 3e-3
    # The difference is proportional to the size, or to its root; a contact stays slightly soft.
    assert departs(1e-4) < 0.02 * plain


def test_the_properties_of_an_effect_follow_from_its_law():
    """Whether an effect is dry, a contact, a hidden mass or driven follows from its law."""

    def those(is_so: Callable[[Effect], bool]) -> set[str]:
        return {effect.key for effect in CATALOGUE if is_so(effect)}

    dry = {"coulomb_friction", "stiction", "presliding_friction", "load_friction"}
    assert those(lambda e: e.dry) == dry
    assert those(lambda e: e.many_rests) == dry | {"cogging"}
    assert those(lambda e: e.hides_mass) == {"extra_mode"}
    assert those(lambda e: e.contact) == {"end_stop", "backlash"}
    idle = {"drive_damping", "dead_zone", "saturation", "input_delay", "actuator_lag"}
    assert those(lambda e: e.needs_input) == idle


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("friction", "'coulomb_friction', 'presliding_friction' or 'load_friction'"),
        ("Coulomb friction", "'coulomb_friction'"),
        ("delay", "'input_delay'"),
        ("dahl", "'presliding_friction'"),
        ("colomb_frction", "'coulomb_friction'"),
    ],
)
def test_a_word_of_a_name_finds_the_effects_that_have_it(typed, meant):
    """A word of an effect's name finds the effects with it; a misspelt name finds the nearest."""
    with pytest.raises(ConfigError, match=rf"did you mean {meant}\?"):
        find_effect(typed)
