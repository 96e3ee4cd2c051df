"""Static gains are found from steps, also with friction, and unusable recordings are refused."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.estimation.static_gain import fit_static_gain
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import Record
from pipeline.submission import load_submission
from tests.helpers.time_records import COUNT
from tests.helpers.ucsd import write_two_cart_submission

FS = 113.1  # Hz, the usual sampling rate of the ECP 210
FOUR = Chain(
    m=np.array([3e-4, 2.5e-4, 2e-4, 2e-4]),
    c=np.array([1.5e-3, 8e-4, 6e-4, 6e-4]),
    k=np.array([0.02, 0.12, 0.07, 0.06, 0.06]),
)


def staircase(t, *edges):
    """Return an input that changes to a given level at each given time."""
    u = np.zeros_like(t)
    for time, level in edges:
        u[t >= time] = level
    return u


def run_of(chain, t, u, *, count=COUNT, offset=0.0, noise=0.0):
    y = simulate_linear(chain, t, u) + offset
    y = y + noise * np.random.default_rng(1).normal(size=y.shape)
    return record(t, u, y, count=count)


def record(t, u, y, *, count=COUNT):
    carts = tuple(range(1, y.shape[0] + 1))
    return Record(
        id="step",
        kind="step",
        t=t,
        u=u,
        y=np.round(y / count) * count if count else y,
        carts=carts,
        free=carts,
        resolution=np.full(len(carts), count),
    )


def seconds(duration):
    return np.arange(0, duration, 1 / FS)


# ------------------------------------------------------------------ static gains


@pytest.mark.parametrize(
    ("chain", "size"), [*product(PRESETS.values(), (0.03, -0.02)), (FOUR, 0.03)]
)
def test_every_cart_has_its_static_gain(chain, size):
    """A step on and off, of either sign, gives the static gain of each of one to four carts."""
    t = seconds(14.0)
    run = run_of(chain, t, staircase(t, (0.5, size), (7.0, 0.0)), offset=0.3)
    for cart, truth in enumerate(chain.static_gains(), start=1):
        got = fit_static_gain(run, cart=cart)
        # Rounding moves each of the two levels by up to half a count, together by one count.
        assert_allclose(got.gain, truth, atol=COUNT / abs(size))
        assert abs(got.gain - truth) < 3 * got.gain_std
        assert len(got.edges) == 2
        assert got.interval is None
        assert got.note == ""
        assert got.rest_shift is not None
        assert abs(got.rest_shift) <= COUNT


def test_an_exact_record_gives_the_exact_gain():
    """Without rounding, the gain is exact even if the record ends before the carts settle."""
    chain, t = PRESETS["throne-2dof"], seconds(5.0)
    run = run_of(chain, t, staircase(t, (0.5, 0.03)), count=0.0)
    got = fit_static_gain(run, cart=2)
    assert_allclose(got.gain, chain.static_gains()[1], rtol=1e-7)


def test_each_step_in_a_record_gives_a_gain():
    """If a record has several steps of different size and sign, each of them gives a gain."""
    chain, t = PRESETS["throne-1dof"], seconds(24.0)
    u = staircase(t, (0.5, 0.02), (5.0, 0.04), (10.0, -0.03), (15.0, 0.0), (20.0, -0.01))
    got = fit_static_gain(run_of(chain, t, u), cart=1)
    sizes = [edge.u_after - edge.u_before for edge in got.edges]
    assert_allclose(sizes, [0.02, 0.02, -0.07, 0.03, -0.01], atol=1e-12)
    assert_allclose(got.gain, chain.static_gains()[0], rtol=2e-3)
    assert all(abs(edge.gain - got.gain) < 4 * edge.gain_std for edge in got.edges)


def test_a_level_is_read_while_nothing_moves():
    """A level is read while nothing moves: just before an edge, and after the ringing."""
    t = seconds(14.0)
    run = run_of(PRESETS["throne-1dof"], t, staircase(t, (2.0, 0.03), (8.0, 0.0)))
    on, off = fit_static_gain(run, cart=1).edges
    assert on.window_before == (0.0, t[t < 2.0][-1])
    # The ringing of 0.87 cm e^(-1.32 t) is 1.5 counts at 4.2 s.
    assert 5.0 < on.window_after[0] < 7.0
    assert on.window_after[1] == t[t < 8.0][-1] == off.window_before[1]
    assert (on.t, off.t) == (t[t >= 2.0][0], t[t >= 8.0][0])


# ------------------------------------------------------------- records cut short


@pytest.mark.parametrize("wait", [0.9, 1.5, 3.0])
@pytest.mark.parametrize("name", ["throne-1dof", "throne-2dof", "throne-3dof"])
def test_if_a_record_ends_early_a_fit_gives_the_level(name, wait):
    """If a record ends before the carts settle, a fit of damped sinusoids gives the level.

    The gain then has the error of this fit, and a note says so.
    """
    chain, t = PRESETS[name], seconds(0.5 + wait)
    run = run_of(chain, t, staircase(t, (0.5, 0.03)), noise=0.2 * COUNT)
    for cart, truth in enumerate(chain.static_gains(), start=1):
        got = fit_static_gain(run, cart=cart)
        assert abs(got.gain - truth) < 4 * got.gain_std
        assert_allclose(got.gain, truth, rtol=1e-2)
        assert "still oscillates" in got.note


# --------------------------------------------------------------- real conditions


SHORT, LONG = seconds(7.0), seconds(16.0)
UNUSUAL = {
    # name: times, input, its noise, rest position, words in the note, times of the edges
    "begun before it settles": (
        LONG, staircase(LONG, (0.5, 0.03), (1.7, 0.0)), 0, 0, "", (0.5, 1.7)
    ),
    "on from the start": (SHORT, np.full_like(SHORT, 0.03), 0, -0.2, "first sample", (0.0,)),
    "one sample of rest": (SHORT, staircase(SHORT, (SHORT[1], 0.03)), 0, 0, "", (SHORT[1],)),
    "noisy": (LONG, staircase(LONG, (0.5, 0.03), (8.0, 0.0)), 3e-4, 0, "", (0.5, 8.0)),
    "a slow edge": (SHORT, 0.03 * np.clip((SHORT - 0.5) / 0.09, 0, 1), 0, 0, "", (0.59,)),
    "a drift": (
        LONG, staircase(LONG, (3.0, 0.03), (9.0, 0.0)), 0, 0.01 * LONG, "drift", (3.0, 9.0)
    ),
}  # fmt: skip


@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof"])
@pytest.mark.parametrize("name", UNUSUAL)
def test_an_unusual_step_gives_the_gain(name, preset):
    """Edges and gain are right for an early, slow or noisy edge, little rest, and a drift."""
    t, u, noise, rest, note, edges = UNUSUAL[name]
    chain = PRESETS[preset]
    noisy = u + noise * np.random.default_rng(0).normal(size=t.size)
    got = fit_static_gain(replace(run_of(chain, t, u, offset=rest), u=noisy), cart=1)
    # An edge is at the first sample with the new input.
    shift = np.array([edge.t for edge in got.edges]) - edges
    assert np.all((shift >= 0) & (shift < 1 / FS))
    # Rounding moves each of the two levels by up to half a count.
    assert_allclose(got.gain, chain.static_gains()[0], atol=COUNT / 0.03)
    assert abs(got.gain - chain.static_gains()[0]) < 3 * got.gain_std
    # The variance of each level's rounding is at most step²/12.
    assert got.gain_std <= np.sqrt(2 / 12) * COUNT / 0.03
    assert note in got.note
    assert got.interval is None


@pytest.mark.parametrize("noise", [0.5, 3.0])
def test_noise_is_averaged(noise):
    """Noise on the position is averaged, and the gain is right to four standard errors."""
    chain, t = PRESETS["throne-2dof"], seconds(14.0)
    u = staircase(t, (1.0, 0.03), (7.0, 0.0))
    got = fit_static_gain(run_of(chain, t, u, noise=noise * COUNT), cart=1)
    assert abs(got.gain - chain.static_gains()[0]) < 4 * got.gain_std
    assert got.gain_std < noise * COUNT / 0.03 / 1.5  # below the noise of a single sample


def test_edges_that_disagree_have_the_error_of_their_mean():
    """If the gains of three edges scatter, `fit_static_gain` states the error of their mean."""
    t, levels = seconds(16.0), (1.0, 1.9, 3.0)
    u = staircase(t, *((4.0 * i, 0.03 * i) for i in (1, 2, 3)))
    y, before = np.zeros_like(t), 0.0
    for i, level in enumerate(levels, start=1):
        after = t >= 4.0 * i
        y[after], before = level + (before - level) * np.exp(-8 * (t[after] - 4.0 * i)), level
    got = fit_static_gain(record(t, u, y[None]), cart=1)
    gains = np.diff([0.0, *levels]) / 0.03
    assert_allclose(got.gain, gains.mean(), rtol=0.03)
    assert_allclose(got.gain_std, np.std(gains, ddof=1) / np.sqrt(3), rtol=0.3)


# ----------------------------------------------------------------------- friction


def sticking(t, *, rests, levels=(0.0, 0.9, 0.0)):
    """Return exponential moves that end off their levels by the values of `rests`."""
    y = np.full_like(t, rests[0])
    for edge, level, miss in zip((1.0, 6.0), levels[1:], rests[1:], strict=True):
        after = t >= edge
        y[after] = (level + miss) + (y[after][0] - level - miss) * np.exp(-4 * (t[after] - edge))
    return y


def test_a_cart_that_sticks_gets_an_interval():
    """If a cart sticks, its gain gets an interval that contains the gain without friction."""
    t = seconds(11.0)
    u = staircase(t, (1.0, 0.03), (6.0, 0.0))
    got = fit_static_gain(record(t, u, sticking(t, rests=(0.0, -0.01, 0.03))[None]), cart=1)
    assert got.rest_shift is not None
    assert_allclose(got.rest_shift, 0.03, atol=COUNT)
    assert got.interval is not None
    low, high = got.interval
    assert low < 30.0 < high
    assert low < got.gain < high
    assert "where it began" in got.note
    # The gains of the two edges differ because of the shift; the standard error includes this.
    assert got.gain_std > 0.4 * 0.03 / 0.03 / 2


def test_a_step_too_small_to_move_the_cart_is_not_used():
    """If friction holds the cart at an edge, a note names the edge, and the edge is not used."""
    t = seconds(11.0)
    u = staircase(t, (1.0, 0.03), (6.0, 0.035))
    got = fit_static_gain(
        record(t, u, sticking(t, rests=(0.0, 0.0, 0.0), levels=(0, 0.9, 0.9))[None]), cart=1
    )
    assert_allclose(got.gain, 30.0, atol=COUNT / 0.03)
    assert "did not move" in got.note
    assert got.interval is not None


# ----------------------------------------------------------------------- refused


T = seconds(8.0)
STEP = staircase(T, (0.5, 0.03), (4.0, 0.0))
RIGID = Chain(m=np.array([3e-4]), c=np.array([1e-3]), k=np.zeros(2))


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (replace(record(T, STEP, STEP[None]), u=None), "needs the input"),
        *(
            (run_of(PRESETS["throne-1dof"], T, u), "needs an input that steps and then stays")
            for u in (0 * T, 0.03 * np.sin(9 * T), 0.01 * T)
        ),
        (replace(record(T, STEP, STEP[None]), free=(2,)), "cart 1 is held"),
        (record(T, STEP, 0 * T[None]), "cart 1 does not move"),
        (record(T, STEP, COUNT * (STEP > 0)[None]), "move by more than 6 encoder steps"),
        (run_of(RIGID, T, staircase(T, (0.5, 0.01))), "cart 1 settles, found no such edge"),
    ],
)
def test_what_gives_no_gain_is_refused(run, message):
    """Without an input that steps, or a free cart that moves and settles, there is no gain."""
    with pytest.raises(DataError, match=message):
        fit_static_gain(run, cart=1)


# -------------------------------------------------------------------- real carts


def test_real_steps_agree_within_their_spread(real_data, tmp_path):
    """The gains of the real two-cart steps 2 to 5 agree within 5 %.

    Friction shifts the rest position by less than 10 counts.
    """
    folder = write_two_cart_submission(tmp_path / "two", real_data, steps=(2, 3, 4, 5))
    runs = [r for r in read_data(load_submission(folder)).records if r.id.startswith("both")]
    for cart, truth in ((1, 560.0), (2, 550.0)):  # in counts per volt
        got = [fit_static_gain(run, cart=cart) for run in runs]
        assert_allclose([abs(g.gain) for g in got], truth, rtol=0.05)
        assert all(g.rest_shift is not None and abs(g.rest_shift) < 10 for g in got)
        assert any(g.interval is not None for g in got)


def test_a_real_repeat_that_sticks_has_a_wide_interval(real_data, tmp_path):
    """In the first real repeat, cart 2 stops 32 counts from its rest position.

    The interval of its gain shows this.
    """
    folder = write_two_cart_submission(tmp_path / "two", real_data, steps=(1,))
    run = next(r for r in read_data(load_submission(folder)).records if r.id == "both-1")
    got = fit_static_gain(run, cart=2)
    assert got.rest_shift is not None
    assert abs(abs(got.rest_shift) - 32) < 1
    assert got.interval is not None
    assert got.interval[1] - got.interval[0] > 100
