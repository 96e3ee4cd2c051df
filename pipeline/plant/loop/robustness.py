"""The behaviour of a feedback loop on plants that differ from the model."""

import numpy as np
from scipy.linalg import hadamard

from pipeline.arrays import Array
from pipeline.plant import limits
from pipeline.plant.linear.chain import Chain
from pipeline.plant.loop.sampled_loop import StateFeedback, loop_matrix


def stays_stable(chain: Chain, controller: StateFeedback, *, sample_time: float) -> bool:
    """Return whether the loop is stable on all plants within the errors of identification.

    A two-level screening design, together with its mirror image, gives 32 plants. They cover every
    main effect of the errors and many combinations, for up to four carts.

    Reference: R. L. Plackett, J. P. Burman, Biometrika 33 (1946) 305-325.
    """
    n = chain.n
    signs = hadamard(16)[:, 1 : 3 * n + 2]  # the first column is constant
    matrices = []
    for sign in np.vstack([signs, -signs]):
        stiff, heavy, damped = np.split(sign, [n + 1, 2 * n + 1])
        plant = Chain(
            m=chain.m * (1 + limits.MASS_SPRING_ERROR * heavy),
            c=chain.c * (1 + limits.DAMPING_ERROR * damped),
            k=chain.k * (1 + limits.MASS_SPRING_ERROR * stiff),
        )
        matrices.append(loop_matrix(plant, controller, sample_time=sample_time))
    return bool(np.abs(np.linalg.eigvals(np.array(matrices))).max() < 1.0)


def level_error_percent(chain: Chain, gains: Array, *, cart: int) -> Array:
    """Return how far errors in the springs move a cart's steady position, for gains (…, 2n).

    The result is in percent of the steady position, to first order, with the errors of all springs
    in the worst direction.
    """
    inverse = _compliance(chain, gains)
    x = inverse[..., :, 0]
    # Spring j adds k_j (e_j - e_{j-1})(e_j - e_{j-1})' to the stiffness, where e_j is the unit
    # vector of cart j, or zero for a wall.
    ends = np.diff(np.eye(chain.n + 2)[1:-1], axis=1)  # (n, n + 1), one column per spring
    moved = chain.k * (x @ ends) * (inverse[..., cart - 1, :] @ ends)
    return 100 * limits.MASS_SPRING_ERROR * np.abs(moved).sum(-1) / np.abs(x[..., cart - 1])


def static_levels(chain: Chain, gains: Array) -> Array:
    """Return the steady positions (…, n) of all carts under gains (…, 2n), per unit of input."""
    return _compliance(chain, gains)[..., :, 0]


def _compliance(chain: Chain, gains: Array) -> Array:
    """Return the inverse (…, n, n) of the stiffness under feedback."""
    fed_back = np.eye(chain.n)[:, :1] * gains[..., None, 0::2]
    return np.asarray(np.linalg.inv(chain.stiffness + fed_back), dtype=np.float64)
