"""Throne's way to fit the Bode plots: the last cart first, then the numerators one by one.

The last cart's transfer function has no zeros, so its fit gives the common denominator. Each cart
before it then adds its gain and its zeros. Only magnitudes are used, on a logarithmic scale.

Reference: Throne (2005), sections on the two and three degree of freedom systems.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.minimise import minimise
from pipeline.names import NULLS, gain_name, mode_suffixes, mode_zeta, own_omega, own_zeta
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.identities import recover_chain

_FARTHEST = 50.0  # bound of a logarithm, so that a step that goes astray does not overflow
_ZETA_RANGE = (0.01, 1.0)  # damping ratios allowed at the start; others do not converge


@dataclass(frozen=True, kw_only=True, eq=False)
class LogMagnitude:
    """ln|X_cart/U| at omega (n_w,), and the weight of each point (one over its error)."""

    cart: int
    omega: Array
    level: Array
    weight: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class StagedFit:
    """Static gains (n,), polynomials T_1 … T_n as in `Chain.tails`, and the named parameters."""

    gains: Array
    tails: list[Array]
    parameters: dict[str, float]


def fit_stage_by_stage(
    measured: Mapping[int, LogMagnitude], *, n: int, initial: Mapping[str, float], like: Chain
) -> StagedFit:
    """Fit the transfer functions cart by cart, cart n first.

    Parameters
    ----------
    measured : magnitudes by cart. A missing cart keeps its start values.
    initial : the named parameters to start from, as far as they are known.
    like : a chain that gives start values for all other parameters.
    """
    known = {**like.parameters(), **initial}
    gains = np.array([known[gain_name(i, n=n)] for i in range(1, n + 1)])
    factors = [_start(known, i, n=n, like=like) for i in range(n)]
    for cart in range(n, 0, -1):
        if cart not in measured:
            continue
        points = measured[cart]
        if cart == n:
            gains[-1], factors[0] = _fit(points, gains[-1], factors[0], power=-1, known=None)
        else:
            gains[cart - 1], factors[cart] = _fit(
                points, gains[cart - 1], factors[cart], power=1, known=factors[0]
            )
    tails = [_polynomial(factor) for factor in factors]
    return StagedFit(gains=gains, tails=tails, parameters=_named(gains, factors, tails))


def _start(known: Mapping[str, float], i: int, *, n: int, like: Chain) -> Array:
    """Return ln omega and ln zeta (2, n - i) from which the fit of T_{i+1} starts.

    They belong to the poles for i = 0, otherwise to the zeros of cart i.
    """
    roots = like.poles if i == 0 else like.zeros(i)
    omega, zeta = quadratic_factors(roots)
    for j, suffix in enumerate(_suffixes(i, n=n)):
        omega[j] = known.get(f"omega_{suffix}", omega[j])
        zeta[j] = known.get(mode_zeta(suffix), zeta[j])
    return np.log([omega, np.clip(zeta, *_ZETA_RANGE)])


def _suffixes(i: int, *, n: int) -> list[str]:
    """Return the suffixes that Throne's tables give to T_{i+1}'s quadratic factors, if any."""
    if i == 0:
        return mode_suffixes(n)
    if i == n - 1:
        return [str(n)]
    return list(NULLS) if n == 3 else []


def _fit(
    points: LogMagnitude, gain: float, factors: Array, *, power: int, known: Array | None
) -> tuple[float, Array]:
    """Fit ln|G| = ln K + power Σ ln|Q_j| (less the known denominator); Q = 1 - r² + 2jζr."""
    target = points.level + (0.0 if known is None else _log_factors(points.omega, known)[0])
    shape = factors.shape

    def evaluate(theta: Array) -> tuple[Array, Array]:
        level, jacobian = _log_factors(points.omega, theta[1:].reshape(shape))
        columns = np.hstack([np.ones((points.omega.size, 1)), power * jacobian])
        residual = theta[0] + power * level - target
        return points.weight * residual, points.weight[:, None] * columns

    start = np.concatenate([[np.log(gain)], factors.ravel()])
    if points.omega.size < start.size:
        return gain, factors  # too few points for this stage; the joint fit sees all carts
    # A fit that succeeds takes about ten evaluations.
    found = minimise(
        evaluate,
        start,
        max_evaluations=100,
    ).x
    # If a logarithm changes by 7, a factor of 1000, the fit has gone astray.
    if np.max(np.abs(found - start)) > 7.0:
        return gain, factors
    return float(np.exp(found[0])), found[1:].reshape(shape)


def _log_factors(omega: Array, factors: Array) -> tuple[Array, Array]:
    """Return Σ ln|Q_j| (n_w,) and its derivatives by ln omega_j, then ln zeta_j (n_w, 2 n_j)."""
    size, zeta = np.exp(np.clip(factors, -_FARTHEST, _FARTHEST))
    r = omega[:, None] / size
    damping = 2j * zeta * r
    Q = 1 - r**2 + damping
    jacobian = np.hstack([((2 * r**2 - damping) / Q).real, (damping / Q).real])
    return np.sum(np.log(np.abs(Q)), axis=1), jacobian


def _polynomial(factors: Array) -> Array:
    """Multiply the factors s² + 2ζωs + ω² into a monic polynomial, highest power first."""
    product = np.array([1.0])
    for omega, zeta in np.exp(factors).T:
        product = np.polymul(product, np.array([1.0, 2 * zeta * omega, omega**2]))
    return product.astype(np.float64)


def _named(gains: Array, factors: list[Array], tails: list[Array]) -> dict[str, float]:
    """Return the fitted values by name, and the carts' own frequencies computed from them.

    A frequency that does not exist is left out.
    """
    n = gains.size
    values = {gain_name(i, n=n): float(gain) for i, gain in enumerate(gains, start=1)}
    for i, factor in enumerate(factors):
        order = np.argsort(factor[0])
        for suffix, omega, zeta in zip(_suffixes(i, n=n), *np.exp(factor[:, order]), strict=False):
            values[f"omega_{suffix}"] = float(omega)
            values[mode_zeta(suffix)] = float(zeta)
    found = recover_chain(gains, tails)
    for i in range(1, n if n > 1 else 0):
        stiffness = found.k[i - 1] + found.k[i]
        if stiffness > 0 and found.m[i - 1] > 0:
            omega = float(np.sqrt(stiffness / found.m[i - 1]))
            values[own_omega(i, n=n)] = omega
            values[own_zeta(i, n=n)] = float(found.c[i - 1] / (2 * found.m[i - 1] * omega))
    return values
