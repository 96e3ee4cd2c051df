"""Simulate a chain exactly, at any sample times; measure step responses, plan sine dwells."""

from collections.abc import Sequence
from math import isqrt

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.chain import Chain, quadratic_factors

SETTLING_BAND = 0.02  # share of the change in level: the 2 % criterion
OVERSAMPLING = 8  # points between samples for a band-limited input
_LANCZOS_WIDTH = 12  # samples that the interpolation kernel spans on each side


def simulate_linear(
    chain: Chain,
    t: Array,
    u: Array,
    *,
    free: Sequence[int] | None = None,
    x0: Array | None = None,
    hold: str = "zero_order",
) -> Array:
    """Simulate the positions of the free carts.

    Parameters
    ----------
    t : times (n,), s, strictly increasing but not necessarily evenly spaced.
    u : input (n,). With "zero_order" it is u[i] between t[i] and t[i + 1]. With "band_limited" it
        is the smooth signal through the samples (Lanczos interpolation).
    x0 : initial state (2f,) of the free carts, (x1, v1, x2, v2, …); at rest by default.

    Returns
    -------
    positions (f, n) at `t`.
    """
    A, B, C, _ = chain.state_space(free=free)
    x0 = np.zeros(A.shape[0]) if x0 is None else np.asarray(x0, dtype=np.float64)
    t, u = np.asarray(t, dtype=np.float64), np.asarray(u, dtype=np.float64)
    if hold == "band_limited":
        fine_t, fine_u = interpolate_band_limited(t, u)
        return (C @ propagate(A, B, fine_t, fine_u, x0=x0, linear=True))[:, ::OVERSAMPLING]
    return C @ propagate(A, B, t, u, x0=x0)


def propagate(A: Array, B: Array, t: Array, u: Array, *, x0: Array, linear: bool = False) -> Array:
    """Propagate x' = A x + B u over the samples; return the states (n_states, n).

    The input is held from sample to sample or, with `linear`, interpolated linearly. The result is
    exact. It uses the matrix exponential of the augmented system (Van Loan, IEEE Trans. Automatic
    Control 23, 1978), one for each distinct interval.
    """
    from scipy.linalg import expm  # takes a tenth of a second, so it is imported here

    n_states = A.shape[0]
    n_augmented = n_states + (2 if linear else 1)
    augmented = np.zeros((n_augmented, n_augmented))
    augmented[:n_states, :n_states] = A
    augmented[:n_states, n_states] = B[:, 0]
    if linear:
        augmented[n_states, n_states + 1] = 1.0
    # Sample times have relative rounding errors of 1e-16. Intervals that agree to 1e-12 s count as
    # equal.
    steps, which = np.unique(np.round(np.diff(t), 12), return_inverse=True)
    phi = expm(augmented * steps[:, None, None])
    transition, drive = phi[:, :n_states, :n_states], phi[:, :n_states, n_states]
    forced = drive[which] * u[:-1, None]
    if linear:
        forced += phi[which, :n_states, n_states + 1] * (np.diff(u) / np.diff(t))[:, None]
    if steps.size == 1:
        return np.vstack([x0, _by_blocks(transition[0], forced, x0)]).T
    states = np.empty((t.size, n_states))
    states[0] = x = x0
    for i, j in enumerate(which):
        states[i + 1] = x = transition[j] @ x + forced[i]
    return states.T


def _by_blocks(transition: Array, forced: Array, x: Array) -> Array:
    """Return the states (n, n_states) that follow x by the rule x → transition @ x + forced[i].

    Blocks are computed from rest, all at once, and then joined. That takes 2 √n steps of the Python
    interpreter instead of n.
    """
    n, n_states = forced.shape
    length = isqrt(n)
    blocks = n // length
    states = np.empty_like(forced)
    split = states[: blocks * length].reshape(blocks, length, n_states)
    input_split = forced[: blocks * length].reshape(blocks, length, n_states)
    powers = np.empty((length, n_states, n_states))
    own, power = np.zeros((blocks, n_states)), np.eye(n_states)
    for i in range(length):
        split[:, i] = own = own @ transition.T + input_split[:, i]
        powers[i] = power = transition @ power
    for block in split:
        block += powers @ x
        x = block[-1]
    for i in range(blocks * length, n):
        states[i] = x = transition @ x + forced[i]
    return states


