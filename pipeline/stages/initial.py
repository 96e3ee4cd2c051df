"""Initial estimates, as the paper makes them: steps, decays of single carts, peaks and nulls."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.results import Estimate, LogDecrement, StepGain

ASSUMED_ZETA = 0.1  # the paper's usual guess for every mode and null

# A repeat is an outlier where it stands this many spreads of the others off their mean, and by
# more than the relative difference that nobody would act on.
_OUTLIER_SPREADS = 6.0
_OUTLIER_RELATIVE = 0.05


@dataclass(frozen=True, kw_only=True)
class Repeats:
    """One number measured several times: mean, standard error, and who stands off."""

    estimate: Estimate
    outliers: tuple[int, ...]  # positions in the input


def combine_repeats(values: Sequence[float], *, std: Sequence[float], source: str) -> Repeats:
    """Combine repeats of one number, leaving out at most one that stands far off the others.

    The standard error is the larger of what the spread and what the single errors imply.
    """
    v, s = np.array(values, dtype=float), np.array(std, dtype=float)
    outliers: tuple[int, ...] = ()
    if v.size >= 4:
        distance = np.array([_distance(v, i) for i in range(v.size)])
        worst = int(np.argmax(distance))
        if distance[worst] > _OUTLIER_SPREADS:
            outliers = (worst,)
    keep = np.setdiff1d(np.arange(v.size), outliers)
    v, s = v[keep], s[keep]
    within = float(np.sqrt(np.sum(s**2)) / v.size)
    spread = float(np.std(v, ddof=1) / np.sqrt(v.size)) if v.size > 1 else 0.0
    estimate = Estimate(value=float(np.mean(v)), std=max(within, spread), source=source)
    return Repeats(estimate=estimate, outliers=outliers)


def _distance(v: np.ndarray, i: int) -> float:
    """How many spreads of the others v[i] stands off their mean; 0 where it hardly differs."""
    others = np.delete(v, i)
    off = abs(v[i] - others.mean())
    if off <= _OUTLIER_RELATIVE * abs(others.mean()):
        return 0.0
    spread = float(np.std(others, ddof=1))
    return off / spread if spread > 0 else np.inf


def estimate_initially(
    *,
    carts: int,
    log_decrements: Sequence[LogDecrement],
    step_gains: Sequence[StepGain],
    from_response: Mapping[str, Estimate],
) -> tuple[dict[str, Estimate], dict[str, str]]:
    """Collect the initial estimates by parameter name; also the runs left out, with the reason.

    Gains come from steps, single-cart frequencies and dampings from decays, resonances and nulls
    (and gains, without steps) from the measured frequency response, other dampings are assumed.
    """
    estimates: dict[str, Estimate] = {}
    left_out: dict[str, str] = {}
    for cart in range(1, carts + 1):
        suffix = "" if carts == 1 else f"_{cart}"
        decays = [d for d in log_decrements if d.cart == cart]
        steps = [s for s in step_gains if s.cart == cart]
        names = {"omega_n" if carts == 1 else f"omega_{cart}": "omega_n", f"zeta{suffix}": "zeta"}
        for name, attribute in names.items():
            _add(
                estimates,
                left_out,
                name=name,
                runs=[d.experiment for d in decays],
                values=[getattr(d, attribute) for d in decays],
                std=[getattr(d, f"{attribute}_std") for d in decays],
                source="log_decrement",
            )
        _add(
            estimates,
            left_out,
            name=f"K{suffix}",
            runs=[s.experiment for s in steps],
            values=[s.gain for s in steps],
            std=[s.gain_std for s in steps],
            source="step",
        )
    return {**from_response, **estimates}, left_out


def _add(
    estimates: dict[str, Estimate],
    left_out: dict[str, str],
    *,
    name: str,
    runs: Sequence[str],
    values: Sequence[float],
    std: Sequence[float],
    source: str,
) -> None:
    if not values:
        return
    repeats = combine_repeats(values, std=std, source=source)
    estimates[name] = repeats.estimate
    left_out |= {
        runs[i]: f"{name} = {values[i]:.4g} stands off the other repeats "
        f"({repeats.estimate.value:.4g}): the run is left out"
        for i in repeats.outliers
    }
