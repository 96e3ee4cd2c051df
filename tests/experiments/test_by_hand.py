"""A recording that a person adds to the plan by a few numbers."""

import pytest

from pipeline.errors import ConfigError
from pipeline.experiments.plan import add_recordings, load_plan
from pipeline.experiments.propose import add_recording, make_recording
from pipeline.submission import load_submission
from tests.helpers.acquisitions import sine, write_work


@pytest.fixture
def work(tmp_path):
    """Return a folder of two carts with one planned dwell, limited to 0.5 V and 2.5 cm."""
    return write_work(tmp_path / "work", [sine("sine-1", seconds=5, settle=7.0)])


@pytest.mark.parametrize(
    ("kind", "numbers", "expected"),
    [
        ("step", {"amplitude": -0.1}, {"wave": "square", "duration": 20.0, "settle": 7.0}),
        (
            "sweep",
            {"amplitude": 0.1, "frequency": 0.5, "frequency_end": 5.0},
            {"wave": "chirp", "duration": 20.0, "frequency_end": 5.0, "carts": (1, 2)},
        ),
        ("sine", {"amplitude": 0.1, "frequency": 0.7}, {"wave": "sine", "cycles": 14}),
        ("decay", {"cart": 2}, {"carts": (2,), "release": 2, "duration": 20.0, "amplitude": 0.0}),
    ],
)
def test_a_recording_is_added_at_the_end_of_the_plan(work, kind, numbers, expected):
    """A recording of any kind is added at the end of the plan, with a new id."""
    submission = load_submission(work)
    plan = load_plan(submission)
    wanted = make_recording(kind, seconds=20.0, **numbers, plan=plan, submission=submission)
    new = add_recording(work, wanted)
    assert load_plan(submission).recordings == (*plan.recordings, new)
    assert {name: getattr(new, name) for name in expected} == expected
    assert new.id not in {one.id for one in plan.recordings}


@pytest.mark.parametrize(
    ("kind", "numbers", "words"),
    [
        ("step", {"amplitude": 0.6}, "amplitude: expected at most the limit of 0.5 V, found 0.6"),
        ("step", {"amplitude": 0.0}, "amplitude: 0 moves nothing"),
        ("sine", {"amplitude": 0.1}, "frequency: expected 0.001 to 1000 Hz, found 0"),
        ("sine", {"amplitude": 0.1, "frequency": 1e308}, "frequency: expected"),
        (
            "sweep",
            {"amplitude": 0.1, "frequency": 1.0},
            "frequency at the end: expected 0.001 to 1000 Hz, found 0",
        ),
        (
            "sweep",
            {"amplitude": 0.1, "frequency": 1.0, "frequency_end": -3.0},
            "frequency at the end: expected",
        ),
        (
            "sweep",
            {"amplitude": 0.1, "frequency": 1.0, "frequency_end": 1.0},
            "frequency at the end: a chirp must end at a different",
        ),
        ("decay", {"cart": 1, "seconds": 1e-320}, "seconds: expected 1 to 120 s"),
        ("decay", {"cart": 1, "seconds": 121.0}, "seconds: .* found 121"),
        ("sine", {"amplitude": 0.1, "frequency": 0.005}, "frequency: expected at least 0.0083 Hz"),
    ],
)
def test_a_number_outside_the_limits_is_refused_by_name(work, kind, numbers, words):
    """A number outside the limits is refused with the allowed range, and nothing is written."""
    submission = load_submission(work)
    plan = load_plan(submission)
    given = {"seconds": 20.0, **numbers}
    with pytest.raises(ConfigError, match=words):
        make_recording(kind, **given, plan=plan, submission=submission)
    assert load_plan(submission) == plan


@pytest.mark.parametrize(
    ("seconds", "frequency", "cycles"), [(100.0, 0.07, 7), (101.0, 0.07, 8), (120.0, 0.07, 8)]
)
def test_whole_periods_last_as_long_as_typed(work, seconds, frequency, cycles):
    """100 s at 0.07 Hz become exactly 7 periods, despite the rounding of floats."""
    submission = load_submission(work)
    made = make_recording(
        "sine",
        seconds=seconds,
        amplitude=0.1,
        frequency=frequency,
        plan=load_plan(submission),
        submission=submission,
    )
    assert made.cycles == cycles


def test_recordings_that_others_added_meanwhile_are_kept(work):
    """Recordings that others added to the plan meanwhile are kept."""
    old = load_plan(load_submission(work))
    theirs = add_recording(work, sine("theirs", seconds=5))
    new = [sine(name, seconds=4) for name in ("sine-1", "theirs")]
    plan = add_recordings(work, new, otherwise=old)
    assert plan == load_plan(load_submission(work))
    assert plan.recordings[:-2] == (*old.recordings, theirs)
    assert [one.id for one in plan.recordings[-2:]] == ["sine-2", "theirs-2"]
