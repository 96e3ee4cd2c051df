"""Faults of a position sensor are repaired and reported, unless the submission forbids it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.ingest.jumps import repair_positions
from pipeline.ingest.read import read_data
from pipeline.submission import load_submission
from tests.helpers.recordings import facts

N = 1200
T = 0.005 * np.arange(N, dtype=np.float64)
U = np.where(T > 0.5, 1.0, 0.0)
RNG = np.random.default_rng(3)
X = 2 * U * (1 - np.exp(-2 * (T - 0.5)) * np.cos(20 * (T - 0.5))) + 0.002 * RNG.normal(size=N)
COUNTS = np.round(1000 * X)
SPIKES = np.arange(100, N, 190)


def record(folder, x, *, unit="cm", more="", rate=1.0):
    """Return the record of a step with these positions."""
    lines = "".join(f"{t / rate:.6f},{u},{v:.6f}\n" for t, u, v in zip(T, U, x, strict=False))
    if unit == "count":
        lines = "".join(f"{t:.6f},{u},{v:.0f}\n" for t, u, v in zip(T, U, x, strict=True))
    (folder / "a.csv").write_text("time [s],input [V],x1\n" + lines)
    (folder / "submission.toml").write_text(
        "version = 1\n[system]\ncarts = 1\ninput = { unit = 'V', sign = 1 }\n"
        f"position = {{ unit = {unit!r} }}\n"
        f"[[experiments]]\nid = 'a'\nkind = 'step'\nfile = 'a.csv'\n{more}\n"
    )
    (got,) = read_data(load_submission(folder)).records
    return got


def wrapped(period: float, offset: float, scale: float) -> np.ndarray:
    """Return positions as a counter with this range shows them."""
    return (scale * X + offset) % period


OFF = "unwrap = false, spikes = false, jumps = false"
WRAPS = {
    "16 bits": (np.round(wrapped(65536, 64_000, 1000)), "count", 1000.0),
    "12 bits": (np.round(wrapped(4096, 3_000, 500)), "count", 500.0),
    "20 bits": (np.round(wrapped(2**20, 2**20 - 1_500, 1000)), "count", 1000.0),
    "rad": (wrapped(2 * np.pi, 5.0, 1.0), "rad", 1.0),
    "deg": (wrapped(360.0, 300.0, 60.0), "deg", 60.0),
}


@pytest.mark.parametrize(("x", "unit", "scale"), WRAPS.values(), ids=WRAPS.keys())
def test_a_counter_that_wraps_is_unwrapped(x, unit, scale, tmp_path):
    """Positions of a counter or an angle that wraps become continuous."""
    got = record(tmp_path, x, unit=unit)
    # Counts are rounded, and the file has six decimals.
    assert_allclose(got.y[0] - got.y[0, 0], scale * (X - X[0]), atol=1.1)
    jumps = np.flatnonzero(np.abs(np.diff(x)) > np.ptp(x) / 2) + 1
    told = facts(got.notes)["unwrap"]
    assert (told.about, told.at) == ("x1", tuple(jumps))
    kept = record(tmp_path, x, unit=unit, more=f"repair = {{ {OFF} }}")
    assert_allclose(kept.y[0], x, atol=1e-6)


@pytest.mark.parametrize("value", [357.0, -40.0, 0.0])
def test_wrong_readings_are_left_out(value, tmp_path):
    """Lone spikes, and dropouts to zero of a cart that rests elsewhere, are left out."""
    x = X + 12.0
    x[SPIKES] = value
    got = record(tmp_path, x)
    right = np.delete(np.arange(N), SPIKES)
    assert facts(got.notes)["spikes"].at == tuple(SPIKES)
    assert_array_equal(got.t, T[right].round(6))
    assert_allclose(got.y[0], x[right], atol=1e-6)
    kept = record(tmp_path, x, more="repair = { spikes = false, jumps = false }")
    assert kept.t.size == N


@pytest.mark.parametrize(("rows", "wrong"), [(3, True), (9, True), (12, True), (14, False)])
def test_wrong_readings_in_a_row_are_left_out(rows, wrong, tmp_path):
    """Twelve readings in a row may be wrong; a longer stretch may be real."""
    x = X + 12.0
    x[700 : 700 + rows] = 0.0
    notes = facts(record(tmp_path, x).notes)
    assert ("spikes" in notes) == wrong
    assert not wrong or notes["spikes"].at == tuple(range(700, 700 + rows))


@pytest.mark.parametrize("i", [116, 700])
def test_a_new_zero_is_taken_back(i, tmp_path):
    """A position that is zeroed during the run, in motion or at rest, continues where it was."""
    x = X.copy()
    x[i:] -= x[i]
    got = record(tmp_path, x)
    # The cart moves by the mean of the steps beside the jump, which the noise of 0.002 blurs. At
    # sample 116 it moves fastest, by 0.16 a sample.
    assert_allclose(got.y[0], X, atol=0.02)
    assert facts(got.notes)["jumps"].at == (i,)


def test_a_jump_with_the_input_is_no_new_zero(tmp_path):
    """A position that jumps when the input does is left as it is."""
    x = X + 3 * U
    assert_allclose(record(tmp_path, x).y[0], x, atol=1e-6)


def test_a_new_zero_of_a_fast_cart_is_no_wrapped_counter(tmp_path):
    """If a cart moves by a fifth of a counter's range in a sample, no jump shows that range."""
    since = np.maximum(T - 0.5, 0.0)
    x = np.round(120 * np.exp(-12 * since) * np.sin(100 * since))  # up to 54 counts a sample
    zeroed = np.where(np.arange(N) < 900, x, x + 180)
    assert_allclose(record(tmp_path, zeroed, unit="count").y[0], x)
    kept = record(tmp_path, zeroed, unit="count", more="repair = { jumps = false }")
    assert_allclose(kept.y[0], zeroed)


