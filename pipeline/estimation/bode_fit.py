"""Fit one chain to the frequency responses of all carts at once.

The stage-by-stage result is turned into a physical chain. Then all carts are fitted together: first
on a logarithmic scale to come near, then by maximum likelihood, with each point's standard error.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline import names
from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.least_squares import MOST_EVALUATIONS, minimise
from pipeline.estimation.parametrisation import (
    Parametrisation,
    even_chain,
    named_estimates,
    physical_start,
)
from pipeline.plant.chain import Chain, quadratic_factors
from pipeline.plant.identities import recover_chain
from pipeline.results import EXPLAINED, ChainFit, Estimate, FrequencyResponse
from pipeline.setup import Setup

# ------------------------------------------------- all measured points, and the chain's response

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
        # A phase with a standard error above 0.5 rad is not used.
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


# ------------------------------------------------------------- Throne's way: the last cart first
#
# The last cart's transfer function has no zeros, so its fit gives the common denominator. Each cart
# before it then adds its gain and its zeros. Only magnitudes are used, on a logarithmic scale.
#
# Reference: Throne (2005), sections on the two and three degree of freedom systems.

_FARTHEST = 50.0  # bound of a logarithm, so that a step that goes astray does not overflow


def fit_stage_by_stage(
    data: Points, *, n: int, initial: Mapping[str, float], like: Chain
) -> tuple[Chain, dict[str, float]]:
    """Fit the transfer functions cart by cart, cart n first; return the chain and its parameters.

    The stiffnesses of the chain may be negative.

    Parameters
    ----------
    data : the measured points. A missing cart keeps its start values.
    initial : the named parameters to start from, as far as they are known.
    like : a chain that gives start values for all other parameters.
    """
    known = {**like.parameters(), **initial}
    gains = np.array([known[names.gain_name(i, n=n)] for i in range(1, n + 1)])
    factors = [_start(known, i, n=n, like=like) for i in range(n)]
    for cart in range(n, 0, -1):
        i = cart % n  # T_1, the denominator, comes with the last cart
        gains[cart - 1], factors[i] = _fit(
            data, gains[cart - 1], factors[i], cart=cart, denominator=factors[0] if i else None
        )
    found = recover_chain(gains, [_polynomial(factor) for factor in factors]).chain()
    return found, _named(gains, factors, found)


def _start(known: Mapping[str, float], i: int, *, n: int, like: Chain) -> Array:
    """Return ln omega and ln zeta (2, n - i) from which the fit of T_{i+1} starts.

    They belong to the poles for i = 0, otherwise to the zeros of cart i.
    """
    roots = like.poles if i == 0 else like.zeros(i)
    omega, zeta = quadratic_factors(roots)
    for j, suffix in enumerate(_suffixes(i, n=n)):
        omega[j] = known.get(f"omega_{suffix}", omega[j])
        zeta[j] = known.get(names.mode_zeta(suffix), zeta[j])
    # From damping ratios outside this range, the fit does not converge.
    return np.log([omega, np.clip(zeta, 0.01, 1.0)])


def _suffixes(i: int, *, n: int) -> list[str]:
    """Return the suffixes that Throne's tables give to T_{i+1}'s quadratic factors, if any."""
    if i == 0:
        return names.mode_suffixes(n)
    if i == n - 1:
        return [str(n)]
    return list(names.NULLS) if n == 3 else []


def _fit(
    data: Points, gain: float, factors: Array, *, cart: int, denominator: Array | None
) -> tuple[float, Array]:
    """Fit ln|G| = ln K ± Σ ln|Q_j| (less the known denominator) of a cart; Q = 1 - r² + 2jζr."""
    of = data.of_cart(cart)
    omega, target, weight = data.omega[data.at[of]], data.level[of], data.level_weight[of]
    power = -1 if denominator is None else 1
    if denominator is not None:
        target = target + _log_factors(omega, denominator)[0]
    shape = factors.shape

    def evaluate(theta: Array) -> tuple[Array, Array]:
        level, jacobian = _log_factors(omega, theta[1:].reshape(shape))
        columns = np.hstack([np.ones((omega.size, 1)), power * jacobian])
        residual = theta[0] + power * level - target
        return weight * residual, weight[:, None] * columns

    start = np.concatenate([[np.log(gain)], factors.ravel()])
    if omega.size < start.size:
        return gain, factors  # too few points for this stage; the joint fit sees all carts
    found = minimise(evaluate, start).x
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


def _named(gains: Array, factors: list[Array], found: Chain) -> dict[str, float]:
    """Return the fitted values by name, and the frequencies of single carts of the chain.

    A frequency that does not exist is left out.
    """
    n = gains.size
    values = {names.gain_name(i, n=n): float(gain) for i, gain in enumerate(gains, start=1)}
    for i, factor in enumerate(factors):
        order = np.argsort(factor[0])
        for suffix, omega, zeta in zip(_suffixes(i, n=n), *np.exp(factor[:, order]), strict=False):
            values[f"omega_{suffix}"] = float(omega)
            values[names.mode_zeta(suffix)] = float(zeta)
    for i in range(1, n if n > 1 else 0):
        stiffness = found.k[i - 1] + found.k[i]
        if stiffness > 0 and found.m[i - 1] > 0:
            omega = float(np.sqrt(stiffness / found.m[i - 1]))
            values[names.own_omega(i, n=n)] = omega
            values[names.own_zeta(i, n=n)] = float(found.c[i - 1] / (2 * found.m[i - 1] * omega))
    return values


# ---------------------------------------------------------------------- the joint fit

_START_SPREAD = 0.5  # standard deviation of ln m and ln k in random starts
_NEAR, _PRECISION = 1e-3, 1e-8  # relative change of the cost at the end of the first and last fit
_SHARES, _SHARE_PRECISION = (1e-6, 10.0), 0.01  # bounds and precision of an added error


def fit_bode(
    responses: Sequence[FrequencyResponse],
    *,
    bench: Setup,
    initial: Mapping[str, float] | None = None,
    decays: Mapping[int, Estimate] | None = None,
    near: Chain | None = None,
) -> ChainFit:
    """Fit the chain of n carts to measured frequency responses; carts may be missing.

    Phases are used if they agree with the magnitudes. Without more magnitudes than parameters, they
    are used without this check.

    If the data put a parameter at or below zero, it is held at zero and the others are fitted
    again. A few dwells next to a sharp peak may put a damping at zero. Then the damping ratios of
    decays become further points of the fit, if they do not contradict the dwells.

    If the misfit is larger than the points' standard errors allow, the chain does not describe the
    bench that precisely. Then the same relative error is added to all points until it does, and the
    chain is fitted once more. `chi_square_per_dof` and `standardised` still use the stated errors.
    For a table without errors, standard errors follow from the misfit in any case.

    Parameters
    ----------
    responses : measured responses of the carts, with or without phases.
    bench : the carts and springs of the bench.
    initial : named parameters to start from, if known.
    decays : each cart's own damping ratio, used only if the responses put it at zero.
    near : a similar chain from an earlier fit, which is then the only start.

    Returns
    -------
    The fit. Its `standardised` has the magnitude residuals by cart ("1", "2", …).

    Raises
    ------
    DataError : there are too few amplitudes and phases for the parameters, the responses do not
        determine them, or no start succeeds.
    """
    P, n = Parametrisation(bench=bench), bench.n
    data = Points.collect(responses, n=n)
    if data.size + data.n_phases <= len(P.names):
        raise DataError(
            f"Bode fit: {n} cart{'s'[: n > 1]} with {len(P.names)} parameters need more "
            f"than {len(P.names)} amplitudes and phases, found {data.size} and {data.n_phases}"
        )
    known = {name: value for name, value in (initial or {}).items() if value > 0}
    like = _stand_in(data, known, bench=bench)
    if near is None:
        staged, first = _staged_start(data, known, bench=bench, like=like)
        starts = itertools.chain([first], _random_starts(like, bench=bench))
    else:
        staged, starts = {}, (physical_start(near, bench=bench),)
    best, tried = _fit_from_starts(P, data, starts)
    best, remark = _fit_phases(best, data)
    best, share = _widen(best, data)
    best, used = _hold_vanished(best, data.widened(share), decays or {})
    data = replace(data, decays=used.decays)
    fit = _result(best, data, share=share, staged=staged, tried=tried, remark=remark)
    runs = [run for response in responses for run in response.experiments]
    runs += [run for decay in data.decays.values() for run in decay.experiments]
    return replace(fit, experiments=tuple(dict.fromkeys(runs)))


# ---------------------------------------------------------------------- starts


def _stand_in(data: Points, known: Mapping[str, float], *, bench: Setup) -> Chain:
    """Return a chain of equal carts with the right gain and mean frequency."""
    first = np.flatnonzero(data.cart == np.min(data.cart))
    lowest = first[np.argmin(data.omega[data.at[first]])]
    highest = first[np.argmax(data.omega[data.at[first]])]
    if bench.rigid:
        omega = data.omega[data.at[highest]]
        m = 1.0 / (np.exp(data.level[highest]) * omega**2)
        return Chain(m=np.array([m]), c=np.array([0.1 * m * omega]), k=np.zeros(2))
    speed = np.exp(data.level[first]) * data.omega[data.at[first]]
    start = dict(known)
    if "omega_n" not in known:
        start.setdefault("omega_a", float(data.omega[data.at[first[np.argmax(speed)]]]))
    if "K" not in known:
        start.setdefault("K_1", float(np.exp(data.level[lowest])))
    return even_chain(start, bench=bench)


def _staged_start(
    data: Points, known: Mapping[str, float], *, bench: Setup, like: Chain
) -> tuple[dict[str, float], Chain]:
    """Return the parameters of the fit stage by stage, and a possible chain near its chain."""
    if not any(bench.springs):
        return {}, like
    found, staged = fit_stage_by_stage(data, n=bench.n, initial=known, like=like)
    return staged, physical_start(found, bench=bench)


def _random_starts(like: Chain, *, bench: Setup) -> Iterator[Chain]:
    # Any seed will do, but it must always be the same.
    rng = np.random.default_rng(2005)
    # Eight random starts, tried if the first start does not explain the data.
    for _ in range(8):
        m = like.m * np.exp(_START_SPREAD * rng.standard_normal(like.m.shape))
        k = like.k * np.exp(_START_SPREAD * rng.standard_normal(like.k.shape))
        zeta = float(np.exp(rng.uniform(*np.log([0.02, 0.3]))))
        yield physical_start(Chain(m=m, c=like.c, k=k), bench=bench, zeta=zeta)


# ------------------------------------------------------------------------ fits


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fitted:
    parametrisation: Parametrisation
    theta: Array
    scale: Scale
    chi_square: float
    dof: int
    converged: bool

    @property
    def chain(self) -> Chain:
        return self.parametrisation.unpack(self.theta)

    @property
    def chi_square_per_dof(self) -> float:
        """χ² per degree of freedom: near 1 for a good fit, near 0 with too few magnitudes."""
        return self.chi_square / max(self.dof, 1)


def _solve(P: Parametrisation, data: Points, theta: Array, scale: Scale) -> _Fitted:
    def evaluate(theta: Array) -> tuple[Array, Array]:
        r, J = weighted_residuals(P, data, scale, P.physical(P.unpack(theta)))
        J = J * P.dp_dtheta(theta)
        if not np.isfinite(np.sum(J**2)):  # without a Jacobian no step could follow
            r = np.full_like(r, np.nan)
        return r, J

    # A bad step may overflow; `least_squares` then takes a shorter one.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        if not np.isfinite(np.sum(evaluate(theta)[0] ** 2)):
            raise DataError("Bode fit: no chain comes near these responses; they differ too much")
        solution = minimise(
            evaluate,
            theta,
            scale="jac",
            tolerance=_NEAR if scale == "log" else _PRECISION,
        )
    return _Fitted(
        parametrisation=P,
        theta=solution.x,
        scale=scale,
        chi_square=2 * float(solution.cost),
        dof=solution.fun.size - theta.size,
        converged=bool(solution.status > 0),
    )


def _fit_from_starts(
    P: Parametrisation, data: Points, starts: Iterable[Chain]
) -> tuple[_Fitted, int]:
    """Try starts until one explains the data; return the best fit and the number of starts."""
    fits: list[_Fitted] = []
    failed: list[DataError] = []
    for start in starts:
        try:
            near = _solve(P, data, P.pack(start), "log")
            fits.append(_solve(P, data, near.theta, "magnitude"))
        except DataError as error:
            failed.append(error)
            continue
        if fits[-1].chi_square_per_dof <= EXPLAINED:
            break
    if not fits:
        raise failed[0]
    return min(fits, key=lambda fit: fit.chi_square), len(fits) + len(failed)


def _fit_phases(fitted: _Fitted, data: Points) -> tuple[_Fitted, str]:
    """Fit again with the phases, if there are any and they agree with the magnitudes."""
    if not data.n_phases:
        return fitted, ""
    # Phases are rejected if they are this many times as far off as magnitudes, for example because
    # of a delay. With only as many magnitudes as parameters, the fit does not predict phases.
    limit = 3.0 * max(1.0, fitted.chi_square_per_dof**0.5)
    if fitted.dof > 0 and _phase_misfit(fitted, data) > limit:
        return fitted, "only magnitudes are fitted: the phases do not agree with them"
    return _solve(fitted.parametrisation, data, fitted.theta, "polar"), ""


def _widen(fitted: _Fitted, data: Points) -> tuple[_Fitted, float]:
    """Return a fit with the relative error that explains the misfit, and this error (or 0)."""
    excess = fitted.chi_square_per_dof - 1
    # χ² may exceed its mean by 3.1 standard deviations; by chance this happens once in a thousand.
    if data.from_table or excess <= 3.1 * np.sqrt(2 / fitted.dof):
        return fitted, 0.0
    share = 0.0
    # Fit and required error are computed in turn, which converges to a percent in three rounds.
    for _ in range(3):
        share = _missing_share(fitted, data)
        widened = data.widened(share)
        fitted = _solve(fitted.parametrisation, widened, fitted.theta, fitted.scale)
    return fitted, share


def _missing_share(fitted: _Fitted, data: Points) -> float:
    """Return the relative error that lowers χ² to its degrees of freedom, by bisection."""
    low, high = -np.log(_SHARES[1]), -np.log(_SHARES[0])
    while high - low > _SHARE_PRECISION:
        middle = (low + high) / 2
        if _chi_square(fitted, data.widened(np.exp(-middle))) < fitted.dof:
            low = middle
        else:
            high = middle
    return float(np.exp(-low))


def _chi_square(fitted: _Fitted, data: Points) -> float:
    P = fitted.parametrisation
    r, _ = weighted_residuals(P, data, fitted.scale, P.physical(fitted.chain))
    return float(np.sum(r**2))


def _hold_vanished(
    fitted: _Fitted, data: Points, decays: Mapping[int, Estimate]
) -> tuple[_Fitted, Points]:
    """Fit again with those parameters held at zero that the data put at or below zero.

    If a decay gives a damping that the data put at zero, all decays join the fit, because points
    that do not determine one damping say little about the others. Also return the points, with the
    decays in the fit.
    """
    P, chain = fitted.parametrisation, fitted.chain
    sizes = _natural_sizes(P, chain, data)
    # A damping or far spring has vanished below 1e-4 of its usual size, and k_1 below zero.
    vanished = [
        name
        for name, value, size in zip(P.names, P.physical(chain), sizes, strict=True)
        if value < (0.0 if name == "k_1" else 1e-4 * size)
    ]
    if not vanished:
        return fitted, data
    needed = {cart: zeta for cart, zeta in decays.items() if f"c_{cart}" in vanished}
    k = chain.k[:-1] + chain.k[1:]  # not positive if k_1 is below zero; then decays are not used
    for dampings in (decays, needed) if needed and np.all(k > 0) else ():
        c = chain.c.copy()
        for cart, zeta in dampings.items():
            c[cart - 1] = 2 * zeta.value * np.sqrt(chain.m[cart - 1] * k[cart - 1])
        damped = {f"c_{cart}" for cart in dampings}
        held = P.holding_at_zero(*(name for name in vanished if name not in damped))
        along = replace(data, decays=dampings)
        both = _solve(held, along, held.pack(replace(chain, c=c)), fitted.scale)
        # Each decay may add up to 9 to χ², which is three standard errors.
        if both.chi_square < fitted.chi_square + 9.0 * len(dampings):
            return _hold_vanished(both, along, {})
    held = P.holding_at_zero(*vanished)
    return _hold_vanished(_solve(held, data, held.pack(chain), fitted.scale), data, {})


def _natural_sizes(P: Parametrisation, chain: Chain, data: Points) -> Array:
    """Return the natural size of each parameter (n_p,): m, m ω for a damping, the largest k."""
    middle = float(np.median(data.omega[data.omega > 0]))
    sizes = {"m": chain.m, "c": chain.m * middle, "k": np.full(chain.n + 1, np.max(chain.k))}
    return np.array([sizes[symbol][place] for symbol, place in P.places])


def _phase_misfit(fitted: _Fitted, data: Points) -> float:
    """Return the rms distance of the measured phases from the fit's, in standard errors."""
    P = fitted.parametrisation
    G, _ = response_at(P, data, P.physical(fitted.chain))
    known = np.isfinite(data.phase_std)
    off = np.angle(G * data.unit)[known] / data.phase_std[known]
    return float(np.sqrt(np.mean(off**2)))


