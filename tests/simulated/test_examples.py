"""Synthetic submissions are complete, physically sensible, and the same bytes every time."""

import re
import tomllib

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.errors import ConfigError
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import simulate_linear
from pipeline.resources import EXAMPLES
from pipeline.simulated.bench import COUNT, SAMPLE_TIME, BenchRun, ReleasingHand, SimulatedBench
from pipeline.simulated.examples import CATALOGUE, write_examples
from pipeline.simulated.submission import write_submission

PRESET_NAMES = list(PRESETS)
NOISE = 0.2 * COUNT


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """Return one submission for each preset, with reported values."""
    root = tmp_path_factory.mktemp("sessions")
    for preset in PRESET_NAMES:
        write_submission(root / preset, preset, seed=1, reported=True)
    return root


def toml(folder):
    return tomllib.loads((folder / "submission.toml").read_text(encoding="utf-8"))


def experiments(folder, kind):
    return [entry for entry in toml(folder)["experiments"] if entry["kind"] == kind]


def table(folder, entry):
    """Return the columns of one data file by name."""
    return np.genfromtxt(folder / entry["file"], delimiter=",", names=True)


def positions(data):
    return np.array([data[name] for name in data.dtype.names if re.fullmatch(r"x\d", name)])


def content(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# ------------------------------------------------------------------- the bytes


def test_the_shipped_examples_equal_what_the_program_writes(tmp_path):
    """The files in `submissions/` are what `python -m pipeline.simulated.examples` writes."""
    write_examples(tmp_path)

    for example in CATALOGUE:
        assert content(tmp_path / example.folder) == content(EXAMPLES / example.folder)


# --------------------------------------------------------------- the content


@pytest.mark.parametrize("preset", PRESET_NAMES)
def test_a_whole_session(sessions, preset):
    """A session has three decays of each cart, four kinds of steps, dwells, sweep and loop."""
    folder, n = sessions / preset, PRESETS[preset].n

    assert [e["carts"] for e in experiments(folder, "decay")] == [
        [cart] for cart in range(1, n + 1) for _ in range(3)
    ]
    levels = [table(folder, e)["input"] for e in experiments(folder, "step")]
    assert len({float(level[np.argmax(np.abs(level))]) for level in levels}) == 2
    assert {np.sign(level.sum()) for level in levels} == {1.0, -1.0}
    assert 20 <= len(experiments(folder, "sine")) <= 30
    assert len(experiments(folder, "sweep")) == 1
    assert len(experiments(folder, "closed_loop")) == 1


@pytest.mark.parametrize("preset", PRESET_NAMES)
def test_the_carts_move_well_and_not_too_far(sessions, preset):
    """In every run some cart moves by 0.4 to 2 cm, in whole counts, under a realistic input."""
    for entry in toml(sessions / preset)["experiments"]:
        data = table(sessions / preset, entry)
        x = positions(data)

        assert 0.4 <= np.abs(x).max() <= 2.0, entry["id"]
        assert np.abs(data["input"]).max() <= 5.0
        # Four decimals are written, so rounding errs by half of the last one.
        assert_allclose(x / COUNT, np.round(x / COUNT), atol=0.51e-4 / COUNT)
        assert_allclose(np.diff(data["time"]), SAMPLE_TIME, atol=1.01e-5)


@pytest.mark.parametrize("preset", PRESET_NAMES)
@pytest.mark.parametrize("kind", ["step", "sine", "sweep", "closed_loop"])
def test_the_log_is_the_motion_of_the_plant(sessions, preset, kind):
    """The logged input, applied to the true plant from rest, gives the logged positions."""
    for entry in experiments(sessions / preset, kind)[:5]:
        data = table(sessions / preset, entry)

        model = simulate_linear(PRESETS[preset], data["time"], data["input"])

        residual = positions(data) - model
        residual -= np.median(residual, axis=1, keepdims=True)  # offset of the encoder
        # A cart at rest may be anywhere between two counts, so rounding errs by up to half a count.
        assert np.sqrt(np.mean(residual**2)) < np.hypot(NOISE, COUNT / 2), entry["id"]


# ------------------------------------------------------------------ by hand


def release_by_hand(**changes):
    chain = PRESETS["throne-2dof"]
    t = SAMPLE_TIME * np.arange(500, dtype=np.float64)
    hand = ReleasingHand(cart=2, position=-1.5, release=0.4, fade=0.02)
    run = BenchRun(id="d", kind="decay", t=t, u=np.zeros(500), free=(2,), hand=hand)
    bench = SimulatedBench(chain=chain, zero_error_counts=0.0)
    return chain, hand, run, bench


def test_a_hand_holds_then_lets_go_softly():
    """A hand holds a cart within 1 % until the release, and its force then fades smoothly."""
    _, hand, run, bench = release_by_hand()

    x = bench.move(run).x

    held = run.t < hand.release
    assert_allclose(x[1, held], -1.5, rtol=0.01)
    assert_array_equal(x[0], 0.0)
    first = np.argmax(~held)
    step = np.diff(x[1])
    # Within a sample the cart moves omega² x T²/2 = 0.06 cm after a sudden release, and less after
    # a release that fades.
    assert abs(step[first]) < 0.04
    assert x[1].max() > 1.2  # then it swings to the other side


# -------------------------------------------------------------- what they claim


@pytest.mark.parametrize("preset", PRESET_NAMES)
def test_honest_claims_are_near_the_truth(sessions, preset):
    """Reported final gains and frequencies are within 2 % of the truth, dampings within 20 %."""
    truth, reported = PRESETS[preset].parameters(), toml(sessions / preset)["reported"]

    assert list(reported["initial"]) == list(reported["final"]) == list(truth)
    for name, value in truth.items():
        # Two standard errors, each combined from two or three springs and masses.
        limit = 0.2 if name.startswith("zeta") else 0.02
        assert reported["final"][name] == pytest.approx(value, rel=limit), name
        if re.fullmatch("zeta_[a-cxy]", name):
            assert reported["initial"][name] == 0.10


def test_the_controlled_cart_follows(sessions):
    """The controlled cart ends within 5 % of its reference.

    It is not closer, because the students' model is slightly off.
    """
    for preset in PRESET_NAMES:
        (entry,) = experiments(sessions / preset, "closed_loop")
        data = table(sessions / preset, entry)
        final = data[f"x{entry['controlled_cart']}"][-50:].mean()
        assert final == pytest.approx(data["reference"][-1], rel=0.05)


# ------------------------------------------------------------- other benches


def test_an_unknown_preset_names_the_known_ones(tmp_path):
    """A misspelt preset gives an error that lists the known presets."""
    with pytest.raises(ConfigError, match=r"'throne-4dof': .*throne-1dof, "):
        write_submission(tmp_path, "throne-4dof", seed=0)
