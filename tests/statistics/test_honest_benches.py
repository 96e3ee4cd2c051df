"""On nonlinear benches, no honest team's recording or number is called wrong."""

import pytest

from tests.helpers.honest_benches import grade_honest_team

PRESETS = ("throne-1dof", "throne-2dof", "throne-3dof")

# One bench for each effect that was once taken for a wrong unit, a wrong clock or a mistake: a dead
# zone, stiction, an end stop, and an amplifier at its limit.
ONCE_ACCUSED = [
    ("throne-2dof", 10),
    ("throne-2dof", 15),
    ("throne-2dof", 1),
    ("throne-3dof", 34),
]
STARTS = range(0, 40, 10)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(("preset", "seed"), ONCE_ACCUSED)
def test_benches_once_misjudged_get_no_flag(preset, seed, tmp_path):
    """Honest teams on these benches get no flag of any kind, and no recording is called wrong."""
    grade, analysis, term = grade_honest_team(tmp_path, preset=preset, seed=seed)
    assert [flag.message for flag in grade.flags] == [], term
    assert not any(one.is_wrong for one in analysis.left_out)


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("start", STARTS)
def test_no_honest_recording_is_called_wrong(preset, start, tmp_path):
    """For each effect at up to three times its usual size, no recording is called wrong."""
    for seed in range(start, start + 10):
        grade, analysis, term = grade_honest_team(tmp_path / f"{seed}", preset=preset, seed=seed)
        assert not any(one.is_wrong for one in analysis.left_out), (seed, term)
        assert "data_problem" not in [flag.code for flag in grade.flags], (seed, term)
