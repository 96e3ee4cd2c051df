"""The frequency response is measured from dwells and records, with its peaks and nulls."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.frequency_response import (
    collect_dwells,
    find_resonances,
    response_from_records,
)
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ExperimentKind, FrequencyResponse, Hold, Record, SinePoint
from tests.helpers.time_records import COUNT, record_of

COUNT_NOISE = 0.00115  # cm, half an encoder count


def dwell(*, omega: float, gain: float, phase: float = -1.0) -> SinePoint:
    return SinePoint(
        experiment=f"sine-{omega:g}",
        cart=1,
        omega=omega,
        amplitude=0.1 * gain,
        amplitude_std=0.1 * 0.001,
        phase=phase,
        phase_std=0.01,
        input_amplitude=0.1,
        input_amplitude_std=0.0,
        steady_from=1.0,
        settled=True,
        n_points=100,
    )


def record(
    chain: Chain,
    t: Array,
    u: Array,
    *,
    kind: ExperimentKind = "step",
    noise: float = 0.0,
    hold: Hold = "zero_order",
) -> Record:
    """Simulate all carts of a chain with noise."""
    y = simulate_linear(chain, t, u, hold=hold)
    y = y + noise * np.random.default_rng(0).standard_normal(y.shape)
    return record_of(t, u, y, kind=kind, count=0.0, hold=hold)


def pulse(t: Array) -> Array:
    return np.where((t > 0.5) & (t < 10.0), 0.05, 0.0)


def chirp(t: Array) -> Array:
    """Return a sweep from 0.3 to 8 Hz over 20 s that stops at full amplitude."""
    return 0.2 * np.sin(2 * np.pi * (0.3 * t + 0.1925 * t**2))


def errors(chain: Chain, response: FrequencyResponse) -> Array:
    """Return real and imaginary parts of the response's errors, divided by the standard errors."""
    assert response.phase is not None
    measured = response.magnitude * np.exp(1j * response.phase)
    off = measured - chain.frequency_response(response.omega)[response.cart - 1]
    return np.concatenate([off.real, off.imag] / response.magnitude_std)


# ---------------------------------------------------------------------- dwells


HALF_TURN = np.deg2rad(179.0)


@pytest.mark.parametrize(
    ("dwells", "omega", "magnitude", "std", "phase"),
    [
        # in the order of frequency
        ([(20.0, 3.0, -1.0), (5.0, 2.0, -1.0)], [5, 20], [2, 3], [0.001] * 2, [1, 1]),
        # the error of two repeats is smaller by √2, or that of their scatter
        ([(5.0, 2.0, -1.0), (5.002, 2.0, -1.0)], [5], [2], [0.001 / np.sqrt(2)], [1]),
        ([(5.0, 1.95, -1.0), (5.002, 2.05, -1.0)], [5], [2], [0.05], [1]),
        # the mean of 179° and −179° is half a turn
        ([(5.0, 2.0, HALF_TURN), (5.0, 2.0, -HALF_TURN)], [5], [2], None, [np.pi]),
    ],
)
def test_dwells_become_points(dwells, omega, magnitude, std, phase):
    """Each frequency becomes one point with its gain, phase and error; repeats are combined."""
    (got,) = collect_dwells([dwell(omega=w, gain=g, phase=p) for w, g, p in dwells])

    assert_allclose(got.omega, omega, rtol=1e-3)
    assert_allclose(got.magnitude, magnitude, rtol=1e-12)
    if std is not None:
        assert_allclose(got.magnitude_std, std, rtol=1e-9)
    assert got.phase is not None
    assert_allclose(np.abs(got.phase), phase, rtol=1e-9)
    assert got.source == "dwells"


def test_dwells_without_an_input_are_refused():
    """A dwell without an input amplitude is refused, since a gain needs one."""
    with pytest.raises(DataError, match="sinusoidal input"):
        collect_dwells([replace(dwell(omega=5.0, gain=2.0), input_amplitude=0.0)])


# --------------------------------------------------------------------- records


@pytest.mark.parametrize("preset", PRESETS)
def test_a_step_record_gives_the_response_exactly(preset):
    """A noise-free step record that begins and ends at rest gives the exact frequency response."""
    chain = PRESETS[preset]
    t = np.arange(0, 20, 1 / 113)

    for response in response_from_records([record(chain, t, pulse(t))]):
        G = chain.frequency_response(response.omega)[response.cart - 1]
        assert response.phase is not None
        off = np.abs(response.magnitude * np.exp(1j * response.phase) - G)
        # The input is a straight line between samples. After the sinc² correction, aliases of y' ~
        # 1/s² remain, about (omega h / 2 pi)³: 6e-4 at 60 rad/s and h = 9 ms.
        low = response.omega < 60
        assert low.sum() > 50
        assert np.max(off[low] / np.abs(G[low])) < 1e-3


