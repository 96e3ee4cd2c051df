"""Initial estimates, as in Throne's paper: steps, decays of single carts, peaks and nulls."""

from collections.abc import Sequence

import numpy as np

from pipeline.names import gain_name, own_omega, own_zeta
from pipeline.results import Estimate, LogDecrement, StepGain


def combine_repeats(
    values: Sequence[float], *, std: Sequence[float], source: str, experiments: Sequence[str] = ()
) -> Estimate:
    """Combine repeats of one number into their mean.

    Its standard error follows from their spread or from their errors, whichever makes it larger.
    """
    v = np.array(values, dtype=float)
    within = float(np.sqrt(np.sum(np.square(std))) / v.size)
    spread = float(np.std(v, ddof=1) / np.sqrt(v.size)) if v.size > 1 else 0.0
    return Estimate(
        value=float(np.mean(v)),
        std=max(within, spread),
        source=source,
        experiments=tuple(dict.fromkeys(experiments)),
    )


def estimate_initially(
    *, carts: int, log_decrements: Sequence[LogDecrement], step_gains: Sequence[StepGain]
) -> dict[str, Estimate]:
    """Estimate gains from steps, and each cart's own frequency and damping from decays."""
    measured: dict[str, list[tuple[float, float, str, str]]] = {}
    for decay in log_decrements:
        for name, value, std in (
            (own_omega(decay.cart, n=carts), decay.omega_n, decay.omega_n_std),
            (own_zeta(decay.cart, n=carts), decay.zeta, decay.zeta_std),
        ):
            measured.setdefault(name, []).append((value, std, "log_decrement", decay.experiment))
    for step in step_gains:
        name = gain_name(step.cart, n=carts)
        measured.setdefault(name, []).append((step.gain, step.gain_std, "step", step.experiment))
    return {
        name: combine_repeats(
            [value for value, *_ in ones],
            std=[std for _, std, *_ in ones],
            source=ones[0][2],
            experiments=[run for *_, run in ones],
        )
        for name, ones in measured.items()
    }
