"""Checks of the fitted carts: whether the fit explains the data and the chain is possible."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from pipeline.names import gain_name, own_zeta, read_name, toml_flags
from pipeline.plant.chain import Chain
from pipeline.plant.identities import brackets, recover_from_parameters
from pipeline.plant.limits import HEAVY_DAMPING
from pipeline.results import EXPLAINED, ChainFit, Check, LogDecrement, passed
from pipeline.setup import Setup
from pipeline.stages.compare import SIGMA_LIMIT
from pipeline.words.numbers import join_names

_REDUNDANCY = 1e-9  # relative difference of one number computed in two ways, without rounding
_BELOW_ZERO = 2.0  # standard errors by which a mass, damping or spring may be below zero
# A parameter below this share of its larger neighbour may not exist: on no bench do masses, dampers
# or springs differ by a factor of 50. If a spring is missing, dry friction and loose screws look
# like a spring of up to 1 % of its neighbour.
NEGLIGIBLE = 0.02


def check_carts(
    fit: ChainFit | None, *, decays: Sequence[LogDecrement] = (), bench: Setup
) -> list[Check]:
    """Check the fit, and whether the chain has the signs, redundancies and orders of real carts."""
    if fit is None:
        message = "No model was identified. The list of what was skipped has the reasons."
        return [Check(kind="fit", part="identified", outcome="fail", message=message)]
    if not fit.converged:
        return _fit_checks(fit)
    chain = fit.chain
    values = {name: estimate.value for name, estimate in fit.parameters.items()}
    checks = [*_fit_checks(fit), _sign_check(fit, bench=bench)]
    checks += check_vanishing(fit, decays=decays, bench=bench)
    if chain.n in (2, 3) and "omega_a" in values and all(bench.springs[1:-1]):
        checks += _redundancy_checks(values)
    if chain.n >= 2 and "omega_a" in values:
        checks.append(_gain_order_check(values, chain=chain))
        checks += _frequency_order_checks(values, n=chain.n)
    return checks


def _fit_checks(fit: ChainFit) -> list[Check]:
    if not fit.converged:
        found = "not judged, because the fit failed."
    elif fit.explains_data:
        found = "the linear carts and the noise explain the data."
    else:
        found = (
            "the linear carts leave a residual above the noise; look where model and measurement "
            "differ."
        )
    return [
        Check(
            kind="fit",
            part="converged",
            outcome=passed(fit.converged),
            message="The fit converged." if fit.converged else f"The fit failed: {fit.message}.",
        ),
        Check(
            kind="fit",
            part="explains_data",
            outcome=passed(fit.explains_data) if fit.converged else "skip",
            message=f"χ² per degree of freedom is {fit.chi_square_per_dof:.3g}: {found}",
            value=fit.chi_square_per_dof,
            limit=EXPLAINED,
        ),
    ]


def _sign_check(fit: ChainFit, *, bench: Setup) -> Check:
    """Check that no mass, damping or spring is negative by more than its standard error allows."""
    values, std = physical_values(fit.chain, bench=bench), fit.std
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
        else "No mass, damping or spring is below zero."
    )
    return Check(
        kind="physical",
        part="signs",
        outcome=passed(worst <= _BELOW_ZERO),
        value=worst if np.isfinite(worst) else None,
        limit=_BELOW_ZERO,
        message=message,
    )


def physical_values(chain: Chain, *, bench: Setup) -> dict[str, float]:
    """Return the masses, dampings and springs that the bench has, by name."""
    values = {f"m_{i}": float(m) for i, m in enumerate(chain.m, start=1)}
    values |= {f"c_{i}": float(c) for i, c in enumerate(chain.c, start=1)}
    springs = enumerate(zip(chain.k, bench.stiff, strict=True), start=1)
    return values | {f"k_{i}": float(k) for i, (k, there) in springs if there}


def check_vanishing(
    fit: ChainFit, *, decays: Sequence[LogDecrement] = (), bench: Setup
) -> list[Check]:
    """Return a failed check for each mass, damping or spring that may not exist.

    A parameter may not exist if its value is zero within its standard error, or small compared with
    its larger neighbour of the same kind.
    """
    if not fit.converged:
        return []
    values, std = physical_values(fit.chain, bench=bench), fit.std
    checks = []
    for name, value in values.items():
        sigmas = value / std[name] if std.get(name) else None
        beside = _larger_neighbour(name, values)
        share = value / values[beside] if beside else 1.0
        if value == 0 or (sigmas is not None and abs(sigmas) <= SIGMA_LIMIT):
            found = f"{name} ends at zero"
            if sigmas:
                found = f"{name} = {value:.2g} ± {std[name]:.1g} is zero within its error"
            measured, limit = sigmas, SIGMA_LIMIT
        elif 0 < share < NEGLIGIBLE:
            found = f"{name} = {value:.2g} is {100 * share:.2g} % of {beside}, almost nothing"
            measured, limit = share, NEGLIGIBLE
        else:
            continue
        checks.append(
            Check(
                kind="vanishing",
                parameter=name,
                outcome="fail",
                value=measured or 0.0,
                limit=limit,
                message=f"{found}. {_ask_if_there(name, decays=decays, bench=bench)}",
            )
        )
    return checks


def _larger_neighbour(name: str, values: Mapping[str, float]) -> str:
    """Return the larger of the two neighbouring parameters of the same kind, by name.

    Only positive neighbours count. Without one the result is "".
    """
    read = read_name(name)
    assert read.cart is not None
    beside = [f"{read.symbol}_{read.cart + step}" for step in (-1, 1)]
    return max((o for o in beside if values.get(o, 0.0) > 0), key=lambda o: values[o], default="")


def _ask_if_there(name: str, *, decays: Sequence[LogDecrement], bench: Setup) -> str:
    """Return a question to the student about a vanishing parameter, with the line to change."""
    read, n = read_name(name), bench.n
    assert read.cart is not None
    i = read.cart
    if read.symbol == "c" and (alike := [one for one in decays if one.cart == i]):
        runs = join_names(list(dict.fromkeys(one.experiment for one in alike)))
        return (
            f"The fit does not determine this damping. Use that of {runs}: "
            f"{own_zeta(i, n=n)} = {alike[0].zeta:.2g}."
        )
    if read.symbol == "c":
        alone = f", carts = [{i}]" if n > 1 else ""
        return (
            f"Do the recordings show the damping of cart {i}? A decay of that cart would show "
            f'it: add one to submission.toml, [[experiments]] with kind = "decay"{alone}.'
        )
    if read.symbol == "m":
        fewer = f"carts = {n - 1}, or " if n > 1 else ""
        return (
            f"Is there a cart {i}, and does its column hold its position? If not, write "
            f"{fewer}columns = {{ x{i} = … }} in submission.toml."
        )
    if n == 1:
        return (
            "Is there a spring at all? If not, write "
            f"springs = {toml_flags([False, False])} in submission.toml."
        )
    if 1 < i <= n:
        return (
            f"Does a spring tie cart {i} to cart {i - 1}? If not, the motor does not move cart "
            f"{i}: write carts = {i - 1} in submission.toml."
        )
    ends = f"wall-{i}" if i == 1 else f"{n}-wall"
    fewer = [flag and j != i for j, flag in enumerate(bench.springs, start=1)]
    return (
        f"Is there a spring {ends}? If not, write springs = {toml_flags(fewer)} in submission.toml."
    )


def _redundancy_checks(values: Mapping[str, float]) -> list[Check]:
    meaning = "two computations of the same physical number from the transfer functions"
    return [
        Check(
            kind="redundancy",
            parameter=name,
            outcome=passed(residual <= _REDUNDANCY),
            value=float(residual),
            limit=_REDUNDANCY,
            message=f"Redundancy {name}: {meaning} differ by {residual:.1e} (relative).",
        )
        for name, residual in recover_from_parameters(values).residuals.items()
    ]


def _gain_order_check(values: Mapping[str, float], *, chain: Chain) -> Check:
    """Check that a constant input moves no cart further than the cart before it."""
    names = [gain_name(cart, n=chain.n) for cart in range(1, chain.n + 1)]
    gains = [values[name] for name in names]
    # If no spring holds the far end, all static gains are equal and rounding decides which is
    # larger.
    rise = max(later / earlier - 1 for earlier, later in pairwise(gains))
    good = rise <= _REDUNDANCY and min(gains) >= 0
    return Check(
        kind="order",
        part="gains",
        outcome=passed(good),
        value=max(float(rise), 0.0),
        limit=_REDUNDANCY,
        message=f"Static gains fall along the chain ({' ≥ '.join(names)} > 0): {_yes(good)}.",
    )


def _frequency_order_checks(values: Mapping[str, float], *, n: int) -> list[Check]:
    """Check the order of resonances, nulls, and frequencies of single carts.

    With heavy damping, a wrong order is no failure, because damping may change the order.
    """
    damped = any(v > HEAVY_DAMPING for name, v in values.items() if read_name(name).is_ratio)
    checks = []
    for low, middle, high, _ in brackets(n):
        # Distance of the frequency from its allowed range, in percent of the frequency.
        excess = max(values[low] / values[middle], values[middle] / values[high]) - 1
        good = excess <= _REDUNDANCY
        reason = " (not exact where a damping ratio is above 0.3)" if damped and not good else ""
        ends = f"in_{read_name(low).suffix}{read_name(high).suffix}" if n == 3 else ""
        checks.append(
            Check(
                kind="order",
                parameter=middle,
                part=ends,
                outcome="pass" if good else ("skip" if damped else "fail"),
                value=100 * max(float(excess), 0.0),
                limit=0.0,
                message=f"{low} < {middle} < {high}: {_yes(good)}{reason}.",
            )
        )
    return checks


def _yes(good: bool) -> str:
    return "yes" if good else "no"
