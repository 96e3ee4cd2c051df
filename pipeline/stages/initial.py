"""Initial estimates, as the paper makes them: steps, decays of single carts, peaks and nulls."""

from collections.abc import Sequence

import numpy as np

from pipeline.results import Estimate, LogDecrement, StepGain


def combine_repeats(values: Sequence[float], *, std: Sequence[float], source: str) -> Estimate:
    """Combine repeats of one number to their mean.

    The standard error is the larger of what the spread and what the single errors imply.
    """
    v = np.array(values, dtype=float)
    within = float(np.sqrt(np.sum(np.square(std))) / v.size)
    spread = float(np.std(v, ddof=1) / np.sqrt(v.size)) if v.size > 1 else 0.0
    return Estimate(value=float(np.mean(v)), std=max(within, spread), source=source)


def estimate_initially(
    *, carts: int, log_decrements: Sequence[LogDecrement], step_gains: Sequence[StepGain]
) -> dict[str, Estimate]:
    """Estimate the gains from steps, the frequency and damping of each cart alone from decays."""
    estimates: dict[str, Estimate] = {}
    for cart in range(1, carts + 1):
        suffix = "" if carts == 1 else f"_{cart}"
        decays = [d for d in log_decrements if d.cart == cart]
        steps = [s for s in step_gains if s.cart == cart]
        if decays:
            estimates["omega_n" if carts == 1 else f"omega_{cart}"] = combine_repeats(
                [d.omega_n for d in decays],
                std=[d.omega_n_std for d in decays],
                source="log_decrement",
            )
            estimates[f"zeta{suffix}"] = combine_repeats(
                [d.zeta for d in decays], std=[d.zeta_std for d in decays], source="log_decrement"
            )
        if steps:
            estimates[f"K{suffix}"] = combine_repeats(
                [s.gain for s in steps], std=[s.gain_std for s in steps], source="step"
            )
    return estimates
