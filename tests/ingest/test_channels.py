"""What the signals themselves reveal: encoder step, broken or clipped channels, copies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from pipeline.ingest.channels import (
    encoder_step,
    mirrors,
    saturation,
    settles_at_input,
    stuck_spans,
)

RATE = 113.0
T = np.arange(900, dtype=np.float64) / RATE


@settings(deadline=None)
@given(
    step=st.floats(1e-4, 10.0),
    travel=st.integers(20, 3000),
    decimals=st.integers(2, 15),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_encoder_step_is_recovered(step, travel, decimals, seed):
    """The encoder step is found from positions printed to a hundredth of the step or finer."""
    rng = np.random.default_rng(seed)
    counts = np.round(travel * np.sin(np.linspace(0, 20, 2000)) + rng.standard_normal(2000))
    digits = decimals - int(np.floor(np.log10(step)))
    x = np.round(step * counts, digits)
    # Each level is off by half a printed digit, at most 0.005 of a step; the line through the
    # levels spans at least 30 of them.
    assert_allclose(encoder_step(x), step, rtol=1e-3)


def test_a_signal_without_steps_has_no_encoder_step():
    """Neither noise in full precision nor a constant has an encoder step."""
    rng = np.random.default_rng(1)
    assert encoder_step(rng.standard_normal(1000)) == 0.0
    assert encoder_step(np.full(1000, 3.0)) == 0.0


def test_a_mirrored_position_is_distinguished_from_a_reference():
    """A copy of encoder 1, read between two samples, is recognised as a copy.

    A set point is not taken for a copy.
    """
    x = np.rint(440 * (1 - np.exp(-2 * T) * np.cos(13 * T)))
    between = np.rint(0.5 * x + 0.5 * np.r_[x[0], x[:-1]])
    assert mirrors(between, x)
    assert not mirrors(np.where(T > 0.1, 440.0, 0.0), x)
    assert not mirrors(np.rint(440 * np.sin(T)), np.rint(440 * np.sin(T - 0.1)))


def test_a_stuck_encoder_is_found():
    """A reading that freezes in motion and jumps back is stuck; a cart at its peak is not."""
    x = np.rint(440 * np.sin(6 * T))
    assert stuck_spans(x) == []
    frozen = x.copy()
    frozen[200:230] = frozen[199]
    assert stuck_spans(frozen) == [(199, 229)]
    dead = x.copy()
    dead[600:] = dead[599]
    assert stuck_spans(dead) == [(599, 899)]
    assert stuck_spans(np.rint(440 * np.exp(-3 * T) * np.cos(20 * T))) == []


def test_a_coarse_encoder_that_stuck_comes_back_with_a_jump():
    """A coarse encoder counts as stuck if its reading resumes with a jump.

    A cart held by friction does not jump.
    """
    x = np.rint(12 * np.sin(3 * T))
    assert stuck_spans(x) == []
    held = np.concatenate([x[:240], np.full(60, x[240]), x[240:]])
    assert stuck_spans(held) == []
    frozen = x.copy()
    frozen[241:301] = frozen[240]
    assert [last for _, last in stuck_spans(frozen)] == [300]


@pytest.mark.parametrize("digits", [2, 3, 4, 9])
def test_clipping_is_distinguished_from_a_rounded_crest(digits):
    """A sine that rounding makes flat at its peak is not taken for a clipped one."""
    crest = np.round(0.8 * np.sin(7.3 * T), digits)
    assert saturation(crest) is None
    clipped = np.clip(np.round(1.6 * np.sin(7.3 * T), digits), -1.0, 1.0)
    assert saturation(clipped) == 1.0


def test_a_few_equal_samples_at_a_peak_are_not_clipping():
    """A coarse sine with three equal samples at its peak, as noise may leave, is not clipped."""
    t = 0.00884 * np.arange(159)
    sines = [np.round(34 * np.sin(31.2274 * t + phase)) for phase in np.linspace(0, 6, 400)]
    assert {saturation(np.minimum(sine, 33)) for sine in sines} == {None}
    assert saturation(np.minimum(sines[0], 22)) == 22


def test_steps_and_slow_approaches_are_not_clipped():
    """Steps and slow approaches to a value are not taken for clipping."""
    assert saturation(np.where(T > 1, 1.0, 0.0)) is None
    assert saturation((1 - np.exp(-2 * T)).round(4)) is None


@pytest.mark.parametrize(
    ("gain", "settles"), [(1.0, True), (-1.01, True), (1.1, False), (4.0, False)]
)
def test_a_set_point_in_the_input_column_is_seen(gain, settles):
    """A cart that settles at the number in the input column may follow it as a set point."""
    u = np.where((T > 1.0) & (T < 5.0), 1000.0, 0.0)
    rise = np.exp(-3.0 * np.clip(T - 1.0, 0.0, 4.0)) * np.cos(20.0 * (T - 1.0))
    x = np.round(gain * u * (1.0 - rise)) + 40.0
    assert settles_at_input(u, x) == settles
    assert settles_at_input(u, (0.00227 * x) / 0.00227) == settles  # counts, but for rounding
    assert not settles_at_input(u / 1000.0, x)
