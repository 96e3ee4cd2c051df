"""The catalogue: complete, documented, and without effect where an effect's size is nothing."""

import numpy as np
import pytest

from pipeline.errors import ConfigError
from pipeline.plant.chain import PRESETS
from pipeline.plant.effects import CATALOGUE, AugmentedChain, find_effect, make_term
from pipeline.plant.tables import linear_tables

KEYS = {
    "coulomb_friction": ("cart", {"force"}),
    "stiction": ("cart", {"force", "static_force", "velocity"}),
    "presliding_friction": ("cart", {"force", "distance"}),
    "load_friction": ("cart", {"coefficient"}),
    "drive_damping": ("input", {"coefficient"}),
    "quadratic_drag": ("cart", {"coefficient"}),
    "cubic_spring": ("spring", {"coefficient"}),
    "slack_spring": ("spring", {"stiffness_change", "stretch"}),
    "coupling_damper": ("spring", {"coefficient"}),
    "force_offset": ("cart", {"force"}),
    "dead_zone": ("input", {"width"}),
    "saturation": ("input", {"limit"}),
    "input_delay": ("input", {"delay"}),
    "actuator_lag": ("input", {"time_constant"}),
    "backlash": ("input", {"gap"}),
    "end_stop": ("cart", {"position", "stiffness"}),
    "sensor_gain": ("cart", {"gain"}),
    "extra_mode": ("cart", {"mass", "stiffness", "damping"}),
}


def test_catalogue_has_the_agreed_names():
    """Keys, places and reported parameters are those that files and users rely on."""
    found = {e.key: (e.place, {p.name for p in e.parameters if p.reported}) for e in CATALOGUE}
    assert found == KEYS


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.key)
def test_entry_says_all_a_student_needs(effect):
    """Every entry has its sentence, equation, fingerprint, deciding run and reference."""
    for text in (effect.sentence, effect.equation, effect.fingerprint, effect.deciding_run):
        assert len(text) >= len("f = F")
    assert effect.reference
    assert effect.trial_points
    for parameter in effect.parameters:
        assert parameter.unit.count("position") + parameter.unit.count("input") <= 2


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda e: e.key)
def test_neutral_value_is_the_linear_chain(effect):
    """With its first neutral parameter at neutral, an effect leaves the tables' laws unchanged."""
    chain = PRESETS["throne-2dof"]
    neutral = [p for p in effect.parameters if p.neutral is not None]
    if not neutral:
        pytest.skip("a limit nobody reaches is its neutral value, and no number")
    place = {"cart": 1, "spring": 2, "input": 0}[effect.place]
    values = {p.name: 0.1 for p in effect.parameters}
    if "static_force" in values:
        values["static_force"] = 0.0
    values[neutral[0].name] = neutral[0].neutral
    term = make_term(effect, place=place, values=values, chain=chain)

    got, base = AugmentedChain(chain=chain, terms=(term,)).tables(), linear_tables(chain)

    differing = [np.argwhere(a != b).size for a, b in zip(got, base, strict=True)]
    # What else differs only shapes a force whose size is nothing (a distance, a velocity …).
    sizes = {"stiction": 1, "presliding_friction": 1, "slack_spring": 1, "extra_mode": 2}
    sizes |= {"backlash": 3, "end_stop": 2}
    rows = sum(d // max(1, a.ndim) for d, a in zip(differing, got, strict=True))
    assert rows <= sizes.get(effect.key, 0)


def test_single_cart_has_one_spring_place():
    """The two wall springs of one cart act through their sum, so only one is a place."""
    assert find_effect("cubic_spring").places((True, True)) == (1,)
    assert find_effect("cubic_spring").places((False, True)) == (2,)
    assert find_effect("cubic_spring").places((True, True, False)) == (1, 2)
    assert find_effect("coupling_damper").places((True, True, True)) == (2,)


@pytest.mark.parametrize(
    ("key", "place", "values", "message"),
    [
        ("coulomb_friction", 5, {"force": 1.0}, "no cart 5"),
        ("coulomb_friction", 1, {"size": 1.0}, "has force, found size"),
        ("presliding_friction", 1, {"force": 1.0}, "needs distance"),
    ],
)
def test_wrong_terms_are_refused(key, place, values, message):
    """A place or parameter the effect does not have is one clear error."""
    with pytest.raises(ConfigError, match=message):
        make_term(find_effect(key), place=place, values=values, chain=PRESETS["throne-2dof"])


def test_unknown_effect_is_refused():
    """A name that is not in the catalogue is one clear error that lists the names."""
    with pytest.raises(ConfigError, match="no effect 'glue'; known: coulomb_friction"):
        find_effect("glue")