# ---------------------------------------------------------------------- result


def _result(
    fitted: _Fitted,
    data: Points,
    *,
    share: float,
    staged: dict[str, float],
    tried: int,
    remark: str,
) -> ChainFit:
    P, chain = fitted.parametrisation, fitted.chain
    fitted_names, covariance = _covariance(P, chain, data.widened(share), fitted.scale)
    chi_square_per_dof = _chi_square(fitted, data) / fitted.dof
    if data.from_table:
        covariance *= chi_square_per_dof
    G, _ = response_at(P, data, P.physical(chain))
    standardised = (data.magnitude - np.abs(G)) / data.std
    remarks = [remark, *(f"{name} is held at zero" for name in P.zero)]
    dampers = [f"c_{cart}" for cart in data.decays]
    if dampers:
        remarks.append(
            "the frequency response alone puts a damping at zero, so the fit also uses the damping "
            f"ratios of decays ({', '.join(dampers)})"
        )
    parameters = named_estimates(
        chain, names=fitted_names, covariance=covariance, source="bode_fit"
    )
    for cart in data.decays:
        name = names.own_zeta(cart, n=chain.n)
        parameters[name] = replace(parameters[name], source=data.decays[cart].source)
    if share > 0:
        remarks.append(
            f"the points are {100 * share:.2g} % away from the model, more than their errors "
            "allow; the standard errors of the parameters include this"
        )
    if not fitted.converged:
        remarks.append(f"not converged after {MOST_EVALUATIONS} evaluations")
    return ChainFit(
        method="bode_fit",
        chain=chain,
        names=fitted_names,
        covariance=covariance,
        at_bound=(*P.zero, *dampers),
        parameters=parameters,
        staged=staged,
        chi_square_per_dof=chi_square_per_dof,
        dof=fitted.dof,
        n_points=data.size,
        n_starts=tried,
        converged=fitted.converged,
        message="; ".join(text for text in remarks if text),
        misfit=share,
        standardised={
            str(cart + 1): standardised[data.cart == cart] for cart in np.unique(data.cart)
        },
    )


def _covariance(
    P: Parametrisation, chain: Chain, data: Points, scale: Scale
) -> tuple[tuple[str, ...], Array]:
    """Return the covariance (n_p, n_p) of the physical parameters, and their names.

    A damping that is held at zero is included if the data give its standard error, because every
    cart has some damping. Numbers that depend on it must not look more certain than it is. A
    spring, however, may really be missing.
    """
    springs = tuple(name for name in P.zero if names.read_name(name).symbol == "k")
    for Q in (replace(P, zero=springs), P):
        sizes = _natural_sizes(Q, chain, data)
        _, J = weighted_residuals(Q, data, scale, Q.physical(chain))
        _, singular, V = np.linalg.svd(J * sizes, full_matrices=False)
        # Limit on the smallest singular value over the largest, with columns in natural sizes.
        if singular[-1] >= 1e-8 * singular[0]:
            root = (V / singular[:, None]) * sizes
            return Q.names, root.T @ root
    listed = ", ".join(str(cart) for cart in np.unique(data.cart) + 1)
    raise DataError(
        f"Bode fit: the response of cart {listed} does not determine all of {', '.join(P.names)}"
    )
