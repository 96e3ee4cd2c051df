"""The data of the Bode fit: all measured points in one array, and the chain's response to them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.parametrisation import Parametrisation
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
