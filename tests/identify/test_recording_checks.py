"""Recordings that contradict their description fail a check; honest ones do not."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.identify.recording_checks import (
    check_setup,
    find_bad_recordings,
    find_shown,
    gain_sign_warning,
)
from pipeline.results import Record
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.time_records import record_of

T = np.arange(0.0, 10.0, 0.01)
OMEGA = 5.0  # rad/s; no whole number of samples is a period
WAVE = np.sin(OMEGA * T).round(3)


def dwell(y: Array, *, free: tuple[int, ...] = (1, 2), limit: float = np.inf) -> Record:
    """Return a dwell whose input is clipped at `limit`."""
    u = np.minimum(WAVE, limit)
    return record_of(T, u, y, kind="sine", id="dwell", free=free, omega=OMEGA, count=1e-3)


@pytest.mark.parametrize(
    ("swing", "code"),  # of cart 2, relative to that of the free cart 1
    [
        (0.04, ""),  # what a clamp gives
        (0.06, "moves_though_held"),
        (0.9, "moves_though_held"),
        (4.8, ""),
        (5.2, "wrong_setup"),
    ],
)
def test_a_cart_stated_as_held_must_hardly_move(swing, code):
    """A held cart may move by 5 % of the free one; at five times its swing, it is the free one."""
    checks = check_setup([dwell(np.stack([WAVE, swing * WAVE]), free=(1,))])
    assert [check.code for check in checks if check.outcome == "fail"] == [code] * bool(code)
    assert {check.cart for check in checks if check.code == "moves_though_held"} <= {2}


@pytest.mark.parametrize(
    ("on", "code"),
    [
        ((0.0, 0.0), ""),
        ((0.0, 2.0), ""),
        ((3.0, 8.0), "driven_decay"),
        ((6.0, 8.0), "driven_decay"),
    ],
)
def test_a_decay_is_free_in_its_second_half(on, code):
    """In a decay the input may release the cart, but not act on it later (`_another_input`)."""
    u = np.where((on[0] <= T) & (on[1] > T), 1.0, 0.0)
    run = record_of(T, u, np.stack([WAVE]), kind="decay", id="decay", count=1e-3)
    other = record_of(T, WAVE, np.stack([WAVE]), kind="sweep", id="sweep", count=1e-3)
    found = find_shown([run, other], files={})
    assert [one.code for one in found.values()] == [code] * bool(code)


@pytest.mark.parametrize(
    ("free", "limits", "explained", "code"),
    [
        ((1, 2), (0.6, np.inf, np.inf), True, "clipped_position"),
        ((1, 2), (0.6, np.inf, np.inf), False, ""),  # a cart that sticks looks clipped
        ((1, 2), (np.inf, 0.6, np.inf), True, "clipped_position"),
        ((1,), (np.inf, 0.6, np.inf), True, ""),  # a held cart does not swing
        ((1, 2), (np.inf, np.inf, 0.6), False, "clipped_input"),
        ((1, 2), (np.inf, np.inf, np.inf), True, ""),
    ],
)
def test_clipped_signals_are_found(free, limits, explained, code):
    """A clipped position of a free cart and a clipped input are faults."""
    y = np.stack([np.minimum(WAVE, limit) for limit in limits[:2]])
    analysis = make_analysis(2)
    assert analysis.fit is not None
    analysis = replace(
        analysis,
        records=(dwell(y, free=free, limit=limits[2]),),
        fit=replace(analysis.fit, chi_square_per_dof=1.0 if explained else 100.0),
        left_out=(),
        late_channels=(),
    )
    assert [one.code for one in find_bad_recordings(analysis).values()] == [code] * bool(code)


@pytest.mark.parametrize(
    ("seconds", "stated", "code"),  # the stated frequency, over that of the input
    [
        (10.0, 1.0, ""),
        (10.0, 1.06, ""),
        (10.0, 1.3, "other_frequency"),
        (10.0, 0.7, "other_frequency"),
        (2.0, 1.3, ""),  # too short to tell the two frequencies apart
    ],
)
def test_a_dwell_of_another_frequency_is_found_if_it_is_long_enough(seconds, stated, code):
    """The frequencies must differ by more than 8 %, and by more than the record can resolve."""
    run, analysis = dwell(np.stack([WAVE, WAVE])), make_analysis(2)
    short = replace(run, omega=stated * OMEGA).part(slice(0, round(100 * seconds)))
    analysis = replace(analysis, records=(short,), left_out=(), late_channels=())
    assert [one.code for one in find_bad_recordings(analysis).values()] == [code] * bool(code)


@pytest.mark.parametrize(("scales", "warns"), [((1, 1, -1), False), ((-1, -1, 1), True)])
def test_a_bench_with_a_negative_input_is_told(scales, warns):
    """Gains have the bench's sign, so a warning says if most inputs count the other way."""
    one = dwell(np.zeros((2, T.size)))
    records = [replace(one, input_scale=float(scale)) for scale in scales]
    loops = [replace(one, kind="closed_loop", input_scale=-1.0)] * 5  # a controller's own sign
    assert bool(gain_sign_warning([*records, *loops])) == warns
