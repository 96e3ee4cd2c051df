"""The exact response of a chain to a measured input, computed mode by mode, with derivatives.

In modal coordinates the states are uncoupled: z' = lambda z + b u. So a held input gives an exact
scalar recursion at any sample times. All derivatives need only one more recursion for each mode
(the derivative with respect to lambda) and constant matrices.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Array, ComplexArray
from pipeline.estimation.modulating import is_even
from pipeline.estimation.parametrisation import Parametrisation
from pipeline.plant.chain import Chain

# Below this |lambda dt| the derivative of expm1(z)/z is computed from its series. Rounding would
# cause an error of 1e-16/|z|; the error of the series is z²/8.
_SMALL_EXPONENT = 1e-6
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
    small = np.abs(z) < _SMALL_EXPONENT
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
