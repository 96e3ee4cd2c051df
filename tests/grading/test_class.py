"""Teams and classes that are easily misjudged are judged correctly."""

import tempfile
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.mistakes.state_model import own_chain
from pipeline.grading.publish.class_page import class_page, wrong_springs
from pipeline.grading.rubric_file import load_rubric
from pipeline.plant.chain import Chain
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from tests.helpers.grading_class import Team, make_team
from tests.helpers.grading_slips import SLIPS, scaled

# By default, one case of each kind that once went wrong runs; `LONG` marks the other cases.
LONG = [pytest.mark.slow, pytest.mark.sample]
TIED = Chain(
    m=np.array([3.1e-4, 1.7e-4]), c=np.array([6.7e-4, 4.4e-4]), k=np.array([0.05, 0.127, 0.061])
)


def flags(team: Team) -> list[str]:
    return [f"{flag.code}: {flag.message}" for flag in team.grade().flags]


@pytest.mark.parametrize(
    "seed", [30, *(pytest.param(seed, marks=LONG) for seed in (5, 90, 60023, 60066))]
)
def test_little_damping_flags_nobody(seed):
    """If damping is too small for the dwells to show, nobody gets a flag."""
    team = make_team(seed)
    assert team.bench.chain.zeta_carts.max() < 0.02
    assert flags(team) == []


def test_a_damping_fitted_as_zero_is_judged_by_the_decays():
    """If the fit puts a damping at zero, a reported damping is judged by the decays.

    A fit that ends at its bound does not measure the damping.
    """
    team = make_team(30)
    assert team.analysis.chain is not None
    wrong = team.reporting(final={"zeta": Decimal("0.021")}).grade()
    assert [flag.code for flag in wrong.flags] == ["final_off"]
    assert wrong.flags[0].evidence["recomputed"] == pytest.approx(0.00316, rel=0.1)


@pytest.mark.parametrize("seed", [18, *(pytest.param(seed, marks=LONG) for seed in (34, 38))])
def test_coarse_encoders_cost_no_points(seed):
    """On benches with coarse encoders, honest teams lose no points."""
    team = make_team(seed, count=0.2, travel=1.0, friction=0.0)
    grade = team.grade()
    assert [flag.code for flag in grade.flags] == []
    assert grade.points >= 0.99 * grade.out_of


@pytest.mark.slow
@pytest.mark.sample
def test_a_table_of_three_carts_without_a_gain_gives_no_carts():
    """If a table of three carts lacks a gain, no carts are computed from the table."""
    team = make_team(2)
    table = {x: float(v) for x, v in team.reported.final.items()}
    assert own_chain(table, n=3) is not None
    del table["K_3"]
    assert own_chain(table, n=3) is None
    grade = team.reporting(final={"K_3": -team.reported.final["K_3"]}).grade()
    assert "physically_impossible" in [flag.code for flag in grade.flags]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(("seed", "digits"), [pytest.param(11, 2, marks=LONG), (17, 3)])
def test_a_model_from_coarse_numbers_is_not_flagged(seed, digits):
    """A state model computed from coarsely typed numbers is not flagged.

    In the test, rounding alone changes the couplings by a third.
    """
    flags = make_team(seed, digits=digits).grade().flags
    assert "wrong_state_space" not in [flag.code for flag in flags]


@pytest.mark.parametrize(
    ("seed", "turn", "slips"),
    [
        pytest.param(72014, 6, ("peak_count", "log10_for_ln"), marks=LONG),
        (73025, 0, ("hz_for_rad_s",)),  # one resonance read anywhere by eye
        pytest.param(73026, 0, ("peak_count",), marks=LONG),  # a decay read at its seventh period
        # typed too coarsely to rule out a factor of 6/5
        pytest.param(72007, 3, ("initial_off",), marks=LONG),
        pytest.param(72021, 0, ("hz_for_rad_s", "log10_for_ln"), marks=LONG),
    ],
)
def test_the_flags_are_those_that_explain_a_table_best(seed, turn, slips):
    """If several mistakes overlap, the flags are those that explain the whole table best."""
    team = replace(make_team(seed), rng=np.random.default_rng([9, seed, turn]))
    for slip in slips:
        team = SLIPS[slip](team)
    assert {flag.code for flag in team.grade().flags} == set(slips)


@pytest.mark.slow
@pytest.mark.sample
def test_a_gain_that_two_mistakes_explain_names_both():
    """If two mistakes explain a gain equally well, the flag names both.

    With little damping, the peak of a step is twice its level, so a doubled gain fits both.
    """
    team = scaled(make_team(72003), ["K"], 2.0, ["initial"])
    (flag,) = team.grade().flags
    assert {flag.code, *flag.evidence["or_else"]} == {"peak_for_steady_state", "peak_to_peak"}


def tied(seed: int) -> tuple[Team, Grade]:
    """Return a team whose two carts have springs to both walls, and its grade.

    The rubric has no spring to the wall near cart 1.
    """
    with tempfile.TemporaryDirectory() as folder:
        team = make_team(seed, folder=Path(folder), digits=3, chain=TIED)
        rubric = load_rubric(Path("throne-2dof"))
        submission = team.submission.model_copy(
            update={"system": rubric.system.model_copy(update={"springs": (False, True, True)})}
        )
        required = team.rubric.required
        rubric = rubric.model_copy(update={"required": required})
        return team, grade_submission(submission, rubric=rubric, name="team-07").grade


@pytest.mark.slow
@pytest.mark.sample
def test_a_spring_that_the_rubric_lacks_flags_nobody():
    """If the recordings need a spring that the rubric lacks, it is used and nobody is flagged."""
    team, grade = tied(1)
    assert grade.springs == ("wall-1",)
    assert [flag.code for flag in grade.flags] == []
    assert grade.points >= 0.95 * grade.out_of
    assert "wall-1" in wrong_springs([grade.springs, ()])
    lines = [grade]
    assert "wall-1" in class_page(lines, rubric=team.rubric)
    assert wrong_springs([(), ()]) == ""


@pytest.mark.slow
@pytest.mark.sample
def test_a_decay_with_friction_is_not_flagged_as_a_wrong_logarithm(tmp_path):
    """If friction makes the decays' damping uncertain, no wrong logarithm is flagged.

    The team's own final value contradicts a wrong logarithm.
    """
    bench = prepare_bench(preset="throne-1dof", hide=("coulomb_friction:cart=1,force=0.003",))
    write_submission(tmp_path / "team", bench, seed=3, reported=True)
    submission = load_submission(tmp_path / "team")
    rubric = load_rubric(Path("throne-1dof"))
    grade = grade_submission(submission, rubric=rubric, name="team").grade
    assert "log10_for_ln" not in [flag.code for flag in grade.flags]
