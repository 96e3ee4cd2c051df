"""A chain as its controller sees it: sampled, in scaled units, with its energies."""

from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.linear.chain import Chain
from pipeline.plant.loop.robustness import stays_stable
from pipeline.plant.loop.sampled_loop import RADIANS_PER_STEP, StateFeedback, discretise


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
