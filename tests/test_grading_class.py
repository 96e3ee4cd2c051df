"""A class on benches all over what a lab may have: nobody honest is flagged, mistakes are named."""

from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest

from tests.grading_class import Team, make_team
from tests.grading_slips import OF_SEVERAL_CARTS, SLIPS


def flags(team: Team) -> list[str]:
    return [f"{flag.code}: {flag.message}" for flag in team.grade().flags]


@pytest.mark.parametrize("seed", [5, 30, 90])
def test_little_damping_accuses_nobody(seed):
    """Where dwells put a damping at zero, or dry friction has a share in it, nobody is wrong."""
    team = make_team(seed)
    assert team.bench.chain.zeta_carts.max() < 0.02
    assert flags(team) == []


def test_a_damping_that_the_fit_puts_at_zero_is_told_by_the_decay():
    """A fit that ends at its bound has measured nothing; a damping ten times too large is."""
    team = make_team(30)
    assert team.analysis.chain is not None
    wrong = team.reporting(final={"zeta": Decimal("0.031")}).grade()
    assert [flag.code for flag in wrong.flags] == ["final_off"]
    assert wrong.flags[0].evidence["recomputed"] == pytest.approx(0.00316, rel=0.1)


@pytest.mark.parametrize("digits", [2, 3])
def test_a_model_made_of_a_vague_table_is_no_wrong_one(digits):
    """Couplings are differences of large numbers: rounding alone moves them by a third."""
    for seed in (11, 17):
        team = make_team(seed, digits=digits)
        assert [f for f in flags(team) if f.startswith("wrong_state_space")] == []


@pytest.mark.slow
@pytest.mark.parametrize("start", range(1000, 1060, 10))
def test_no_honest_team_is_flagged(start):
    """1 to 3 carts, ζ from 0.003 to 0.15, 6 to 22 dwells, coarse encoders, a trace of friction."""
    for seed in range(start, start + 10):
        team = make_team(seed)
        assert flags(team) == [], (seed, team.bench)


@pytest.mark.slow
@pytest.mark.parametrize("code", sorted(SLIPS))
def test_a_mistake_gets_its_code(code):
    """On nine benches without friction and with three digits every slip is named."""
    for seed in range(2001, 2019, 2):
        team = make_team(seed, friction=0.0, digits=3)
        if team.bench.chain.n == 1 and code in OF_SEVERAL_CARTS:
            continue
        spoilt = SLIPS[code](replace(team, rng=np.random.default_rng([1, seed])))
        assert code in {flag.code for flag in spoilt.grade().flags}, (seed, team.bench)
