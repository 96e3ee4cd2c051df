"""The chain as a vector for a fit, and its exact response to a measured input.

A fit searches a vector theta of log m, log c and log k, so that no step leaves the physical range
and all entries are of order one. Only the spring wall-1 is not a logarithm, because it may be zero
if the far wall holds the carts, as in the plants of Throne's paper.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array, ComplexArray
from pipeline.errors import DataError
from pipeline.estimation.force_balance import is_even
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.results import Estimate
from pipeline.setup import Setup

# ---------------------------------------------------------------------- chain and fit vector

# Initial damping ratios for carts and modes without a measured one:
START_ZETA = 0.05  # of a single cart; typical of a cart on bearings
ASSUMED_ZETA = 0.1  # of a resonance or a null; the usual guess in Throne's paper
_FARTHEST = 100.0  # largest logarithm; a step that goes astray must not overflow


@dataclass(frozen=True, kw_only=True)
class Parametrisation:
    """Which physical parameters of a chain are free, and how a fit vector holds them.

    Attributes
    ----------
    bench : the carts and springs that exist.
    zero : names of parameters held at zero ("c_2", "k_1"), because a fit moved them to their bound.

    Raises
    ------
    DataError : a spring between two carts is missing, so the motor does not reach the carts
        beyond it.
    """

    bench: Setup
    zero: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for j in range(2, self.n + 1):
            if not self.bench.springs[j - 1]:
                raise DataError(
                    f"the fit needs a spring between carts {j - 1} and {j}, found none: "
                    f"the motor does not move cart {j}; are the springs stated right?"
                )

    @property
    def n(self) -> int:
        """The number of carts."""
        return self.bench.n

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The free parameters, "m_1" … "k_n", in the order of theta and of its covariance."""
        names = [f"{symbol}_{i}" for symbol in "mc" for i in range(1, self.n + 1)]
        names += [f"k_{j}" for j, present in enumerate(self.bench.stiff, start=1) if present]
        return tuple(name for name in names if name not in self.zero)

    @cached_property
    def logarithmic(self) -> NDArray[np.bool_]:
        """Whether each parameter (n_p,) enters as its logarithm; only wall-1 does not."""
        may_vanish = "k_1" if self.n > 1 and f"k_{self.n + 1}" in self.names else None
        return np.array([name != may_vanish for name in self.names])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (n_p,) of theta."""
        return np.where(self.logarithmic, -np.inf, 0.0), np.full(len(self.names), np.inf)

    @cached_property
    def places(self) -> tuple[tuple[str, int], ...]:
        """The free parameters as "m", "c" or "k", with the index within the chain's m, c or k."""
        return tuple(_place(name) for name in self.names)

    @cached_property
    def _places(self) -> NDArray[np.intp]:
        """Index (n_p,) of each free parameter in the flat vector (m, c, k)."""
        offset = {"m": 0, "c": self.n, "k": 2 * self.n}
        return np.array([offset[symbol] + index for symbol, index in self.places], dtype=np.intp)

    def physical(self, chain: Chain) -> Array:
        """Return the free parameters (n_p,) of a chain, in physical units."""
        return np.concatenate([chain.m, chain.c, chain.k])[self._places]

    def chain(self, physical: Array) -> Chain:
        """Return the chain with these free parameters (n_p,) and all others zero."""
        flat = np.zeros(3 * self.n + 1)
        flat[self._places] = physical
        return Chain(m=flat[: self.n], c=flat[self.n : 2 * self.n], k=flat[2 * self.n :])

    def pack(self, chain: Chain) -> Array:
        """Return theta (n_p,) of a chain with positive free parameters (k_1 may be zero)."""
        p = self.physical(chain)
        return np.where(self.logarithmic, np.log(np.where(self.logarithmic, p, 1.0)), p)

    def unpack(self, theta: Array) -> Chain:
        """Return the chain of theta (n_p,)."""
        return self.chain(self._physical_of(theta))

    def _physical_of(self, theta: Array) -> Array:
        exponent = np.clip(np.where(self.logarithmic, theta, 0.0), -_FARTHEST, _FARTHEST)
        return np.where(self.logarithmic, np.exp(exponent), theta)

    def dp_dtheta(self, theta: Array) -> Array:
        """Return dp/dtheta (n_p,): p itself for a logarithm, 1 for the spring wall-1."""
        return np.where(self.logarithmic, self._physical_of(theta), 1.0)

    @cached_property
    def directions(self) -> Array:
        """Rows b (n_p, n): a parameter p enters the impedance matrix as p s^order b bᵀ.

        b selects the cart of a mass or damper, and the stretch of a spring.
        """
        eye = np.eye(self.n)
        stretch = np.diff(np.vstack([np.zeros(self.n), eye, np.zeros(self.n)]), axis=0)
        return np.concatenate([eye, eye, stretch])[self._places]

    @cached_property
    def orders(self) -> NDArray[np.intp]:
        """Power of s for each parameter (n_p,): 2 for a mass, 1 for a damper, 0 for a spring."""
        return np.array(["kcm".index(symbol) for symbol, _ in self.places])

    @cached_property
    def matrix_derivatives(self) -> tuple[Array, Array, Array]:
        """dM/dp, dC/dp, dK/dp, each (n_p, n, n); constant, because the matrices are linear in p."""
        outer = self.directions[:, :, None] * self.directions[:, None, :]
        mass, damping, stiffness = (
            np.where((self.orders == order)[:, None, None], outer, 0.0) for order in (2, 1, 0)
        )
        return mass, damping, stiffness

    def holding_at_zero(self, *names: str) -> "Parametrisation":
        """Return this parametrisation with further parameters held at zero."""
        return replace(self, zero=(*self.zero, *names))


