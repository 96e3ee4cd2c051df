"""The data of the Bode fit: all measured points in one array, and the chain's response to them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.minimise import minimise
from pipeline.estimation.parametrisation import Parametrisation
from pipeline.names import NULLS, gain_name, mode_suffixes, mode_zeta, own_omega, own_zeta
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.identities import recover_chain
from pipeline.results import Estimate, FrequencyResponse

Scale = Literal["log", "magnitude", "polar"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """All measured points of the frequency responses in one array (N,).

    `at` and `cart` are the indices, from 0, of each point's frequency and cart. `decays` holds
    estimates of a cart's own damping ratio from decays, by cart (from 1). Each estimate counts as
    one more point.
    """

    omega: Array  # (n_w,) the distinct frequencies
    at: NDArray[np.intp]
    cart: NDArray[np.intp]
    magnitude: Array
    std: Array
    unit: ComplexArray  # exp(-i phase), 1 if the phase is unknown
    phase_std: Array  # infinite if the phase is unknown
    from_table: bool
    decays: Mapping[int, Estimate] = field(default_factory=dict)

    @classmethod
    def collect(cls, responses: Sequence[FrequencyResponse], *, n: int) -> "Points":
        """Gather the responses of some of the n carts; fill in missing standard errors."""
        if not responses:
            raise DataError("Bode fit: needs a frequency response, found none")
        for response in responses:
            if not 1 <= response.cart <= n:
                raise DataError(
                    f"Bode fit: found a response of cart {response.cart}, but the system has {n}"
                )
        omega = np.concatenate([r.omega for r in responses])
        magnitude = np.concatenate([r.magnitude for r in responses])
        if not (np.all(np.isfinite(omega) & (omega >= 0)) and np.all(np.isfinite(magnitude))):
            raise DataError("Bode fit: frequencies and magnitudes must be finite numbers")
        std = np.concatenate([r.magnitude_std for r in responses])
        stated = np.isfinite(std) & (std > 0)
        # A magnitude without a standard error is assumed to have a relative error of 1 %.
        std = np.where(stated, std, 0.01 * np.maximum(magnitude, np.median(magnitude) / 1e3))
        phase = [np.zeros(r.omega.size) if r.phase is None else r.phase for r in responses]
        phase_std = [
            np.full(r.omega.size, np.inf) if r.phase_std is None else r.phase_std for r in responses
        ]
        spread = np.concatenate(phase_std)
        distinct, at = np.unique(omega, return_inverse=True)
        # A phase with a standard error above this (rad) is not used.
        return cls(
            omega=distinct,
            at=at,
            cart=np.concatenate([np.full(r.omega.size, r.cart - 1) for r in responses]),
            magnitude=magnitude,
            std=std,
            unit=np.exp(-1j * np.concatenate(phase)).astype(np.complex128),
            phase_std=np.where((spread > 0) & (spread < 0.5), spread, np.inf),
            from_table=all(r.source == "table" for r in responses) or not stated.any(),
        )

    @property
    def size(self) -> int:
        """The number of points, N."""
        return self.magnitude.size

    @property
    def n_phases(self) -> int:
        """The number of points with a usable phase."""
        return int(np.count_nonzero(np.isfinite(self.phase_std)))

    @property
    def level(self) -> Array:
        """ln|G|; a magnitude below its standard error counts as half that error."""
        return np.log(np.maximum(self.magnitude, self.std / 2))

    @property
    def level_weight(self) -> Array:
        """One over the standard error of the level, (N,)."""
        # 5 % are added to the error of ln|G|, so that no point dominates early in the fit.
        return 1.0 / np.hypot(self.std / np.exp(self.level), 0.05)

    def widened(self, share: float) -> "Points":
        """Return the points with a relative error added to their standard errors."""
        return replace(
            self,
            std=np.hypot(self.std, share * self.magnitude),
            phase_std=np.hypot(self.phase_std, share),
        )

    def of_cart(self, cart: int) -> NDArray[np.bool_]:
        """Return which points (N,) belong to a cart (from 1)."""
        return self.cart == cart - 1


def response_at(
    P: Parametrisation, data: Points, physical: Array
) -> tuple[ComplexArray, ComplexArray]:
    """Return G (N,) at the points and dG/dp (N, n_p) = -Z⁻¹ (∂Z/∂p) Z⁻¹ e_1."""
    s = 1j * data.omega
    b, powers = P.directions, s[:, None] ** P.orders  # (n_p, n), (n_w, n_p)
    Z = ((powers * physical)[:, None, :] * b.T) @ b  # Σ p s^order b bᵀ
    try:
        inverse = np.linalg.inv(Z).astype(np.complex128, copy=False)
    except np.linalg.LinAlgError:  # the fit went astray; NaN makes it step back
        inverse = np.full_like(Z, np.nan)
    G = inverse[:, :, 0]
    stretch = (G @ b.T) * -powers  # (n_w, n_p)
    dG = (inverse @ b.T) * stretch[:, None, :]  # (n_w, n, n_p)
    return G[data.at, data.cart], dG[data.at, data.cart]


def weighted_residuals(
    P: Parametrisation, data: Points, scale: Scale, physical: Array
) -> tuple[Array, Array]:
    """Return the weighted residuals (model minus measured) and their Jacobian with respect to p."""
    G, dG = response_at(P, data, physical)
    r, J = _response_residuals(data, scale, G, dG)
    if not data.decays:
        return r, J
    own, own_J = _decay_residuals(P, data.decays, physical)
    return np.concatenate([r, own]), np.vstack([J, own_J])


def _decay_residuals(
    P: Parametrisation, decays: Mapping[int, Estimate], physical: Array
) -> tuple[Array, Array]:
    """Return the residuals of ln ζ_i from decays, in standard errors, and their Jacobian.

    A residual is model minus measurement. The model is ζ² = c² / 4mk.
    """
    chain = P.chain(physical)
    residuals, jacobian = [], []
    for cart, measured in decays.items():
        i, weight = cart - 1, measured.value / (measured.std or np.inf)
        held = chain.k[i] + chain.k[i + 1]
        by_name = {
            f"c_{cart}": 1 / chain.c[i],
            f"m_{cart}": -0.5 / chain.m[i],
            f"k_{cart}": -0.5 / held,
            f"k_{cart + 1}": -0.5 / held,
        }
        residuals.append(weight * np.log(chain.zeta_carts[i] / measured.value))
        jacobian.append([weight * by_name.get(name, 0.0) for name in P.names])
    return np.array(residuals), np.array(jacobian)


def _response_residuals(
    data: Points, scale: Scale, G: ComplexArray, dG: ComplexArray
) -> tuple[Array, Array]:
    size = np.abs(G)
    radial = (np.conj(G)[:, None] * dG).real / size[:, None]  # d|G|/dp
    if scale == "log":
        weight = data.level_weight
        return weight * (np.log(size) - data.level), (weight / size)[:, None] * radial
    if scale == "magnitude":
        return (size - data.magnitude) / data.std, radial / data.std[:, None]
    known = np.isfinite(data.phase_std)
    turn = (np.conj(G)[:, None] * dG).imag / size[:, None] ** 2  # d arg G / dp
    phase_std = data.phase_std[known]
    return (
        np.concatenate(
            [(size - data.magnitude) / data.std, np.angle(G * data.unit)[known] / phase_std]
        ),
        np.vstack([radial / data.std[:, None], turn[known] / phase_std[:, None]]),
    )


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
