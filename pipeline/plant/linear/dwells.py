"""Sine dwells on a chain: their frequencies, the length of the transient, and the motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.linear.chain import Chain, quadratic_factors
from pipeline.plant.linear.simulate import simulate_linear

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


@dataclass(frozen=True, kw_only=True)
class Reach:
    """The largest motion of any cart per unit of input, in position units.

    Attributes
    ----------
    steady : the largest motion after the transient.
    furthest : the largest motion at any time.
    """

    steady: float
    furthest: float


def reach(chain: Chain, t: Array, *, shape: Array, wait: float) -> Reach:
    """Return the largest motions from rest under the input `shape` (n,).

    The transient lasts `wait` s.
    """
    unit = np.abs(simulate_linear(chain, t, shape))
    return Reach(steady=float(np.max(unit[:, t >= wait])), furthest=float(np.max(unit)))
