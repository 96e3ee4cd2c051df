"""Parameter names are read correctly, and real chains obey the inequalities between parameters."""

import pytest

from pipeline.names import gain_name, own_omega, own_zeta, parameter_names, read_name
from pipeline.plant.chain import PRESETS
from pipeline.plant.identities import interlacing_brackets, parameter_orders
from pipeline.setup import PAPER_UNITS


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_every_name_is_read_back(n):
    """Each parameter name is taken apart into symbol and cart, and put together again."""
    for name in parameter_names(n):
        read = read_name(name)
        assert read.is_gain + read.is_frequency + read.is_ratio == 1
        assert name == (f"{read.symbol}_{read.suffix}" if read.suffix else read.symbol)
    for cart in range(1, n + 1):
        for own in (gain_name, own_omega, own_zeta):
            assert own(cart, n=n) in parameter_names(n)
            assert n == 1 or read_name(own(cart, n=n)).cart == cart


def test_a_rigid_body_has_a_damping_but_no_ratio():
    """A rigid body has a mass with its unit and a damping that is not a damping ratio."""
    mass, damping = map(read_name, parameter_names(1, rigid=True))
    assert mass.unit(PAPER_UNITS) == "V s^2/cm"
    assert damping.is_damping
    assert not damping.is_ratio


def test_a_table_without_its_last_resonance_sets_no_upper_bound():
    """Without the last resonance, single carts' frequencies have only a lower bound."""
    names = ["K_1", "K_2", "omega_1", "omega_2", "omega_a"]
    found = [(lesser, greater) for lesser, greater, _ in parameter_orders(names)]
    assert found == [("K_2", "K_1"), ("omega_a", "omega_1"), ("omega_a", "omega_2")]


@pytest.mark.parametrize("preset", ["throne-2dof", "throne-3dof"])
def test_real_chains_obey_the_inequalities(preset):
    """The carts of the paper satisfy every inequality between named parameters."""
    values = PRESETS[preset].parameters()
    for low, middle, high, _ in interlacing_brackets(PRESETS[preset].n):
        assert values[low] < values[middle] < values[high]
    for lesser, greater, _ in parameter_orders(list(values)):
        assert values[lesser] <= values[greater]