def _place(name: str) -> tuple[str, int]:
    """Return "c" and 1 for "c_2"."""
    read = read_name(name)
    assert read.cart is not None
    return read.symbol, read.cart - 1


def named_estimates(
    chain: Chain, *, names: Sequence[str], covariance: Array, source: str
) -> dict[str, Estimate]:
    """Estimate every named parameter of a chain, with standard errors by the delta method.

    Parameters
    ----------
    names : the physical parameters ("m_1", …) with an error. All others are known exactly.
    covariance : covariance (n_p, n_p) of these parameters, in physical units.

    Returns
    -------
    The estimates by name. A damping of zero is not a measurement, so it is marked as `at_bound`.

    Raises
    ------
    DataError : there are several carts and no spring to a wall, so static gains do not exist.
    """
    values = chain.parameters()
    J = parameter_jacobian(chain, names)
    variance = np.einsum("ij,jk,ik->i", J, covariance, J)
    # A damping ratio up to this limit is zero. The limit is far below any bench's damping, and
    # above the rounding of a pole on the imaginary axis.
    return {
        name: Estimate(value=0.0, std=None, source=source, at_bound=True)
        if read_name(name).is_damping and value <= 1e-10
        else Estimate(value=value, std=float(np.sqrt(v)) if v >= 0 else None, source=source)
        for (name, value), v in zip(values.items(), variance, strict=True)
    }


def parameter_jacobian(chain: Chain, names: Sequence[str]) -> Array:
    """Return the derivative (n_named, n_p) of `Chain.parameters` by the physical parameters."""
    base = np.array(list(chain.parameters().values()))
    columns = []
    for name in names:
        symbol, i = _place(name)
        values: Array = getattr(chain, symbol)
        # With a relative step of 1e-6, the forward difference has an error of 1e-6, and rounding of
        # 1e-9.
        step = 1e-6 * (values[i] or np.max(values) or critical_damping(chain))
        moved = {"m": chain.m.copy(), "c": chain.c.copy(), "k": chain.k.copy()}
        moved[symbol][i] += step
        there = np.array(list(Chain(**moved).parameters().values()))
        columns.append((there - base) / step)
    return np.stack(columns, axis=1)


def critical_damping(chain: Chain) -> float:
    """Return roughly the damping from which a mode no longer swings."""
    m, k = float(np.max(chain.m)), float(np.max(chain.k))
    return float(np.sqrt(m * k)) or m  # without a spring, the damping that stops it within a second


def physical_start(found: Chain, *, bench: Setup, zeta: float = START_ZETA) -> Chain:
    """Return a physically possible chain near the one that a measured table implies.

    `found` may hold impossible values (a negative spring, a mass far too small); these are clipped.
    Dampings are set from `zeta`, because dampings from a table are too uncertain. But a cart
    without a spring keeps its own damping.
    """
    k = np.where(bench.stiff, _raised(found.k), 0.0)
    m = _raised(found.m)
    held = k[:-1] + k[1:]
    return Chain(m=m, c=np.where(held > 0, 2 * zeta * np.sqrt(m * held), found.c), k=k)


