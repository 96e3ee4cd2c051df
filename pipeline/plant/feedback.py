"""Design state feedback: gains, the sampled plant they act on, and how far plants may differ."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import hadamard, hessenberg

from pipeline.arrays import Array, ComplexArray
from pipeline.plant import limits
from pipeline.plant.chain import Chain
from pipeline.plant.sampled_loop import RADIANS_PER_STEP, StateFeedback, discretise, loop_matrix


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


@dataclass(frozen=True, kw_only=True, eq=False)
class SampledPlant:
    """The sampled plant in scaled units: v is divided by `rate`, u by `stiffness`."""

    chain: Chain
    cart: int
    sample_time: float
    rate: float  # rad/s
    stiffness: float  # input unit per position unit
    phi: Array  # (2n, 2n)
    gamma: Array  # (2n,)

    @classmethod
    def of(
        cls, chain: Chain, *, cart: int, settling: float, sample_time: float | None
    ) -> "SampledPlant":
        """Sample a chain fast enough for its modes and for the desired settling time (s)."""
        speeds = np.maximum(np.abs(chain.poles), 4 / settling)
        rate = float(np.exp(np.log(speeds).mean()))
        if sample_time is None:
            # The laboratory controller's sample time, or less if modes are fast, or if the loop
            # would settle in less than 25 samples.
            sample_time = min(0.00884, RADIANS_PER_STEP / speeds.max(), settling / 25)
        tied = chain.k[0] > 0 or chain.k[-1] > 0
        stiffness = 1 / chain.static_gains()[0] if tied else chain.m.sum() * rate**2
        phi, gamma = discretise(chain, sample_time)
        if not (np.all(np.isfinite(phi)) and np.all(np.isfinite(gamma * stiffness))):
            raise np.linalg.LinAlgError("the sampled plant is not finite")
        unit = np.tile([1.0, rate], chain.n)
        return cls(
            chain=chain,
            cart=cart,
            sample_time=float(sample_time),
            rate=rate,
            stiffness=float(stiffness),
            phi=phi * unit / unit[:, None],
            gamma=gamma * stiffness / unit,
        )

    @property
    def row(self) -> int:
        """The index of the state that is the position of the cart."""
        return 2 * (self.cart - 1)

    def to_units(self, gains: Array) -> Array:
        """Return gains (…, 2n) in input unit per position unit and per (position unit/s)."""
        return gains * self.stiffness / np.tile([1.0, self.rate], self.chain.n)

    def cost_to_units(self, weights: Array) -> Array:
        """Return Q of the cost in which the input's square has the weight 1/stiffness."""
        unit = np.tile([1.0, self.rate], self.chain.n)
        return self.stiffness * weights / np.outer(unit, unit)

    def after(self, share: float) -> tuple[Array, Array]:
        """Return phi and gamma, in scaled units, for a share of the sample time."""
        phi, gamma = discretise(self.chain, share * self.sample_time)
        unit = np.tile([1.0, self.rate], self.chain.n)
        return phi * unit / unit[:, None], gamma * self.stiffness / unit

    def stays_stable(self, gains: Array) -> bool:
        """Whether the loop with these unscaled gains tolerates the usual errors of the chain."""
        controller = StateFeedback(gains=gains, prefilter=1.0, model=self.chain)
        return stays_stable(self.chain, controller, sample_time=self.sample_time)


def energy_weights(plant: SampledPlant, weights: Array) -> Array:
    """Return Q (n_candidates, 2n, 2n) for all pairs of weights on potential and kinetic energy.

    The input's square has the weight R = 1.
    """
    chain, n = plant.chain, plant.chain.n
    stiffness = chain.stiffness / plant.stiffness
    if chain.k[0] == chain.k[-1] == 0:
        # Without a spring to a wall, the mean position is weighted as if a spring held it.
        stiffness = stiffness + np.ones((n, n)) / n**2
    potential, kinetic = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    potential[0::2, 0::2] = stiffness
    kinetic[1::2, 1::2] = np.diag(chain.m) * plant.rate**2 / plant.stiffness
    alpha, beta = (w.ravel()[:, None, None] for w in np.meshgrid(weights, weights, indexing="ij"))
    return alpha * potential + beta * kinetic
