"""Compare the designed loop with the requested one, and loops that ran with their logs."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_are

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.chain import Chain
from pipeline.plant.margins import Margins, stability_margins
from pipeline.plant.sampled_loop import discretise
from pipeline.results import Check, CheckOutcome, FeedbackDesign, HardwareCheck

# Largest difference between the polynomials of two loops that count as the same. Rounding leaves
# 1e-13 on realistic plants, and gains from another program up to 1e-8.
_SAME_LOOP = 1e-6
_LAST_DIGIT = 12  # decimals; rounding beyond them depends on the linear algebra library


def design_margins(chain: Chain, design: FeedbackDesign, *, on_bench: bool = False) -> Margins:
    """Return the margins of the designed loop, including its observer and delay.

    The observer predicts with the chain or, `on_bench`, with constant velocities.

    Raises
    ------
    DataError : the loop is not stable, a mode of the carts is undamped, or the numbers of the chain
        differ by too many orders of magnitude.
    """
    controller = design.controller(None if on_bench else chain)
    try:
        found = stability_margins(chain, controller, sample_time=design.sample_time)
    except np.linalg.LinAlgError:
        raise DataError("no margins: the numbers of this loop differ too much in size") from None
    if found is None:
        where = "on cartlab's bench, whose observer has no model," if on_bench else ""
        raise DataError(f"no margins: {'the loop ' + where if where else 'the loop'} is unstable")
    return found


def verify_design(chain: Chain, design: FeedbackDesign) -> Check:
    """Check that the designed gains give the requested loop.

    The check's value is the largest difference between coefficients of two polynomials in z, or the
    relative error of the static gain if that is larger. One polynomial belongs to the designed
    loop. The other one belongs to the requested poles or, with LQR, to the loop that scipy's
    Riccati solver gives.
    """
    asked = "the requested poles" if design.Q is None else "the same loop as scipy's Riccati solver"
    try:
        ours, wanted, level = _loops(chain, design)
    except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
        return _check("skip", None, "not verified: the plant's numbers differ too much in size")
    value = float(np.max(np.append(np.abs(ours - wanted), abs(level - 1))).round(_LAST_DIGIT))
    if not np.isfinite(value):
        return _check("fail", None, "the designed loop has no finite polynomial: do not run it")
    if value > _SAME_LOOP:
        return _check("fail", value, f"the gains do not give {asked}: do not run them")
    return _check("pass", value, f"the gains give {asked}")


def check_loops(hardware: Sequence[HardwareCheck]) -> list[Check]:
    """Return a failed check for each run whose log or stated controller is wrong."""
    notes: dict[str, list[str]] = {}
    for check in hardware:
        if check.contradicted:
            notes.setdefault(check.experiment, []).extend([check.note] if check.note else [])
    return [
        Check(kind="hardware", run=run, outcome="fail", message=f"{run}: {'; '.join(texts)}.")
        for run, texts in notes.items()
    ]


def _check(outcome: CheckOutcome, value: float | None, message: str) -> Check:
    return Check(
        kind="feedback",
        part="gains",
        outcome=outcome,
        value=value,
        limit=_SAME_LOOP,
        message=message,
    )


def _loops(chain: Chain, design: FeedbackDesign) -> tuple[Array, Array, float]:
    """Return the polynomials of the designed and the requested loop, and the static gain."""
    phi, gamma = discretise(chain, design.sample_time)

    def fed_back(gains: Array) -> Array:
        return phi - np.outer(gamma, gains)

    ours = fed_back(design.gains)
    settled = np.linalg.solve(np.eye(gamma.size) - ours, design.prefilter * gamma)
    if design.requested_poles is not None:
        z = np.exp(design.sample_time * design.requested_poles)
    else:
        assert design.Q is not None
        assert design.R is not None
        z = np.linalg.eigvals(fed_back(_riccati_gains(phi, gamma, Q=design.Q, R=design.R)))
    level = float(settled[2 * (design.cart - 1)])
    return _from_roots(np.linalg.eigvals(ours)), _from_roots(z), level


def _riccati_gains(phi: Array, gamma: Array, *, Q: Array, R: float) -> Array:
    """Return the LQR gains from scipy's Riccati solver, independently of the design."""
    cost = solve_discrete_are(phi, gamma[:, None], Q, R)
    return (gamma @ cost @ phi) / (R + gamma @ cost @ gamma)


def _from_roots(z: ArrayLike) -> Array:
    return np.poly(z).real.astype(np.float64)
