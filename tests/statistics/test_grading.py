"""In classes on benches of every kind, no honest team is flagged and mistakes are named."""

from dataclasses import replace

import numpy as np
import pytest

from tests.grading.test_class import flags
from tests.helpers.grading_class import make_team
from tests.helpers.grading_slips import OF_SEVERAL_CARTS, SLIPS


@pytest.mark.slow
@pytest.mark.parametrize("start", range(1000, 1060, 10))
def test_no_honest_team_is_flagged(start):
    """On varied benches, even with coarse encoders and some friction, no honest team is flagged."""
    for seed in range(start, start + 10):
        team = make_team(seed)
        assert flags(team) == [], (seed, team.bench)


NAMED = 0.9  # some mistakes cannot be recognised on such varied benches


@pytest.mark.slow
def test_mistakes_get_their_flags():
    """On benches without friction, nearly every mistake in three-digit numbers is named."""
    named, missed = 0, []
    for seed in range(2001, 2019, 2):
        team = make_team(seed, friction=0.0, digits=3)
        for code, slip in SLIPS.items():
            if team.bench.chain.n == 1 and code in OF_SEVERAL_CARTS:
                continue
            spoilt = slip(replace(team, rng=np.random.default_rng([1, seed])))
            if spoilt.submission is team.submission:
                continue
            if code in {flag.code for flag in spoilt.grade().flags}:
                named += 1
            else:
                missed.append((code, seed))
    assert named >= NAMED * (named + len(missed)), missed