def _raised(values: Array) -> Array:
    """Return the values, with the smallest ones raised to a small share of the largest."""
    # A fit must start from a possible chain, so values below 2 % of the largest one are raised.
    return np.maximum(values, 0.02 * np.max(np.abs(values)))


def even_chain(values: Mapping[str, float], *, bench: Setup) -> Chain:
    """Return a chain of equal carts and springs with the gain and mean frequency of `values`.

    It starts a fit if there are too few estimates to compute a chain. `values` needs the first
    cart's gain (`K` or `K_1`) and at least one resonance (`omega_n`, `omega_a`, …).
    """
    omegas = [
        value
        for name, value in values.items()
        if read_name(name).is_frequency and read_name(name).is_mode
    ]
    gain = values.get("K", values.get("K_1"))
    if not omegas or gain is None:
        raise DataError(
            "fit: a start needs the gain of cart 1 and a resonance, "
            f"found {', '.join(values) or 'nothing'}"
        )
    n = bench.n
    unit = Chain(m=np.ones(n), c=np.zeros(n), k=np.array(bench.stiff, dtype=float))
    modes = np.sort(np.abs(unit.poles))[::2]  # each resonance appears twice, as a conjugate pair
    stretch = np.exp(
        np.mean(np.log(np.sort(omegas))) - np.mean(np.log(modes[modes > 0][: len(omegas)]))
    )
    k = unit.static_gains()[0] / gain
    even = Chain(m=unit.m * k / stretch**2, c=unit.c, k=unit.k * k)
    return physical_start(even, bench=bench)


# -------------------------------------------------- the response, mode by mode, with derivatives
#
# In modal coordinates the states are uncoupled: z' = lambda z + b u. So a held input gives an exact
# scalar recursion at any sample times. All derivatives need only one more recursion for each mode
# (the derivative with respect to lambda) and constant matrices.

# Poles closer than this (relative) make the Jacobian inaccurate, by the third power of their
# distance. Additional damping on one cart, too little to show in a record, separates them. It moves
# them apart by twice its square root.
_MEETING = 1e-3
_PARTING = 1e-5


@dataclass(frozen=True, kw_only=True, eq=False)
class Modes:
    """The modes of the free carts, one of each conjugate pair, with derivatives.

    Attributes
    ----------
    poles : poles (n_m,), rad/s.
    shapes : positions (f, n_m) in each mode, doubled for a conjugate pair. So a position is
        Re(shapes @ z).
    entry : (n_m, 2f), with z(0) = entry @ x(0). The state is (x1, v1, x2, v2, …).
    drive : (n_m,) with z' = poles z + drive u.
    d_poles (n_p, n_m), d_shapes (n_p, f, n_m), d_entry (n_p, n_m, 2f), d_drive (n_p, n_m) :
        derivatives with respect to theta.
    """

    poles: ComplexArray
    shapes: ComplexArray
    entry: ComplexArray
    drive: ComplexArray
    d_poles: ComplexArray
    d_shapes: ComplexArray
    d_entry: ComplexArray
    d_drive: ComplexArray


def find_modes(
    chain: Chain, *, free: Sequence[int], parametrisation: Parametrisation, dp_dtheta: Array
) -> Modes:
    """Decompose the free part of a chain into modes.

    `dp_dtheta` (n_p,) comes from `Parametrisation.dp_dtheta`. If two poles meet (a critically
    damped cart), there are no separate modes, and rounding near such a point spoils the
    derivatives. So these poles are moved apart first.
    """
    A, B, _, _ = chain.state_space(free=free)
    if _poles_meet(A):
        first = free[0] - 1
        c = chain.c.copy()
        c[first] *= 1 + _PARTING
        chain = replace(chain, c=c)
        A, B, _, _ = chain.state_space(free=free)
    dA, dB = _state_space_derivatives(chain, free, parametrisation)
    dA, dB = dp_dtheta[:, None, None] * dA, dp_dtheta[:, None] * dB
    poles, V = map(np.asarray, np.linalg.eig(A))  # of a real matrix, so conjugate pairs are exact
    poles, V = poles.astype(np.complex128), V.astype(np.complex128)
    W = np.asarray(np.linalg.inv(V), dtype=np.complex128)
    # No mode of a passive chain grows; a positive real part is rounding error.
    poles = poles - np.maximum(poles.real, 0.0)
    inner = W @ dA @ V
    gap = poles - poles[:, None]
    F = np.divide(inner, gap, out=np.zeros_like(inner), where=gap != 0)
    d_entry: ComplexArray = -(F @ W)
    drive, d_drive = W @ B[:, 0], d_entry @ B[:, 0] + dB @ W.T
    kept = poles.imag >= 0
    pair = np.where(poles[kept].imag > 0, 2.0, 1.0)
    return Modes(
        poles=poles[kept],
        shapes=V[0::2, kept] * pair,
        entry=W[kept],
        drive=drive[kept],
        d_poles=np.einsum("pii->pi", inner)[:, kept],
        d_shapes=(V @ F)[:, 0::2, kept] * pair,
        d_entry=d_entry[:, kept],
        d_drive=d_drive[:, kept],
    )