DRIVES = {
    "pulse": (np.arange(0, 20, 1 / 113), pulse, "step"),
    "stays on": (np.arange(0, 20, 1 / 113), lambda t: 0.05 + 0 * t, "step"),
    "fast": (np.arange(0, 20, 1 / 500), pulse, "step"),
    "negative": (np.arange(0, 20, 1 / 113), lambda t: -pulse(t), "step"),
    "chirp": (np.arange(0, 20, 1 / 113), chirp, "sweep"),
    "random": (
        np.arange(0, 20, 1 / 113),
        lambda t: 0.2 * np.random.default_rng(9).standard_normal(t.size),
        "sweep",
    ),
    "rounded time": (np.round(np.arange(0, 20, 1 / 113), 3), pulse, "step"),
}


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("preset", PRESETS)
def test_stated_errors_of_a_response_are_right(preset, drive):
    """With noise of half a count, the errors of a response hardly exceed the stated errors."""
    chain = PRESETS[preset]
    t, u, kind = DRIVES[drive]

    responses = response_from_records([record(chain, t, u(t), kind=kind, noise=COUNT_NOISE)])

    assert [r.cart for r in responses] == list(range(1, chain.n + 1))
    for response in responses:
        z = errors(chain, response)
        # The rms of 100 or more standardised errors is within 1 ± 0.2. The limit 1.4 allows for
        # errors of the local polynomials at a resonance. Stated errors may be too large, because
        # they include half a count at rest; below 0.1 they would be useless.
        assert 0.1 < np.sqrt(np.mean(z**2)) < 1.4
        assert response.omega.size > 50


@pytest.mark.parametrize("drive", ["chirp", "random"])
def test_errors_of_a_response_in_motion_are_not_stated_too_large(drive):
    """If a record begins and ends in motion, the spread of its response is the stated error."""
    t, u, kind = DRIVES[drive]
    chain = PRESETS["throne-1dof"]
    (response,) = response_from_records([record(chain, t, u(t), kind=kind, noise=COUNT_NOISE)])
    # The rms of 100 or more standardised errors is within 1 ± 0.2.
    assert 0.7 < np.sqrt(np.mean(errors(chain, response) ** 2)) < 1.25


@pytest.mark.parametrize("preset", PRESETS)
def test_rounding_alone_gives_the_stated_errors(preset):
    """Without noise, the errors of a response are those of the encoder's rounding, step/√12."""
    chain, (t, u, kind) = PRESETS[preset], DRIVES["pulse"]
    y = simulate_linear(chain, t, u(t))
    for response in response_from_records([record_of(t, u(t), y, kind=kind, count=COUNT)]):
        # The rms of 160 or more standardised errors is within 1 ± 0.17 (three sigma). Rounding is
        # not quite white where the carts rest.
        assert 0.7 < np.sqrt(np.mean(errors(chain, response) ** 2)) < 1.4


def test_a_band_limited_input_causes_no_false_phase():
    """A smooth sweep shows no false phase lag if its input is declared band-limited."""
    chain = PRESETS["throne-2dof"]
    t = np.arange(0, 20, 1 / 113)
    u = chirp(t) * np.clip((15 - t) / 2, 0, 1)

    response = response_from_records([record(chain, t, u, kind="sweep", hold="band_limited")])[0]

    G = chain.frequency_response(response.omega)[0]
    assert response.phase is not None
    lag = np.angle(np.exp(1j * (np.angle(G) - response.phase)))
    # Half a sample is 4.4 ms; ignoring it would cause 0.16 rad at 37 rad/s.
    inside = (response.omega > 3) & (response.omega < 38)
    assert np.max(np.abs(lag[inside])) < 0.01


@pytest.mark.parametrize(
    ("size", "message"), [(0.0, "needs a step or sweep with its input"), (1e-7, "above its noise")]
)
def test_records_without_an_input_or_motion_are_refused(size, message):
    """A record whose input never moves, or moves the carts less than the noise, is refused."""
    t = np.arange(0, 5, 0.01)
    still = record(PRESETS["throne-1dof"], t, size * pulse(t + 0.4), noise=COUNT_NOISE)
    with pytest.raises(DataError, match=message):
        response_from_records([still])


# ------------------------------------------------------------- peaks and nulls


