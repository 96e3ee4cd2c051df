"""Amplitude, phase, frequency and the start of the steady part of a dwell are found."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.errors import DataError
from pipeline.estimation.sine import Dwell
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import simulate_linear
from tests.helpers.time_records import COUNT, record_of

CHAIN = PRESETS["throne-1dof"]
FS = 113.1  # Hz, the usual sampling rate of the ECP 210


def dwell(t, *, hertz=3.0, amplitude=1.0, chain=CHAIN, noise=0.0, count=COUNT, rng=None):
    """Return a dwell from rest that moves cart 1 by about `amplitude`, and the true response."""
    omega = 2 * np.pi * hertz
    truth = chain.frequency_response(np.array([omega]))[:, 0]
    half = omega * np.mean(np.diff(t)) / 2  # holding a sine reduces it by sin(half)/half
    u = amplitude / abs(truth[0]) * half / np.sin(half) * np.sin(omega * t)
    y = simulate_linear(chain, t, u)
    if rng is not None:
        y = y + noise * rng.normal(size=y.shape)
    return record_of(t, u, y, kind="sine", omega=omega, count=count), truth


def cut(run, keep):
    """Return the run with only some of its samples."""
    assert run.u is not None
    return replace(run, t=run.t[keep], u=run.u[keep], y=run.y[:, keep])


def sampled(duration, *, fs=FS):
    return np.arange(0, duration, 1 / fs)


@pytest.mark.parametrize("hertz", [0.8, 2.09, 3.0, 6.0])
@pytest.mark.parametrize("fs", [113.1, 500.0])
def test_one_centimetre_is_measured_to_half_a_per_mille(hertz, fs):
    """A settled dwell of 1 cm gives amplitude, gain and phase to 0.0005, even at resonance."""
    run, truth = dwell(sampled(9.0, fs=fs), hertz=hertz)
    got = Dwell(run).fit(cart=1)
    assert got.settled
    assert got.note == ""
    # The rounding of 200 or more samples causes 0.29 count · sqrt(2/200), or 7e-5 of 440 counts;
    # the rest of a transient at resonance adds up to 3e-4.
    assert_allclose(got.amplitude, 1.0, rtol=5e-4)
    assert_allclose(got.gain, abs(truth[0]), rtol=5e-4)
    assert_allclose(got.phase, np.angle(truth[0]), atol=5e-4)


def test_a_smooth_input_is_taken_as_sampled():
    """A band-limited input has the amplitude of its sampled sine."""
    t, omega = sampled(4.0), 2 * np.pi * 5.0
    y = np.sin(omega * t - 1.0)[None]
    run = record_of(t, 0.5 * np.sin(omega * t), y, kind="sine", omega=omega, count=0.0)
    got = Dwell(replace(run, hold="band_limited")).fit(cart=1)
    assert_allclose([got.input_amplitude, got.amplitude, got.phase], [0.5, 1.0, -1.0], rtol=1e-9)


def test_every_cart_of_a_chain_has_its_own_amplitude_and_phase():
    """Each cart of a chain gets its own amplitude and phase, even beyond a phase of π."""
    run, truth = dwell(sampled(12.0), chain=PRESETS["throne-3dof"], hertz=3.0)
    for cart in (1, 2, 3):
        got = Dwell(run).fit(cart=cart)
        assert_allclose(got.gain, abs(truth[cart - 1]), rtol=2e-3)
        assert_allclose(np.exp(1j * got.phase), np.exp(1j * np.angle(truth[cart - 1])), atol=2e-3)


def test_the_transient_is_left_out():
    """The steady part begins when the transient from rest has died away."""
    run, _ = dwell(sampled(9.0), hertz=3.0)
    got = Dwell(run).fit(cart=1)
    # The transient of 1 cm e^(-1.32 t) is one encoder step at 4.6 s.
    assert 3.0 < got.steady_from < 7.0
    # The last cycle is used up to 30 degrees before its end, which is 0.03 s at 3 Hz.
    assert 0 <= np.count_nonzero(run.t >= got.steady_from) - got.n_points <= 4


JITTER = np.random.default_rng(3).uniform(-0.3, 0.3, size=1018) / FS
CLOCKS = {
    "jittered": np.sort(sampled(9.0) + JITTER),
    "rounded": np.unique(np.round(sampled(9.0), 3)),
}


@pytest.mark.parametrize("spoilt", ["jittered", "rounded", "gap", "drift", "no frequency"])
def test_what_often_happens_to_a_dwell_does_no_harm(spoilt):
    """Uneven times, a gap, a drift and a missing frequency change neither gain nor frequency."""
    run, truth = dwell(CLOCKS.get(spoilt, sampled(9.0)), hertz=3.0)
    if spoilt == "gap":
        run = cut(run, np.delete(np.arange(run.t.size), np.arange(800, 840)))
    elif spoilt == "drift":
        run = replace(run, y=COUNT * np.round((run.y + 0.7 + 0.02 * run.t) / COUNT))
    elif spoilt == "no frequency":
        run = replace(run, omega=None)
    got = Dwell(run).fit(cart=1)
    assert_allclose(got.omega, 2 * np.pi * 3.0, rtol=1e-9)  # the input has no noise
    # The input is held for uneven times too.
    assert_allclose(got.gain, abs(truth[0]), rtol=2e-3 if spoilt in CLOCKS else 5e-4)


def test_a_stated_frequency_that_the_input_contradicts_is_not_used():
    """If the stated frequency contradicts the input, the input's own frequency is used.

    The cause may be rad/s typed for Hz, or a wrong clock.
    """
    run, truth = dwell(sampled(9.0), hertz=3.0)
    got = Dwell(replace(run, omega=2 * np.pi * 3.0 * 1.01)).fit(cart=1)
    assert_allclose(got.omega, 2 * np.pi * 3.0, rtol=1e-6)
    assert_allclose(got.gain, abs(truth[0]), rtol=5e-4)
    assert "stated 3.03 Hz" in got.note


def test_with_a_noisy_input_the_stated_frequency_is_used():
    """If the logged input is noisy, the stated frequency is still used."""
    rng = np.random.default_rng(4)
    run, truth = dwell(sampled(9.0), hertz=3.0)
    assert run.u is not None
    noisy = run.u + 0.05 * np.ptp(run.u) * rng.normal(size=run.t.size)
    got = Dwell(replace(run, u=noisy)).fit(cart=1)
    assert got.omega == run.omega
    assert abs(got.gain - abs(truth[0])) < 4 * got.gain_std
    assert got.input_amplitude_std > 1e-3 * got.input_amplitude


def test_an_input_that_stops_ends_the_dwell():
    """Samples before the start or after the end of the input are not used."""
    t, omega = sampled(14.0), 2 * np.pi * 3.0
    truth = CHAIN.frequency_response(np.array([omega]))[0, 0]
    u = np.where((t > 1.0) & (t < 10.0), np.sin(omega * t) / abs(truth), 0.0)
    run = record_of(t, u, simulate_linear(CHAIN, t, u), kind="sine", omega=omega)
    got = Dwell(run).fit(cart=1)
    assert got.settled
    assert got.steady_from + (got.n_points - 1) / FS < 10.0
    assert_allclose(got.gain, abs(truth), rtol=5e-4)


def test_a_dwell_that_is_too_short_is_called_unsettled():
    """If the transient has not died away, a note says so and the estimate has a large error."""
    run, truth = dwell(sampled(1.6), hertz=2.4)
    got = Dwell(run).fit(cart=1)
    assert not got.settled
    assert "no steady state" in got.note
    assert abs(got.gain - abs(truth[0])) < 5 * got.gain_std


def test_an_amplitude_of_few_counts_is_noted():
    """If the amplitude is below twenty encoder counts, a note says so."""
    run, _ = dwell(sampled(9.0), amplitude=10 * COUNT)
    got = Dwell(run).fit(cart=1)
    assert "10.0 encoder counts" in got.note
    assert_allclose(got.amplitude, 10 * COUNT, rtol=0.02)


def test_a_phase_in_noise_has_the_error_of_a_random_angle():
    """If a cart does not follow the input, its phase has at most the error of a random angle."""
    t, omega = sampled(4.0), 2 * np.pi * 3.0
    noise = np.random.default_rng(1).standard_normal((1, t.size))
    run = record_of(t, np.sin(omega * t), noise, kind="sine", omega=omega, count=0.0)
    got = Dwell(run).fit(cart=1)
    assert got.amplitude < got.amplitude_std
    assert_allclose(got.phase_std, np.pi / np.sqrt(3), rtol=1e-12)


def test_a_third_harmonic_is_noted():
    """If friction adds a third harmonic, a note gives its size."""
    t, omega = sampled(6.0), 2 * np.pi * 3.0
    y = (np.sin(omega * t) + 0.05 * np.sin(3 * omega * t))[None]
    got = Dwell(record_of(t, np.sin(omega * t), y, kind="sine", omega=omega)).fit(cart=1)
    assert "3.5 %" in got.note  # 0.05 / sqrt(2)
    assert_allclose(got.amplitude, 1.0, rtol=1e-3)


T = sampled(5.0)
NOISE = np.random.default_rng(0).normal(size=T.size)


@pytest.mark.parametrize(
    ("change", "needed"),
    [
        ({"u": None}, "the input as well as the positions"),
        ({"u": 0 * T}, "an input that oscillates"),
        ({"u": NOISE, "y": NOISE[None]}, "an input of one frequency"),
        ({"y": 0 * T[None]}, "motion, cart 1 does not move"),
        ({"t": T[:56], "u": T[:56], "y": T[None, :56]}, "a full cycle"),
    ],
)
def test_what_is_no_dwell_is_refused(change, needed):
    """A run without input, oscillation, motion or a full cycle is refused."""
    run, _ = dwell(T, hertz=1.0)
    with pytest.raises(DataError, match=needed):
        Dwell(replace(run, **change)).fit(cart=1)


def coverage(seeds, *, from_rest):
    """Return the errors of gain and phase, divided by their standard errors.

    The dwells are random, on benches of one to three carts.
    """
    errors = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        chain = PRESETS[f"throne-{1 + seed % 3}dof"]
        hertz = rng.uniform(0.7, 7.0)
        wait = 7 / np.min(-chain.poles.real)
        t = sampled(wait + max(7 / hertz, 1.6))
        run, truth = dwell(
            t,
            hertz=hertz,
            amplitude=rng.uniform(0.3, 1.5),
            chain=chain,
            noise=rng.choice([0.0, 0.2, 0.5]) * COUNT,
            rng=rng,
        )
        if not from_rest:
            run = cut(run, t > wait)
        got = Dwell(run).fit(cart=1)
        phase = np.angle(np.exp(1j * (got.phase - np.angle(truth[0]))))
        errors.append([(got.gain - abs(truth[0])) / got.gain_std, phase / got.phase_std])
    return np.array(errors)


def test_the_standard_errors_are_about_right():
    """Over 60 dwells, actual errors are about as large as the standard errors."""
    spread = np.sqrt(np.mean(coverage(60, from_rest=False) ** 2, axis=0))
    assert np.all((0.75 < spread) & (spread < 1.35))  # the limits are 1 ± 4/sqrt(120)


@pytest.mark.parametrize("size", [3.0, 10.0, 30.0])
def test_the_error_of_a_small_amplitude_is_that_of_its_rounding(size):
    """Over 40 exact sines of a few counts, errors of the amplitude are as its standard error."""
    errors, t = [], sampled(9.0)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        omega, amplitude = 2 * np.pi * rng.uniform(1.0, 3.0), size * COUNT * rng.uniform(1.0, 1.1)
        y = amplitude * np.sin(omega * t + rng.uniform(0.0, 6.0)) + COUNT * rng.uniform()
        got = Dwell(record_of(t, np.sin(omega * t), y[None], kind="sine", omega=omega)).fit(cart=1)
        errors.append((got.amplitude - amplitude) / got.amplitude_std)
    # Without the error of rounding, the spread is 1.7 to 3.8.
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.4