def interpolate_band_limited(t: Array, u: Array) -> tuple[Array, Array]:
    """Return times and the Lanczos-interpolated input on a grid `OVERSAMPLING` times finer."""
    index = np.arange(t.size)
    fine = np.arange((t.size - 1) * OVERSAMPLING + 1) / OVERSAMPLING
    padded = np.pad(u, _LANCZOS_WIDTH, mode="edge")
    base = np.floor(fine).astype(int)
    offsets = np.arange(1 - _LANCZOS_WIDTH, _LANCZOS_WIDTH + 1)
    distance = (fine - base)[:, None] - offsets
    kernel = np.sinc(distance) * np.sinc(distance / _LANCZOS_WIDTH)
    samples = padded[base[:, None] + offsets + _LANCZOS_WIDTH]
    return np.interp(fine, index, t), (kernel * samples).sum(1) / kernel.sum(1)


def overshoot_percent(y: Array, *, before: Array | float, level: Array | float) -> Array:
    """Return how far `y` (..., n) exceeds the final level, in percent of the change in level."""
    change = np.asarray(level, dtype=np.float64) - before
    past = (y - np.asarray(level)[..., None]) * np.sign(change)[..., None]
    return 100 * np.maximum(past.max(-1), 0.0) / np.abs(change)


def settling_time(
    t: Array, y: Array, *, before: Array | float, level: Array | float, noise: float = 0.0
) -> Array:
    """Return when `y` (..., n) enters the 2 % band for good, in s after t[0]; NaN if never.

    `noise` widens the band if a measured signal scatters by more than 2 %.
    """
    change = np.asarray(level, dtype=np.float64) - before
    band = np.maximum(SETTLING_BAND * np.abs(change), noise)
    outside = np.abs(y - np.asarray(level)[..., None]) > band[..., None]
    n_last = np.where(outside.any(-1), t.size - np.argmax(outside[..., ::-1], axis=-1), 0)
    return np.where(n_last < t.size, t[np.minimum(n_last, t.size - 1)] - t[0], np.nan)


SETTLED = 7.0  # time constants until a transient of 1 cm is half an encoder count
SETTLED_DWELL = 9.0  # until a tenth of a count, because dwells at a resonance hide a transient


def dwell_frequencies(chain: Chain, *, n: int, among: Sequence[float] = ()) -> list[float]:
    """Return about `n` frequencies in Hz, ascending, with more of them at resonances and nulls.

    About half of them are spread evenly, on a logarithmic axis, over the range of the resonances.
    The others lie at the resonances and nulls and within half a bandwidth of them. The frequencies
    `among` are always included.
    """
    features = [quadratic_factors(chain.poles)]
    features += [quadratic_factors(chain.zeros(cart)) for cart in range(1, chain.n)]
    resonances = features[0][0]
    omega = np.concatenate([f[0] for f in features])
    zeta = np.clip(np.concatenate([f[1] for f in features]), 0.03, 0.3)
    sides = np.linspace(-1.0, 1.0, max(3, round(0.5 * n / omega.size)))
    close = (omega[:, None] * (1 + zeta[:, None] * sides)).ravel()
    spread = np.geomspace(0.7 * resonances[0], 1.5 * resonances[-1], max(n - close.size, n // 2))
    hertz = list(among)
    for candidate in [*close, *spread]:
        f = round(float(candidate) / (2 * np.pi), 2)  # rounded as people would type it
        if all(abs(f - other) > 0.015 * other for other in hertz):
            hertz.append(f)
    return sorted(hertz)


def settling_wait(chain: Chain, *, time_constants: float) -> float:
    """Return how long a student waits for the end of the transient, s."""
    slowest = float(np.min(-chain.poles.real))
    if slowest <= 1e-9 * np.abs(chain.poles).max():  # zero except for rounding
        raise DataError("the carts never settle: a session needs damping and a spring to a wall")
    # No student waits more than 12 s, however small the damping.
    return min(time_constants / slowest, 12.0)


def steady_time(hertz: float) -> float:
    """Return how long a dwell continues after the transient, s."""
    # Long enough to see that the last cycles no longer change, and at least 1.4 s.
    return max(6.5 / hertz, 1.4)


def largest_motion(chain: Chain, t: Array, *, shape: Array, wait: float) -> tuple[float, float]:
    """Return the largest motion of any cart, from rest, under the input `shape` (n,).

    The first number is for the time after the transient of `wait` s, the second for all times.
    """
    unit = np.abs(simulate_linear(chain, t, shape))
    return float(np.max(unit[:, t >= wait])), float(np.max(unit))
