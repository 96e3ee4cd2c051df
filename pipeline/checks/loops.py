"""Checks of loops: the designed one against python-control, those that ran against the log."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.linear.chain import Chain
from pipeline.plant.loop.margins import Margins, closed_loop, stability_margins
from pipeline.results import Check, CheckOutcome, FeedbackDesign, HardwareCheck

if TYPE_CHECKING:
    import control

# Of the coefficients of a loop's polynomial, relative to their binomials. Rounding leaves 1e-13 of
# them on realistic plants; the other programs' gains up to 1e-8.
_SAME_LOOP = 1e-6


def design_margins(chain: Chain, design: FeedbackDesign) -> Margins:
    """Return the margins of the designed loop, including its observer and delay.

    Raises
    ------
    DataError : the loop is not stable, a mode of the carts is undamped, or the chain too extreme.
    """
    try:
        found = stability_margins(chain, design.controller(chain), sample_time=design.sample_time)
    except np.linalg.LinAlgError:
        raise DataError("margins need a loop whose numbers lie closer together") from None
    if found is None:
        raise DataError("margins need a stable loop, found one that is not")
    return found


def verify_design(chain: Chain, design: FeedbackDesign) -> Check:
    """Check that c2d with dlqr or place of python-control gives the same loop.

    Its value is the largest difference of a coefficient of the loop's polynomial, poles in z, from
    the desired poles, or with LQR from the loop of the other program; or the relative error of the
    static gain, whichever is larger.
    """
    names = f"python-control's c2d and {'place' if design.Q is None else 'dlqr'}"
    try:
        ours, theirs, wanted, level = _loops(chain, design)
    except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
        return _check("skip", None, f"{names} have no answer for so extreme a plant")
    value = float(np.max(np.append(np.abs(ours - wanted), abs(level - 1))))
    if not np.isfinite(value):
        return _check("fail", None, "the designed loop has no finite polynomial: do not run it")
    if value > _SAME_LOOP:
        return _check("fail", value, f"{names} give another loop: do not run these gains")
    if np.abs(theirs - wanted).max() > _SAME_LOOP:
        return _check("skip", value, f"{names} miss the poles asked for; these gains do")
    return _check("pass", value, f"{names} give the same loop")


def check_loops(hardware: Sequence[HardwareCheck]) -> list[Check]:
    """Return a failed check for each run with a wrong log or a wrong stated controller."""
    notes: dict[str, list[str]] = {}
    for check in hardware:
        if check.contradicted:
            notes.setdefault(check.experiment, []).extend([check.note] if check.note else [])
    return [
        Check(kind="hardware", run=run, outcome="fail", message=f"{run}: {'; '.join(said)}.")
        for run, said in notes.items()
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


def _loops(chain: Chain, design: FeedbackDesign) -> tuple[Array, Array, Array, float]:
    """Return the polynomials of our loop, of theirs and of the desired one, and our static gain."""
    import control

    sampled = control.sample_system(chain.to_control(), design.sample_time)
    loop = closed_loop(chain, design.controller(chain), sample_time=design.sample_time)
    ours = _polynomial(sampled, design.gains)
    level = float(np.ravel(control.dcgain(loop))[design.cart - 1])
    if design.requested_poles is None:
        theirs = _polynomial(sampled, control.dlqr(sampled, design.Q, design.R)[0])
        return ours, theirs, theirs, level
    z = np.exp(design.sample_time * design.requested_poles)
    try:
        gains = control.place(sampled.A, sampled.B, z)
    except ValueError:  # a pole requested twice
        gains = control.place_acker(sampled.A, sampled.B, z)
    return ours, _polynomial(sampled, gains), _from_roots(z), level


def _polynomial(sampled: "control.StateSpace", gains: ArrayLike) -> Array:
    row = np.reshape(gains, (1, -1))
    return _from_roots(np.linalg.eigvals(sampled.A - sampled.B @ row))


def _from_roots(z: ArrayLike) -> Array:
    return np.poly(z).real.astype(np.float64)