def _poles_meet(A: Array) -> bool:
    """Return whether two poles are too close to be separate modes."""
    poles = np.linalg.eigvals(A)
    gap = np.abs(poles - poles[:, None]) + np.diag(np.full(poles.size, np.inf))
    return bool(np.min(gap) < _MEETING * np.max(np.abs(poles)))


def _state_space_derivatives(
    chain: Chain, free: Sequence[int], parametrisation: Parametrisation
) -> tuple[Array, Array]:
    """Return dA/dp (n_p, 2f, 2f) and dB/dp (n_p, 2f) for the physical parameters p."""
    rows = [cart - 1 for cart in free]
    mass, damping, stiffness, force = chain.matrices(free=free)
    dM, dC, dK = (d[:, rows][:, :, rows] for d in parametrisation.matrix_derivatives)
    inverse = 1.0 / np.diag(mass)
    d_inverse = -np.einsum("pii->pi", dM) * inverse**2
    dA = np.zeros((dM.shape[0], 2 * len(rows), 2 * len(rows)))
    dA[:, 1::2, 0::2] = -inverse[:, None] * dK - d_inverse[:, :, None] * stiffness
    dA[:, 1::2, 1::2] = -inverse[:, None] * dC - d_inverse[:, :, None] * damping
    dB = np.zeros(dA.shape[:2])
    dB[:, 1::2] = d_inverse * force
    return dA, dB


def drive_modes(poles: ComplexArray, t: Array, u: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return q (n_m, n) at `t` with q' = pole q + u and q(0) = 0, and dq/dpole.

    u (n,) is held from sample to sample. The result is exact for any sample times.
    """
    dt = np.diff(t)
    step = dt[:1] if is_even(t) else dt
    z = poles[:, None] * step
    growth = np.exp(z)
    # Below this |lambda dt| the derivative of expm1(z)/z is computed from its series. Rounding
    # would cause an error of 1e-16/|z|; the error of the series is z²/8.
    small = np.abs(z) < 1e-6
    safe = np.where(small, 1.0, z)
    gain = step * np.where(small, 1 + z / 2, np.expm1(z) / safe)
    d_gain = step**2 * np.where(small, 0.5 + z / 3, (safe * growth - np.expm1(z)) / safe**2)
    q = _accumulate(growth, np.asarray(gain * u[:-1], dtype=np.complex128))
    dq = _accumulate(growth, step * growth * q[:, :-1] + d_gain * u[:-1])
    return q, dq


def _accumulate(growth: ComplexArray, forced: ComplexArray) -> ComplexArray:
    """Return q (n_m, n) with q[0] = 0 and q[i + 1] = growth[i] q[i] + forced[i].

    The values are found by doubling: after s steps, each entry holds the sum over its last 2^s
    inputs. `growth` is (n_m, 1) for uniform sample times, otherwise (n_m, n - 1).
    """
    q = np.zeros((forced.shape[0], forced.shape[1] + 1), dtype=np.complex128)
    total = q[:, 1:]
    total[:] = forced
    shift = 1
    while shift < total.shape[1]:
        total[:, shift:] += growth[:, -total.shape[1] + shift :] * total[:, :-shift]
        if growth.shape[1] == 1:
            growth = growth**2
        else:
            growth = np.concatenate(
                [growth[:, :shift], growth[:, shift:] * growth[:, :-shift]], axis=1
            )
        shift *= 2
    return q
