"""Read single numbers off the recordings of a submission, as students may quote them."""

from collections.abc import Sequence

import numpy as np

from pipeline.grading import limits
from pipeline.names import read_name
from pipeline.results import Analysis, StepEdge, StepGain


def readings(name: str, analysis: Analysis) -> list[float]:
    """Return all values that students may read off for a cart's own gain, frequency or damping.

    The damping of a decay is read twice: with dry friction subtracted, and without subtracting it.
    """
    read = read_name(name)
    if read.is_by_eye:
        return []
    cart = read.cart or 1
    readings: list[float] = []
    if read.is_gain:
        held = _held(cart, analysis)
        for step in analysis.step_gains:
            if step.cart == cart:
                readings += [step.gain, *(step.interval or ())]
                readings += [_shortest(edge, held=held) for edge in step.edges if held]
        readings += _by_size([step for step in analysis.step_gains if step.cart == cart])
    for decay in analysis.log_decrements:
        if decay.cart == cart and read.is_frequency:
            readings.append(decay.omega_n)
        if decay.cart == cart and read.is_ratio:
            readings += [zeta for zeta in (decay.zeta, decay.law.zeta) if zeta > 0]
    return readings


def _by_size(steps: Sequence[StepGain]) -> list[float]:
    """Return the slope between small and large steps, if the gain depends on the size of the step.

    The slope is the difference in level divided by the difference in input. It is needed because a
    dead zone, or an amplifier with a threshold, subtracts the same amount from every step.
    """
    edges = sorted(
        (abs(e.u_after - e.u_before), abs(e.level_after - e.level_before))
        for step in steps
        for e in step.edges
    )
    if not edges:
        return []
    size, far = np.array(edges).T
    small, large = size < size.mean(), size >= size.mean()
    if not np.any(small) or size[small].max() > (1 - limits.SAME_STEP) * size[large].min():
        return []
    (u, x), (v, y) = ((size[at].mean(), far[at].mean()) for at in (small, large))
    slope = float((y - x) / (v - u))
    return [slope] if y / v > limits.BY_SIZE * x / u else []


def _held(cart: int, analysis: Analysis) -> float:
    """Return the largest input step that friction prevented from moving a free cart."""
    held = [
        float(np.abs(r.u).max())
        for r in analysis.records
        if r.kind == "step"
        and r.u is not None
        and cart in r.free
        and cart in r.carts
        and np.ptp(r.position(cart)) <= limits.STILL * r.encoder_step(cart)
    ]
    return max(held, default=0.0)


def _shortest(edge: StepEdge, *, held: float) -> float:
    """Return the gain from a step's edge, if friction stopped the cart beyond its equilibrium.

    Parameters
    ----------
    held : the largest input that friction can balance.
    """
    return abs((edge.level_after - edge.level_before) / (abs(edge.u_after - edge.u_before) + held))
