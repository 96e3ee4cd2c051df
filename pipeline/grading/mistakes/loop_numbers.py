"""Simulate reported gains on a chain of carts: stability, overshoot, settling time, static gain."""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.plant import simulate
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import discretise

_SAMPLE_TIME = 0.00884  # s; that of the ECP controller, for a design that states none
_HORIZON = 6.0  # simulated time, as a multiple of the required settling time
_MOST_SAMPLES = 60_000
_BLOWN_UP = 1e6  # a response this many times the reference counts as diverged


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopNumbers:
    """Results of a simulation of the sampled closed loop.

    The controller compensates for its delay of one sample by predicting the state.

    Attributes
    ----------
    poles : poles of the equivalent continuous loop, in rad/s.
    overshoot : overshoot in percent; infinite if the loop is unstable.
    settling_time : settling time in s; None if the loop does not settle in the simulated time.
    prefilter : reciprocal of the loop's static gain, so that the cart settles at the reference.
    """

    stable: bool
    poles: ComplexArray
    overshoot: float
    settling_time: float | None
    prefilter: float


def loop_numbers(
    chain: Chain, gains: Array, *, cart: int, settling: float, sample_time: float | None
) -> LoopNumbers | None:
    """Simulate the loop with gains (2n,) on a chain; return None if it cannot be computed."""
    T = sample_time or _SAMPLE_TIME
    row, size = 2 * (cart - 1), 2 * chain.n
    with np.errstate(all="ignore"):
        phi, gamma = discretise(chain, T)
        loop = phi - np.outer(gamma, gains)
        if not np.all(np.isfinite(loop)):
            return None
        z = np.linalg.eigvals(loop).astype(np.complex128)
        try:
            static = np.linalg.solve(np.eye(size) - loop, gamma)
        except np.linalg.LinAlgError:
            return None
        prefilter = float(1 / static[row])
        if not np.isfinite(prefilter):
            return None
        poles = np.asarray(np.log(z) / T, dtype=np.complex128)
        stable = bool(np.abs(z).max() < 1)
        samples = int(_HORIZON * settling / T) + 2
        # With a very short sample time, only every `stride`-th sample is computed.
        stride = math.ceil(samples / _MOST_SAMPLES)
        count = math.ceil(samples / stride)
        y = _step(*_together(loop, gamma / static[row], stride), row=row, count=count)
    overshoot, settles = np.inf, np.nan
    if stable and np.abs(y).max() < _BLOWN_UP:
        t = T * np.maximum(1.0 + stride * (np.arange(y.size) - 1.0), 0.0)
        judged = {"before": 0.0, "level": np.float64(1.0)}
        overshoot = float(simulate.overshoot_percent(y, **judged))
        settles = float(simulate.settling_time(t, y, **judged))
    return LoopNumbers(
        stable=stable,
        poles=poles,
        overshoot=overshoot,
        settling_time=None if np.isnan(settles) else settles,
        prefilter=prefilter,
    )


def _together(loop: Array, drive: Array, stride: int) -> tuple[Array, Array]:
    """Return the L and d with which x_{i+1} = L x_i + d advances by `stride` samples at once."""
    size = drive.size
    one = np.eye(size + 1)
    one[:size, :size], one[:size, size] = loop, drive
    several = np.linalg.matrix_power(one, stride)
    return several[:size, :size], several[:size, size]


def _step(loop: Array, drive: Array, *, row: int, count: int) -> Array:
    """Return the response to a unit step, shape (count,).

    Because of the delay, it begins with 0.
    """
    states = np.zeros((drive.size, 1))
    power, offset = loop, drive[:, None]
    # x_{k+1} = L x_k + d. Each pass doubles the number of known samples.
    while states.shape[1] < count:
        states = np.hstack([states, power @ states + offset])
        offset, power = offset + power @ offset, power @ power
    return np.concatenate([[0.0], states[row, : count - 1]])
