"""Hold the designed state feedback against python-control: its margins, and its gains once more."""

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from pipeline.errors import DataError
from pipeline.plant.chain import Array, Chain
from pipeline.plant.designed_loop import Margins, closed_loop, stability_margins
from pipeline.plant.loop import StateFeedback
from pipeline.results import Check, FeedbackDesign, Outcome

if TYPE_CHECKING:
    import control

# Both programs are exact but for rounding, which moves a pole in z by the condition of the
# eigenvalue problem: up to 1e-8 on four carts (tests/test_state_feedback.py).
_SAME = 1e-6


def design_margins(chain: Chain, design: FeedbackDesign) -> Margins:
    """Return the margins of the designed loop, the observer and the delay in it.

    Raises
    ------
    DataError : the loop is not stable, or too extreme a chain for its frequency response.
    """
    try:
        found = stability_margins(chain, _controller(chain, design), sample_time=design.sample_time)
    except np.linalg.LinAlgError:
        raise DataError("margins need a loop whose numbers lie closer together") from None
    if found is None:
        raise DataError("margins need a stable loop, found one that is not")
    return found


def verify_design(chain: Chain, design: FeedbackDesign) -> Check:
    """Ask whether c2d with dlqr or place of python-control gives the same loop.

    Its value is the largest distance in the z plane between poles of the two loops, or the error
    of the static gain from the reference, whichever is larger.
    """
    import control

    names = f"python-control's c2d and {'place' if design.Q is None else 'dlqr'}"
    sampled = control.sample_system(chain.to_control(), design.sample_time)
    try:
        theirs = np.linalg.eigvals(sampled.A - sampled.B @ _gains(sampled, design))
        ours = np.linalg.eigvals(sampled.A - sampled.B @ design.gains[None, :])
    except (np.linalg.LinAlgError, ValueError) as error:  # singular, or poles asked for twice
        return _check("skip", None, f"{names} have no answer for this design: {error}")
    away = np.abs(ours[:, None] - theirs[None, :])
    loop = closed_loop(chain, _controller(chain, design), sample_time=design.sample_time)
    level = np.ravel(control.dcgain(loop))[design.cart - 1]
    value = float(max(away[linear_sum_assignment(away)].max(), abs(level - 1)))
    if value <= _SAME:
        return _check("pass", value, f"{names} give the same loop")
    return _check("fail", value, f"{names} give another loop: do not run these gains")


def _check(outcome: Outcome, value: float | None, message: str) -> Check:
    return Check(id="feedback.gains", outcome=outcome, value=value, limit=_SAME, message=message)


def _controller(chain: Chain, design: FeedbackDesign) -> StateFeedback:
    return StateFeedback(gains=design.gains, prefilter=design.prefilter, model=chain)


def _gains(sampled: "control.StateSpace", design: FeedbackDesign) -> Array:
    """Return the gains (1, 2n) of the design's own method, by python-control."""
    import control

    if design.Q is None:
        z = np.exp(design.sample_time * np.asarray(design.requested_poles))
        return np.asarray(control.place(sampled.A, sampled.B, z))
    return np.asarray(control.dlqr(sampled, design.Q, design.R)[0])
