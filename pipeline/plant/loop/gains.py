"""Gains of sampled state feedback: with the least quadratic cost, or with given poles."""

import numpy as np
from scipy.linalg import hessenberg

from pipeline.arrays import Array, ComplexArray


def lqr_gains(phi: Array, gamma: Array, weights: Array) -> Array:
    """Return the gains (…, n) that minimise the sum of x'Qx + u² for each Q in `weights` (…, n, n).

    This is the doubling algorithm: after i steps, H is the cost of the next 2^i samples. Many
    weights at once take little more time than one.

    Raises
    ------
    LinAlgError : the plant's numbers differ by too many orders of magnitude.

    Reference: E. K. Chu, H. Fan, W. Lin, Linear Algebra Appl. 396 (2005) 55-80.
    """
    eye = np.eye(gamma.size)
    A, H = np.broadcast_to(phi, weights.shape), weights
    G = np.broadcast_to(np.outer(gamma, gamma), weights.shape)
    for _ in range(60):  # after 2^60 samples, no loop depends on its start
        W, A_transposed = np.linalg.inv(eye + G @ H), np.swapaxes(A, -1, -2)
        more = A_transposed @ H @ W @ A
        G, A, H = G + A @ W @ G @ A_transposed, A @ W @ A, H + more
        if np.abs(more).max() <= np.finfo(float).eps * np.abs(H).max():
            break
    H_gamma = H @ gamma
    return (H_gamma @ phi) / (1 + H_gamma @ gamma)[..., None]


def place_poles(phi: Array, gamma: Array, poles: ComplexArray) -> Array:
    """Return the gains G (…, n) with which phi - gamma G has the `poles` (…, n).

    Complex poles must come in conjugate pairs. In Hessenberg form, the input reaches one state
    after the other. So the gains follow from the last row of the desired characteristic polynomial,
    evaluated at phi. No controllability matrix has to be inverted.

    Reference: B. N. Datta, Linear Algebra Appl. 88 (1987) 207-226.
    """
    rotation, beta = np.linalg.qr(gamma[:, None], mode="complete")
    H, basis = hessenberg(rotation.T @ phi @ rotation, calc_q=True)
    row = np.zeros(poles.shape, dtype=np.complex128)
    row[..., -1] = 1.0
    for i in range(gamma.size):
        row = row @ H - poles[..., i, None] * row
    reach = beta[0, 0] * np.prod(np.diag(H, -1))
    return row.real / reach @ basis.T @ rotation.T