def table(chain: Chain, omega: Array, *, noise: float = 0.0) -> tuple[FrequencyResponse, ...]:
    size = np.abs(chain.frequency_response(omega))
    rng = np.random.default_rng(3)
    return tuple(
        FrequencyResponse(
            cart=i + 1,
            omega=omega,
            magnitude=size[i] * (1 + noise * rng.standard_normal(omega.size)),
            magnitude_std=max(noise, 1e-3) * size[i],
            phase=None,
            phase_std=None,
            source="table",
        )
        for i in range(chain.n)
    )


@pytest.mark.parametrize("preset", PRESETS)
def test_peaks_and_nulls_are_found(preset):
    """From 40 points with 1 % noise, each resonance, null and gain is found near its true value."""
    chain = PRESETS[preset]
    omega = 2 * np.pi * np.geomspace(0.3, 7.0, 40)

    got = find_resonances(table(chain, omega, noise=0.01), n=chain.n)

    truth = chain.parameters()
    expected = {
        name
        for name in truth
        if name.startswith("K")
        or name in ("omega_n", "omega_a", "omega_b", "omega_c", "omega_x", "omega_y")
        or name == f"omega_{chain.n}" != "omega_1"
    }
    assert expected <= set(got)
    for name in expected:
        # The grid's ratio is 1.08, and a peak is low by sqrt(1 - 2 zeta²), or 6 % at zeta 0.25.
        assert_allclose(got[name].value, truth[name], rtol=0.08)
        if name.startswith("omega"):
            # An extremum lies anywhere within the distance of two points, and half of this from
            # the point that the distance is taken at.
            distance = got[name].value * np.log(omega[1] / omega[0])
            assert got[name].std == pytest.approx(distance / np.sqrt(12), rel=0.05)
    assert all(e.value == 0.1 for e in got.values() if e.source == "assumed")


def test_a_mode_too_damped_to_peak_is_found_from_the_roll_off():
    """If the first mode is too damped to have a peak, it is found from the roll-off."""
    chain = PRESETS["throne-2dof"]
    damped = Chain(m=chain.m, c=np.array([1, 1.7]) * 3e-3, k=chain.k * [1, 20, 1])
    assert damped.parameters()["zeta_a"] > 0.72  # above 1/sqrt 2 there is no peak
    omega = np.geomspace(1.0, 300.0, 60)

    got = find_resonances(table(damped, omega), n=2)

    # The value is only a start for a fit, since the formula ignores the damping.
    assert_allclose(got["omega_a"].value, damped.parameters()["omega_a"], rtol=0.3)
    assert_allclose(got["omega_b"].value, damped.parameters()["omega_b"], rtol=0.05)


def test_noise_gives_no_resonance():
    """A flat response with 5 % noise gives no resonance."""
    flat = Chain(m=np.array([1e-9]), c=np.array([1e-9]), k=np.array([1.0, 0.0]))

    got = find_resonances(table(flat, np.geomspace(1.0, 50.0, 40), noise=0.05), n=1)

    assert set(got) == {"zeta"}


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("top", [0.9, 1.4, 3.0])
def test_points_without_signal_give_no_estimate(preset, top):
    """Dwells in which no cart moves above the noise change no initial estimate.

    Below the first resonance or between two, a missing mode would be read from them.
    """
    chain = PRESETS[preset]
    top *= chain.parameters()["omega_n" if chain.n == 1 else "omega_a"]
    seen = table(chain, np.geomspace(0.5 * top, top, 15))
    faint = np.concatenate([np.geomspace(0.05, 0.4, 6) * top, np.geomspace(1.1, 8.0, 25) * top])
    rng = np.random.default_rng(7)

    def with_faint(r: FrequencyResponse) -> FrequencyResponse:
        size = 1e-3 * float(r.magnitude.min())
        order = np.argsort(np.concatenate([r.omega, faint]))
        # Below three standard errors there is no signal.
        noise = size * rng.uniform(0.05, 2.9, faint.size)
        return replace(
            r,
            omega=np.concatenate([r.omega, faint])[order],
            magnitude=np.concatenate([r.magnitude, noise])[order],
            magnitude_std=np.concatenate([r.magnitude_std, np.full(faint.size, size)])[order],
        )

    assert find_resonances([*map(with_faint, seen)], n=chain.n) == find_resonances(seen, n=chain.n)
    unseen = [with_faint(r) for r in seen]
    unseen = [replace(r, magnitude_std=np.maximum(r.magnitude_std, r.magnitude)) for r in unseen]
    assert find_resonances(unseen, n=chain.n) == {}
