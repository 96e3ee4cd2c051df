"""A free decay gives damping, frequency and dry friction, and its start is found."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from pipeline.errors import DataError
from pipeline.estimation.decay import fit_log_decrement
from pipeline.identify.model_checks import check_decays
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ExperimentKind
from pipeline.setup import Setup
from pipeline.submission import load_submission
from tests.helpers.time_records import COUNT, record_of
from tests.helpers.ucsd import write_two_cart_submission

FS = 113.1  # Hz, the usual sampling rate of the ECP 210
OMEGA, RELEASE = 20.0, 0.4  # rad/s, s


def held_then_free(t, *, zeta, omega_n=OMEGA, start=1.2, release=RELEASE, d=0.0):
    """Return the exact motion of a cart held at `start` and released, with friction band d = F/k.

    In each half cycle the cart oscillates about a point at distance d from its rest position. It
    stops if it turns within d of the rest position.
    """
    omega_d, decay = omega_n * np.sqrt(1 - zeta**2), zeta * omega_n
    half = np.pi / omega_d
    y, turning = np.full_like(t, start), start
    for k in range(int((t[-1] - release) / half) + 1):
        now = t >= release + k * half
        if abs(turning) <= d:
            y[now] = turning
            break
        middle, tau = np.copysign(d, turning), t[now] - release - k * half
        swing = np.cos(omega_d * tau) + decay / omega_d * np.sin(omega_d * tau)
        y[now] = middle + (turning - middle) * np.exp(-decay * tau) * swing
        turning = middle - (turning - middle) * np.exp(-decay * half)
    return y


def record(t, y, *, u=None, kind: ExperimentKind = "decay", count=COUNT):
    return record_of(t, u, np.asarray(y)[None], kind=kind, count=count, id="decay")


def released(*, zeta, fs=FS, duration=None, count=COUNT, noise=0.0, rng=None, **motion):
    """Return a record of a release by hand that lasts 4.5 time constants, but at most 10 s."""
    t = np.arange(0, duration or RELEASE + min(4.5 / (zeta * OMEGA), 10.0), 1 / fs)
    y = held_then_free(t, zeta=zeta, **motion)
    if rng is not None:
        y = y + noise * rng.normal(size=t.size)
    return record(t, y, count=count)


# ---------------------------------------------------------- damping and frequency


@pytest.mark.parametrize("zeta", [0.01, 0.03, 0.07, 0.15])
@pytest.mark.parametrize("fs", [113.1, 333.0, 1000.0])
@pytest.mark.parametrize("start", [1.2, -0.8])
def test_recovers_the_damping_that_made_the_data(zeta, fs, start):
    """Damping is found to 0.2 % and frequency to 0.02 % at any usual damping and sampling rate."""
    got = fit_log_decrement(released(zeta=zeta, fs=fs, start=start), cart=1)
    assert_allclose(got.zeta, zeta, rtol=2e-3)
    assert_allclose(got.omega_n, OMEGA, rtol=2e-4)
    # Each turning point is rounded by 0.29 count rms. At ζ = 0.15 there are only six, and the
    # smallest, of 4 counts, moves by 0.07 rad of the 19 rad in between.
    assert_allclose(got.zeta_peaks, zeta, rtol=1e-2)
    assert_allclose(got.omega_n_peaks, OMEGA, rtol=4e-3)
    assert_allclose(got.delta, 2 * np.pi * zeta / np.sqrt(1 - zeta**2), rtol=1e-2)
    assert got.law.is_exponential
    assert got.note == ""


def test_an_exact_decay_is_fitted_exactly():
    """Without rounding, the exponential fit is exact, and the peaks are nearly exact."""
    got = fit_log_decrement(released(zeta=0.05, count=0.0), cart=1)
    assert_allclose([got.zeta, got.omega_n], [0.05, OMEGA], rtol=1e-9)
    assert_allclose(got.zeta_peaks, 0.05, rtol=2e-4)


@pytest.mark.parametrize("zeta", [0.3, 0.45, 0.6])
def test_heavy_damping_still_gives_an_answer(zeta):
    """A cart that oscillates only once or twice is fitted from its release on."""
    got = fit_log_decrement(released(zeta=zeta, duration=3.0), cart=1)
    assert_allclose(got.zeta, zeta, rtol=5e-3)
    assert_allclose(got.omega_n, OMEGA, rtol=5e-3)
    assert got.release < RELEASE + 0.05
    assert ("too few" in got.note) == (got.peak_t.size < 4)
    if got.peak_t.size < 4:  # the decrement comes from the exponential fit
        assert_allclose(got.zeta_peaks, got.zeta, rtol=1e-9)
        assert got.zeta_peaks_std > 0


def test_the_error_of_zeta_from_peaks_follows_from_that_of_the_decrement():
    """The error of `zeta` is that of δ times dζ/dδ."""
    got = fit_log_decrement(released(zeta=0.08, noise=COUNT, rng=np.random.default_rng(2)), cart=1)

    def zeta(delta: float) -> float:
        return delta / np.hypot(2 * np.pi, delta)

    slope = (zeta(got.delta + 1e-4) - zeta(got.delta - 1e-4)) / 2e-4
    assert_allclose(got.zeta_peaks_std, slope * got.delta_std, rtol=1e-6)


def test_the_figure_shows_the_fit_within_its_envelope():
    """In the figure, the decay stays within its envelope, and both have the same times."""
    got = fit_log_decrement(released(zeta=0.05), cart=1)
    assert got.fit_t.shape == got.fit_y.shape == got.envelope_upper.shape
    assert np.all(got.fit_y <= got.envelope_upper + 1e-9)
    assert np.all(got.fit_y >= got.envelope_lower - 1e-9)
    assert got.fit_t[0] == got.release
    # Turning points are on the exponential, which is below the envelope by zeta²/2.
    inside = np.interp(got.peak_t, got.fit_t, got.fit_y)
    assert_allclose(got.peak_y, inside, atol=COUNT)
    assert got.amplitude.size == got.peak_t.size - 2
    assert_allclose(got.zeta_at_amplitude[1][:6], 0.05, rtol=0.05)


# ----------------------------------------------------------- finding the decay


EVEN, LONGER, LONG = (np.arange(0, seconds, 1 / FS) for seconds in (4, 5, 6))
TOUCH = np.where(LONGER > 2.5, np.sin(9 * (LONGER - 2.5)), 0.0)
UNEVEN = np.sort(EVEN + np.random.default_rng(2).uniform(-0.3, 0.3, size=453) / FS)
GAP = np.delete(UNEVEN, np.arange(100, 120))
NOISE = 1e-3 * np.random.default_rng(0).normal(size=EVEN.size)
AS_RECORDED = {
    # name: times, release, what is added to the motion, input
    "held for long": (LONG, 1.7, 0.0, None),
    "begun at the release": (EVEN, -0.1, 0.0, None),
    "touched afterwards": (LONGER, 0.4, TOUCH, None),
    "noise in the input": (EVEN, 0.4, 0.0, NOISE),
    "a drifting rest point": (EVEN, 0.4, 0.4 + 0.02 * EVEN, None),
    "a fast drift": (EVEN, 0.4, 0.4 - 0.2 * EVEN, None),
    "an uneven clock with a gap": (GAP, 0.4, 0.0, None),
}


@pytest.mark.parametrize("name", AS_RECORDED)
def test_the_decay_is_found_in_what_was_recorded(name):
    """Holds, touches, drifts, an uneven clock and a noisy input do not change the damping."""
    t, release, more, u = AS_RECORDED[name]
    y = held_then_free(t, zeta=0.05, release=release) + more
    got = fit_log_decrement(record(t, y, u=u), cart=1)
    assert_allclose(got.zeta, 0.05, rtol=3e-3)
    assert max(release, 0.0) <= got.release < max(release, 0.0) + 0.05
    assert got.peak_t[-1] < 2.6 or name != "touched afterwards"


@pytest.mark.parametrize("hand", [12.0, 18.0, 20.0, 25.0])
def test_a_hand_that_moves_the_cart_before_the_release_is_left_out(hand):
    """If a hand moves the cart to and fro before the release, only the later motion is fitted."""
    t, zeta, release = np.arange(0, 6, 1 / FS), 0.04, 1.9
    decay, omega_d = zeta * OMEGA, OMEGA * np.sqrt(1 - zeta**2)
    x0 = 0.8 * np.sin(hand * release)
    v0 = 0.8 * (np.sin(hand * release) / release + hand * np.cos(hand * release))
    tau = np.maximum(t - release, 0.0)
    swing = x0 * np.cos(omega_d * tau) + (v0 + decay * x0) / omega_d * np.sin(omega_d * tau)
    y = np.where(t < release, 0.8 * t / release * np.sin(hand * t), np.exp(-decay * tau) * swing)
    got = fit_log_decrement(record(t, y), cart=1)
    assert_allclose(got.zeta, zeta, rtol=2e-3)
    assert got.release > release - 0.06


@pytest.mark.parametrize("on_off", [True, False])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_ring_down_of_a_step_is_a_decay(on_off, sign):
    """The ring-down after an edge of a step is used as a decay about the new rest position."""
    chain, t = PRESETS["throne-1dof"], np.arange(0, 8, 1 / FS)
    u = sign * 0.03 * ((t > 0.5) & ((t < 4.0) | (not on_off)))
    run = record(t, simulate_linear(chain, t, u)[0], u=u, kind="step")
    got = fit_log_decrement(run, cart=1)
    assert_allclose(got.zeta, chain.zeta_carts[0], rtol=2e-3)
    assert_allclose(got.omega_n, chain.omega_carts[0], rtol=2e-4)
    assert got.release >= (4.0 if on_off else 0.5)
    assert ("an input of" in got.note) != on_off


def test_the_driven_part_of_a_decay_is_left_out():
    """If the motor started the cart, the decay begins when the input is zero."""
    chain, t = PRESETS["throne-1dof"], np.arange(0, 8, 1 / FS)
    u = 0.03 * np.sin(14 * t) * (t < 3.0)
    got = fit_log_decrement(record(t, simulate_linear(chain, t, u)[0], u=u), cart=1)
    assert 3.0 <= got.release < 3.2
    assert_allclose(got.zeta, chain.zeta_carts[0], rtol=2e-3)


# ----------------------------------------------------------------- dry friction


@pytest.mark.parametrize(
    ("zeta", "d"),
    [*product([0.01, 0.05, 0.1], [0.002, 0.01, 0.03]), *((0.05, d) for d in (0.08, 0.11, 0.15))],
)
def test_dry_friction_and_viscous_damping_are_separated(zeta, d):
    """Friction and viscous damping are found, even if friction stops the cart after few swings."""
    stops = d > 0.05
    rng = np.random.default_rng(8) if stops else None
    run = released(zeta=zeta, d=d, duration=5.0 if stops else 4.0, noise=COUNT, rng=rng)
    got = fit_log_decrement(run, cart=1)
    law = got.law
    assert law.is_friction
    # Without noise there is rounding; with it, one standard error is 0.5 to 4 % of d.
    assert abs(law.size - d) < (3 if stops else 4) * law.size_std + 1e-5
    assert_allclose(law.size, d, rtol=0.03 if stops else 0.15)
    if stops:
        assert_allclose(law.zeta, zeta, rtol=0.05)
        return
    assert abs(law.zeta - zeta) < 4 * law.zeta_std + 1e-5
    assert got.zeta > law.zeta  # a viscous fit needs more damping
    # Small oscillations lose more to friction, so their damping is larger.
    local = got.zeta_at_amplitude
    assert local[1, local[0].argmin()] > local[1, local[0].argmax()]


# ------------------------------------------------------------------- other laws


def swinging(force, *, seed, fs=200.0, duration=8.0, start=1.2):
    """Return a record of x'' = force(x, x') after a release, with half a count of noise.

    Without a `seed`, it is exact.
    """
    t = np.arange(0.0, duration, 1 / fs)
    motion = solve_ivp(
        lambda _, x: [x[1], force(*x)],
        (0.0, duration),
        [start, 0.0],
        t_eval=t,
        rtol=1e-9,
        atol=1e-9,
    )
    if seed is None:
        return record(t, motion.y[0], count=0.0)
    noise = np.random.default_rng(seed).normal(size=t.size)
    return record(t, motion.y[0] + 0.5 * COUNT * noise)


def beating(share, *, seed, other=17.0, lasting=1.0):
    """Return a record of two modes, the first with ζ = 0.012 and 15 rad/s.

    `lasting` is the damping ratio of the first mode, in that of the second.
    """
    t = np.arange(0.0, 8.0, 0.005)
    modes = [
        size * np.exp(-zeta * omega * t) * np.cos(omega * t)
        for size, omega, zeta in ((1.0, 15.0, 0.012), (share, other, 0.012 / lasting))
    ]
    return record(
        t, sum(modes) + 1e-3 * np.random.default_rng(seed).normal(size=t.size), count=1e-5
    )


@pytest.mark.parametrize(
    ("share", "other", "lasting"),
    [
        *((share, other, 1.0) for share in (0.05, 0.6) for other in (12.5, 17.0)),
        *((share, other, 1.0) for share in (0.2, 0.5) for other in (11.0, 20.0)),  # few periods
        *((share, other, 2.0) for share in (0.15, 0.25) for other in (21.5, 23.25)),  # like noise
    ],
)
def test_a_second_mode_is_named_and_left_out(share, other, lasting):
    """If a second mode beats with the first, the numbers are those of the first mode alone."""
    got = fit_log_decrement(beating(share, seed=7, other=other, lasting=lasting), cart=1)
    assert got.law.name == "second_mode"
    assert got.law.statistic > got.law.limit
    assert_allclose(got.law.size, other, rtol=5e-3)
    assert_allclose(got.omega_n, 15.0, rtol=2e-3)
    assert_allclose(got.zeta, 0.012, rtol=0.06)
    assert (got.law.zeta, got.law.omega_n) == (got.zeta, got.omega_n)


@pytest.mark.parametrize("drag", [0.01, 0.05, 0.3])
@pytest.mark.parametrize("zeta", [0.001, 0.02])
def test_quadratic_drag_is_named_and_left_out(drag, zeta):
    """If quadratic drag damps a decay, the drag and the viscous damping are found."""

    def force(x, v):
        return -(OMEGA**2) * x - 2 * zeta * OMEGA * v - drag * v * abs(v)

    got = fit_log_decrement(swinging(force, seed=4), cart=1)
    assert got.law.name == "quadratic_drag"
    # The law is a first approximation in drag * amplitude, of at most 0.36.
    assert abs(got.law.size - drag) < 4 * got.law.size_std + 0.02 * drag
    assert_allclose(got.omega_n, OMEGA, rtol=1e-3)
    assert abs(got.zeta - zeta) < 4 * got.zeta_std + 1e-4


@pytest.mark.parametrize(("periods", "outcome"), [(1.0, "skip"), (3.0, "pass")])
def test_a_decay_of_few_swings_is_not_called_exponential(periods, outcome):
    """If strong drag would not show either, the check neither passes nor fails."""
    t = np.arange(0.0, periods * 2 * np.pi / OMEGA, 0.01)
    y = 1.2 * np.exp(-0.05 * OMEGA * t) * np.cos(OMEGA * t)
    decay = fit_log_decrement(record(t, y), cart=1)
    (check,) = check_decays([decay], bench=Setup(springs=(True, True)))
    assert check.outcome == outcome
    assert ("too few swings" in check.message) == (outcome == "skip")


def stiffening(shift, *, noise, seed, duration):
    """Return a record of a cubic spring and its exact relative shift of frequency at the release.

    `shift` is the first approximation of that shift.
    """
    k = shift / (3 / 8 * 1.2**2)
    exact = swinging(
        lambda x, v: -(OMEGA**2) * (x + k * x**3) - 2 * 0.01 * OMEGA * v,
        seed=None,
        duration=duration,
    )
    # The exact period of the undamped swing, by its energy.
    angle = np.linspace(0.0, np.pi / 2, 2001)
    slowness = 1 / np.sqrt(1 + k * 1.2**2 * (1 + np.sin(angle) ** 2) / 2)
    period_share = float(np.mean((slowness[1:] + slowness[:-1]) / 2))
    y = exact.y[0] + noise * COUNT * np.random.default_rng(seed).normal(size=exact.t.size)
    return record(exact.t, y), 1 / period_share - 1


@pytest.mark.parametrize("shift", [-0.03, 0.02, 0.054, 0.1])
def test_the_size_of_a_shift_is_right(shift):
    """The change of frequency at the release is right up to the square of the shift.

    The law has all terms of the first order, so only those are left. A tenth of the square is also
    what the frequency of small swings may be off, and the square what the damping may.
    """
    run, size = stiffening(shift, noise=0.5, seed=5, duration=8.0)
    law = fit_log_decrement(run, cart=1).law
    assert law.name == "frequency_shift"
    assert_allclose(law.size, size, atol=shift**2)
    assert_allclose(law.omega_n, OMEGA, rtol=0.1 * shift**2 + 1e-5)
    assert_allclose(law.zeta, 0.01, rtol=shift**2 + 1e-3)
    assert abs(law.size - size) < law.size_std


def test_a_rest_point_that_creeps_is_a_drift():
    """If the rest point creeps at a falling speed, the drift is named and left out."""
    run = released(zeta=0.02, duration=8.0, noise=0.5 * COUNT, rng=np.random.default_rng(6))
    creep = 0.05 * np.exp(-run.t / 3.0)
    got = fit_log_decrement(replace(run, y=run.y + creep), cart=1)
    assert got.law.name == "drift"
    assert_allclose([got.zeta, got.omega_n], [0.02, OMEGA], rtol=3e-3)


def test_what_no_law_explains_is_unknown_and_widens_the_errors():
    """If no law explains a decay, the status says so, and the standard errors cover the change."""
    t = np.arange(0.0, 8.0, 0.005)
    # A finger takes a quarter of the swing for half a second, and gives it back.
    y = 1.2 * np.exp(-0.2 * t - 0.3 * np.exp(-20 * (t - 3.0) ** 2)) * np.cos(20.0 * t)
    got = fit_log_decrement(record(t, y), cart=1)
    assert got.law.name == "unknown"
    assert got.law.statistic > got.law.limit
    assert abs(got.zeta - 0.01) < 2 * got.zeta_std
    assert np.isnan(got.law.size)


# ---------------------------------------------------------------- standard errors


def flags(seeds, *, d):
    """Return, for each random decay with friction band d, whether dry friction is found."""
    found = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        run = released(
            zeta=rng.uniform(0.01, 0.2),
            d=d,
            omega_n=rng.uniform(12, 35),
            start=rng.choice([-1, 1]) * rng.uniform(0.7, 1.8),
            fs=rng.choice([113.1, 250.0]),
            duration=rng.uniform(2.0, 5.0),
            noise=rng.choice([0.0, 0.2, 0.5]) * COUNT,
            rng=rng,
        )
        found.append(fit_log_decrement(run, cart=1).law.is_friction)
    return np.array(found)


@pytest.mark.slow
@pytest.mark.sample
def test_friction_is_found_only_if_there_is_some():
    """Dry friction is found in all of twenty decays with d = 0.01 cm, and in none without it."""
    assert not flags(20, d=0.0).any()
    assert flags(20, d=0.01).all()


def standardised(seeds):
    """Return the errors of (ζ, ω_n, ζ by peaks), divided by their standard errors.

    The decays have noise and rounding.
    """
    errors = []
    for seed in range(seeds):
        rng = np.random.default_rng(1000 + seed)
        zeta, omega_n = rng.uniform(0.01, 0.15), rng.uniform(12, 35)
        noise = rng.choice([0.2, 0.5, 1.0]) * COUNT
        run = released(zeta=zeta, omega_n=omega_n, noise=noise, rng=rng)
        got = fit_log_decrement(run, cart=1)
        errors.append(
            [
                (got.zeta - zeta) / got.zeta_std,
                (got.omega_n - omega_n) / got.omega_n_std,
                (got.zeta_peaks - zeta) / got.zeta_peaks_std,
            ]
        )
    return np.array(errors)


@pytest.mark.slow
@pytest.mark.sample
def test_the_standard_errors_are_about_right():
    """Over 60 noisy decays, actual errors are about as large as the standard errors."""
    spread = np.sqrt(np.mean(standardised(60) ** 2, axis=0))
    assert np.all((0.65 < spread[:2]) & (spread[:2] < 1.35))  # the limits are 1 ± 4/sqrt(120)
    assert spread[2] < 1.35


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("name", ["second_mode", "frequency_shift"])
def test_the_standard_errors_of_a_law_are_about_right(name):
    """Over 40 noisy decays, the errors of a law's numbers are as large as their standard errors.

    The root mean square is 1 ± 4/sqrt(80). The error of neglected terms is stated too; here it is
    small.
    """
    errors = []
    for seed in range(40):
        if name == "second_mode":
            run = beating(0.2, seed=seed)
            # Decay rate 0.18 and damped frequency 15 rad/s; the size is a damped frequency too.
            truth = [0.18 / np.hypot(0.18, 15.0), np.hypot(0.18, 15.0), 17.0]
        else:
            run, size = stiffening(0.01, noise=8.0, seed=seed, duration=4.0)
            truth = [0.01, OMEGA, size]
        law = fit_log_decrement(run, cart=1).law
        assert law.name == name
        found = np.array([law.zeta, law.omega_n, law.size])
        errors.append((found - truth) / [law.zeta_std, law.omega_n_std, law.size_std])
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all((0.55 < spread) & (spread < 1.45))


# ----------------------------------------------------------------------- errors


T = np.arange(0, 4, 1 / FS)


@pytest.mark.parametrize(
    ("t", "y", "needed"),
    [
        (T, 0 * T, "3 turning points"),
        (T, T, "3 turning points"),
        (T, np.where(T < RELEASE, 1.2, np.nan)[0] + 0 * T, "3 turning points"),  # never released
        (T, np.sin(9 * T), "a decaying oscillation of cart 1"),
        *((T[:n], np.cos(20 * T[:n]), "3 turning points") for n in (1, 2, 6, 7, 12)),
    ],
)
def test_what_is_no_decay_is_refused(t, y, needed):
    """Rest, a ramp, a hold, a steady sine and a handful of samples are refused."""
    with pytest.raises(DataError, match=f"^decay: .* needs {needed}"):
        fit_log_decrement(record(t, y), cart=1)


# -------------------------------------------------------------------- real carts


@pytest.fixture(scope="module")
def real_records(real_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("decays") / "two"
    write_two_cart_submission(folder, real_data, steps=())
    return {r.id: r for r in read_data(load_submission(folder)).records}


@pytest.mark.parametrize("repeat", range(1, 6))
def test_both_edges_of_real_steps_give_the_damping_of_cart_1(real_records, repeat):
    """Both edges of a real step of cart 1 give its damping.

    The damping is larger while the motor holds the cart.
    """
    run = real_records[f"alone-1-{repeat}"]
    off = fit_log_decrement(run, cart=1)
    assert 23.2 <= off.omega_n <= 23.7
    assert_allclose(off.zeta, 0.139, rtol=0.1)
    first = run.t < 2.9
    on = replace(run, t=run.t[first], u=run.u[first], y=run.y[:, first])
    assert_allclose(fit_log_decrement(on, cart=1).zeta, 0.155, rtol=0.1)


@pytest.mark.parametrize("repeat", range(1, 6))
def test_friction_is_found_in_real_decays_of_cart_2(real_records, repeat):
    """In each real decay of cart 2, dry friction and little viscous damping are found."""
    got = fit_log_decrement(real_records[f"alone-2-{repeat}"], cart=2)
    assert 15.6 <= got.omega_n <= 15.9
    assert got.law.is_friction
    assert 0.02 <= got.law.zeta <= 0.035
    assert 24 <= got.law.size <= 34  # encoder counts
    assert 0.06 <= got.zeta <= 0.08


def test_a_random_walk_is_a_decay_or_refused():
    """Readings that drift at random never stop the program, although no law fits them."""
    t, refused = np.arange(600) / 113.1, 0
    for seed in range(30):
        y = np.cumsum(np.random.default_rng(seed).normal(0, 10, t.size))
        try:
            fit_log_decrement(record(t, COUNT * y), cart=1)
        except DataError:
            refused += 1
    assert refused > 15