@pytest.mark.parametrize("n", [8, 20])
def test_repeated_readings_are_used_once(n, tmp_path):
    """A slow sensor in a fast log is read at its own rate, and is not stuck."""
    x = X[np.arange(N) // n * n]
    got = record(tmp_path, x)
    assert_array_equal(got.t, T[::n].round(6))
    assert_allclose(got.y[0], X[::n], atol=1e-6)
    assert [*facts(got.notes)] == ["repeats"]


@pytest.mark.parametrize("x", [X, X + 5.0, np.round(X, 1), np.round(X, 2), 0.01 * X])
def test_an_honest_position_is_left_alone(x, tmp_path):
    """Noise, a coarse encoder and a fast start are no reason for a repair."""
    got = record(tmp_path, x)
    assert got.t.size == N
    assert got.notes == ()
    assert_allclose(got.y[0], x, atol=1e-6)


@pytest.mark.parametrize("scale", [1.0, 0.00227])
def test_a_scaled_counter_is_unwrapped(scale):
    """A counter of 16 bits is continued where it wraps, whatever a count is worth."""
    counts = np.array(64_000 + np.round(3000 * T), dtype=np.float64)
    read = {"x1": np.array(scale * (counts % 65_536), dtype=np.float64)}
    done, _, notes = repair_positions(T, read, None, unit="cm", scales={"x1": scale}, wanted={})
    assert_allclose(done["x1"] - done["x1"][0], scale * (counts - counts[0]))
    assert list(facts(notes)) == ["unwrap"]


@pytest.mark.parametrize("size", [9000.0, -9000.0])
def test_a_new_zero_of_a_moving_cart_leaves_no_step(size):
    """Where a jump was removed, the cart moves on as in the samples beside it."""
    x = np.array(np.round(4000 * T) + np.where(np.arange(N) >= 700, size, 0.0), dtype=np.float64)
    done, _, notes = repair_positions(
        T, {"x1": x}, None, unit="count", scales={"x1": 1.0}, wanted={}
    )
    assert_allclose(done["x1"], np.round(4000 * T), atol=1.0)
    assert list(facts(notes)) == ["jumps"]
