"""The carts of a virtual bench: a preset with hidden effects, hands and encoders."""

import math
from collections.abc import Generator

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.augmented import SteppedBench
from pipeline.plant.effect import AugmentedChain
from pipeline.protocol import FULL_SCALE, Hands
from pipeline.simulated.bench import ReleasingHand, SimulatedBench, before_stop

TRUE_PERIOD = 1.0024e-3  # s between ticks, although the controller assumes 1 ms
REACH = 12.0  # full duty moves the carts by this many travels, so 1 cm is some 300 duty counts
FEWEST_ENCODERS = 2  # a line has two counts, even for a single cart

_NOISE = 0.2  # counts of noise on a free cart's encoder, which flickers between two counts


class VirtualCarts:
    """Carts that move under a motor and hands, one tick at a time.

    Parameters
    ----------
    seed : seed of the encoders' noise, the hands' tremor and the times of release.
    period : s between ticks.

    Attributes
    ----------
    encoders : number of encoders, at least two. Those without a cart stay at zero.
    """

    def __init__(self, bench: SimulatedBench, *, seed: int, period: float = TRUE_PERIOD) -> None:
        self._bench, self._period = bench, period
        self._model = AugmentedChain(chain=bench.chain, terms=bench.effects)
        self._noise_rng, self._hand_rng = np.random.default_rng(seed).spawn(2)
        n = bench.chain.n
        self.encoders = max(FEWEST_ENCODERS, n)
        self.input_per_count = input_per_count(bench)
        # At power-on, an encoder is at a random position between two counts.
        self._phase = self._noise_rng.uniform(-0.5, 0.5, size=n)
        self.take_in_hand(Hands())

    def counts(self) -> tuple[int, ...]:
        """Return the encoder counts since power-on."""
        noise = next(self._noise, None)
        if noise is None:
            block = self._noise_rng.standard_normal((1024, self._shaken.size))
            self._noise = iter(_NOISE * block * self._shaken)
            noise = next(self._noise)
        exact = self._plant.readings / self._bench.count + self._phase + noise
        spare = self.encoders - exact.size
        return (*np.rint(exact).astype(int).tolist(), *(0,) * spare)

    def move(self, duty: int) -> None:
        """Advance by one tick under the motor's duty.

        Raises
        ------
        DataError : the hidden effects make the simulation diverge.
        """
        if self._hand is not None:
            try:
                next(self._hand)
                return
            except StopIteration:
                self._hand = None
        u = duty * self.input_per_count
        self._plant.step(u, following=u, interval=self._period)

    def take_in_hand(self, hands: Hands) -> None:
        """Bring all carts to rest; hold some, and pull one out for release in the next run."""
        self._started = False
        n = self._bench.chain.n
        free = [cart for cart in range(1, n + 1) if cart not in hands.held]
        self._shaken = np.isin(np.arange(1, n + 1), free).astype(float)
        self._noise = iter(np.empty((0, n)))
        self._plant = SteppedBench(self._model, free=free)
        self._hand = self._lead(hands.released) if hands.released in free else None

    def start(self) -> None:
        """Tell the hands that a run starts."""
        self._started = True

    def _lead(self, cart: int) -> Generator[None]:
        """Pull a cart out, hold it until a run has begun, then let go; one tick per step."""
        rng = self._hand_rng
        tremor = rng.uniform(0.0, 2 * np.pi, size=3)
        hand = before_stop(
            ReleasingHand(
                cart=cart,
                position=rng.choice([-1.0, 1.0]) * rng.uniform(1.2, 1.8) * self._bench.travel,
                release=float(rng.uniform(0.3, 0.6)),  # s after the start of a run
                fade=float(rng.uniform(0.01, 0.03)),  # s in which its force falls
                tremor=(float(tremor[0]), float(tremor[1]), float(tremor[2])),
            ),
            self._model,
        )
        out, _ = hand.hold(np.zeros(1))
        for angle in np.linspace(0.0, math.pi, math.ceil(1.5 / self._period)):
            yield self._carry(cart, out * (1.0 - math.cos(angle)) / 2.0)
        held, left = np.zeros(1), hand.release
        while left > 0.0:
            held += self._period
            left -= self._period * self._started
            yield self._carry(cart, hand.hold(held)[0])
        force = self._plant.release(cart, velocity=float(hand.hold(held)[1][0]))
        ticks = math.ceil(hand.fade / self._period)
        for tick in range(ticks):
            # The force of a tick is the mean of the linear fall over this tick.
            push = force * (1.0 - (tick + 0.5) / ticks)
            self._plant.push(cart, push)
            yield self._plant.step(0.0, following=0.0, interval=self._period)
            self._plant.push(cart, -push)

    def _carry(self, cart: int, to: Array) -> None:
        self._plant.move_by_hand(cart, to=float(to[0]), interval=self._period)


def input_per_count(bench: SimulatedBench) -> float:
    """Return input units per duty count: full scale is 5 times a power of ten.

    Full-scale input would hold the carts at some ten times the travel, so the travel is hundreds of
    duty counts.
    """
    hold = bench.travel / float(np.max(np.abs(bench.chain.static_gains())))
    return 5.0 * 10.0 ** round(math.log10(REACH * hold / 5.0)) / FULL_SCALE
