"""Checks of the fitted carts: does the fit explain the data, and is its chain a real one."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from pipeline.checks import limits
from pipeline.names import gain_name, read_name
from pipeline.plant.limits import HEAVY_DAMPING
from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.laws import brackets
from pipeline.plant.linear.recovery import recover_from_parameters
from pipeline.results import EXPLAINED, ChainFit, Check


def check_carts(fit: ChainFit | None, *, springs: Sequence[bool]) -> list[Check]:
    """Check the fit, and its chain against the laws of a real one: signs, redundancies, orders."""
    if fit is None:
        message = "No model was identified: the reasons are among what was skipped."
        return [Check.of("fit.identified", False, message)]
    chain = fit.chain
    values = {name: estimate.value for name, estimate in fit.parameters.items()}
    checks = [*_fit_checks(fit), _sign_check(fit, springs=springs)]
    if chain.n in (2, 3) and "omega_a" in values and all(springs[1:-1]):
        checks += _redundancy_checks(values)
    if chain.n >= 2 and "omega_a" in values:
        checks.append(_gain_order_check(values, chain=chain))
        checks += _frequency_order_checks(values, n=chain.n)
    return checks


def _fit_checks(fit: ChainFit) -> list[Check]:
    found = (
        "and the noise explain the data."
        if fit.explains_data
        else "leave more than the noise; look where model and measurement part."
    )
    return [
        Check.of(
            "fit.converged",
            fit.converged,
            "The fit converged." if fit.converged else f"The fit failed: {fit.message}.",
        ),
        Check.of(
            "fit.explains_data",
            fit.explains_data,
            f"χ² per degree of freedom is {fit.chi_square_per_dof:.3g}: the linear carts {found}",
            value=fit.chi_square_per_dof,
            limit=EXPLAINED,
        ),
    ]


def _sign_check(fit: ChainFit, *, springs: Sequence[bool]) -> Check:
    """No mass, damping or spring may be negative by more than its standard error allows."""
    chain = fit.chain
    values = {f"m_{i}": m for i, m in enumerate(chain.m, start=1)}
    values |= {f"c_{i}": c for i, c in enumerate(chain.c, start=1)}
    values |= {f"k_{i}": k for i, k in enumerate(chain.k, start=1) if springs[i - 1]}
    std = dict(zip(fit.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    below = {
        name: -value / std[name] if std.get(name) else np.inf
        for name, value in values.items()
        if value < 0
    }
    worst = float(max(below.values(), default=0.0))
    names = ", ".join(f"{name} = {values[name]:.3g}" for name in below)
    message = (
        f"Not positive: {names}; up to {worst:.1f} standard errors below zero."
        if below
        else "All masses, dampings and springs are positive."
    )
    value = worst if np.isfinite(worst) else None
    good = worst <= limits.BELOW_ZERO
    return Check.of("physical.signs", good, message, value=value, limit=limits.BELOW_ZERO)


def _redundancy_checks(values: Mapping[str, float]) -> list[Check]:
    meaning = "two routes through the transfer functions to one physical number agree"
    return [
        Check.of(
            f"redundancy.{name}",
            residual <= limits.REDUNDANCY,
            f"Redundancy {name} ({meaning}): relative difference {residual:.1e}.",
            value=float(residual),
            limit=limits.REDUNDANCY,
        )
        for name, residual in recover_from_parameters(values).residuals.items()
    ]


def _gain_order_check(values: Mapping[str, float], *, chain: Chain) -> Check:
    """The further from the motor, the smaller the static displacement."""
    names = [gain_name(cart, n=chain.n) for cart in range(1, chain.n + 1)]
    gains = [values[name] for name in names]
    # Equal gains are right where no spring holds the far end: rounding then decides the sign.
    rise = max(later / earlier - 1 for earlier, later in pairwise(gains))
    good = rise <= limits.REDUNDANCY and min(gains) >= 0
    said = f"Static gains fall along the chain ({' ≥ '.join(names)} > 0): {_yes(good)}."
    value = max(float(rise), 0.0)
    return Check.of("order.gains", good, said, value=value, limit=limits.REDUNDANCY)


def _frequency_order_checks(values: Mapping[str, float], *, n: int) -> list[Check]:
    """Resonances, nulls and the carts alone interlace, but for heavy damping."""
    damped = any(v > HEAVY_DAMPING for name, v in values.items() if read_name(name).is_ratio)
    checks = []
    for low, middle, high, _ in brackets(n):
        # How far outside the bracket, in percent of the value.
        excess = max(values[low] / values[middle], values[middle] / values[high]) - 1
        good = excess <= limits.REDUNDANCY
        reason = " (not exact where a damping ratio is above 0.3)" if damped and not good else ""
        ends = f"_in_{read_name(low).suffix}{read_name(high).suffix}" if n == 3 else ""
        checks.append(
            Check(
                id=f"order.{middle}{ends}",
                outcome="pass" if good else ("skip" if damped else "fail"),
                value=100 * max(float(excess), 0.0),
                limit=0.0,
                message=f"{low} < {middle} < {high}: {_yes(good)}{reason}.",
            )
        )
    return checks


def _yes(good: bool) -> str:
    return "yes" if good else "no"
