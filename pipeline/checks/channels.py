"""Check of the channels against each other: is one of them logged later than the others?"""

from collections.abc import Sequence

import numpy as np

from pipeline.checks import limits
from pipeline.estimation.noise import MEDIAN_TO_SIGMA
from pipeline.results import ChainFit, Check, FrequencyResponse, Record

LATE_CHANNEL = "late_channel"  # then the cart


def check_channels(
    responses: Sequence[FrequencyResponse], fit: ChainFit | None, *, records: Sequence[Record]
) -> list[Check]:
    """Fail for each cart that dwell after dwell is read later, or earlier, than the first one.

    A delay of the input moves all phases alike. One that moves the phase of one cart against
    another's, in proportion to the frequency, is of its channel: no carts do that.
    """
    dwells = [r for r in responses if r.source == "dwells" and r.phase is not None]
    samples = [record.sample_time for record in records if record.kind == "sine"]
    checks: list[Check] = []
    if fit is None or not samples:
        return checks
    for other in dwells[1:]:
        omega, late = _lateness(dwells[0], other, fit=fit)
        if omega.size < limits.FEWEST_DWELLS:
            continue
        delay = float(np.median(late))
        spread = MEDIAN_TO_SIGMA * float(np.median(np.abs(late - delay)))
        limit = max(limits.LATE * float(np.median(samples)), limits.LATE_SURE * spread)
        if abs(delay) > limit:
            word = "later" if delay > 0 else "earlier"
            message = (
                f"cart {other.cart} is read {1e3 * abs(delay):.3g} ms {word} than cart "
                f"{dwells[0].cart} in the dwells. No carts do that: a filter on one channel does, "
                "or channels that are not read at one time. Positions and velocities that a "
                "controller feeds back must be of one moment."
            )
            id_ = f"{LATE_CHANNEL}.cart-{other.cart}"
            checks.append(Check.of(id_, False, message, value=delay, limit=limit))
    return checks


def _lateness(
    first: FrequencyResponse, other: FrequencyResponse, *, fit: ChainFit
) -> tuple[np.ndarray, np.ndarray]:
    """Return the dwells that both are in, rad/s, and by how many s the other lags more in each."""
    left = []
    for one in (first, other):
        model = fit.chain.frequency_response(one.omega)[one.cart - 1]
        left.append(np.asarray(one.phase) - np.angle(model))
    omega, a, b = np.intersect1d(
        np.round(first.omega, 4), np.round(other.omega, 4), return_indices=True
    )
    lag = left[0][a] - left[1][b]
    return omega, np.angle(np.exp(1j * lag)) / omega
