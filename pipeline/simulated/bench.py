"""A simulated bench: the motion of its carts in one run, and its encoder readings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import ConfigError
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, EffectTerm
from pipeline.plant.sampled_loop import LoopSetup, StateFeedback, simulate_loop
from pipeline.plant.simulate import propagate, simulate_linear
from pipeline.plant.simulator.tables import Cart
from pipeline.results import ExperimentKind

# The servo loop and the encoder of the ECP 210.
SAMPLE_TIME = 0.00884  # s
COUNT = 0.00227  # cm

# A hand trembles by hundredths of a millimetre at these rates, so it does not hold like a clamp.
_TREMOR_HZ = np.array([1.3, 4.1, 8.7])
_TREMOR_AMPLITUDE = np.array([4e-3, 2e-3, 1e-3])  # as a share of the distance from rest
_SHORTEST_STEP = 1e-5  # s; with steps this short, a session takes half an hour to simulate


@dataclass(frozen=True, kw_only=True)
class ReleasingHand:
    """A hand that holds one cart away from its rest position and lets it go.

    Attributes
    ----------
    position : where the hand holds the cart, in position units from rest.
    release, fade : in s. The hand's force falls linearly from time `release` to zero within `fade`.
    tremor : (3,) phases of the hand's trembling, rad.
    """

    cart: int
    position: float
    release: float
    fade: float
    tremor: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def hold(self, t: Array) -> tuple[Array, Array]:
        """Return the position (n,) and velocity (n,) of the cart in the hand."""
        rate = 2 * np.pi * _TREMOR_HZ
        phase = np.multiply.outer(np.asarray(t), rate) + np.array(self.tremor)
        position = self.position * (1.0 + np.sin(phase) @ _TREMOR_AMPLITUDE)
        return position, self.position * (np.cos(phase) @ (_TREMOR_AMPLITUDE * rate))


@dataclass(frozen=True, kw_only=True, eq=False)
class BenchRun:
    """One run: its input, its free carts and its hand.

    Attributes
    ----------
    t, u : (n,) time in s, and input, which is held between samples. In closed loop the bench
        computes u itself.
    frequency : frequency of a sine dwell, Hz.
    reference, controller, input_limit : settings of a closed loop; the controlled cart is `cart`.
    keep_from : time in s at which the recording and its clock start.
    """

    id: str
    kind: ExperimentKind
    t: Array
    u: Array
    free: tuple[int, ...]
    note: str = ""
    hand: ReleasingHand | None = None
    frequency: float | None = None
    cart: int | None = None
    reference: Array | None = None
    controller: StateFeedback | None = None
    input_limit: float | None = None
    keep_from: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueMotion:
    """The true input (n,), and the positions (n_carts, n) relative to rest.

    If a sensor has a scale error, the positions include it.
    """

    u: Array
    x: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulatedBench:
    """A plant with hidden effects, its encoders and its controller's clock.

    Attributes
    ----------
    name : name of the preset or of the model's file; may be empty.
    effects : effects beyond the linear chain. Without effects nothing is compiled.
    effect_sentences : one sentence for each effect, with its parameters. The submission never
        contains them.
    travel : intended motion of the carts, in position units.
    count : encoder step, in position units.
    input_limit : largest input, in input units.
    sample_time : sample time of the controller, the input and the log, in s.
    noise_counts : standard deviation of a free cart's encoder noise. With 0.2, the reading flickers
        between two counts.
    zero_error_counts : largest error, in counts, of an encoder's zero, which is set by hand.
    """

    chain: Chain
    name: str = ""
    effects: tuple[EffectTerm, ...] = ()
    effect_sentences: tuple[str, ...] = ()
    position_unit: str = "cm"
    input_unit: str = "V"
    travel: float = 1.0
    count: float = COUNT
    input_limit: float = 5.0
    sample_time: float = SAMPLE_TIME
    noise_counts: float = 0.2
    zero_error_counts: float = 2.0

    def refuse_endless(self) -> None:
        """Refuse effects so stiff, or masses so small, that the simulation would take too long.

        Raises
        ------
        ConfigError : the simulation would take too long.
        """
        if not self.effects:
            return
        from pipeline.plant.augmented import SteppedBench

        model = AugmentedChain(chain=self.chain, terms=self.effects)
        step = SteppedBench(model, x0=np.zeros(self.chain.n)).shortest_step
        if step < _SHORTEST_STEP:
            raise ConfigError(
                f"{self.name}: with these effects a simulation needs steps of {step:.1g} s, and "
                f"steps below {_SHORTEST_STEP:g} s take too long: a stiffness is too large, or a "
                "mass too small"
            )

    def move(self, run: BenchRun) -> TrueMotion:
        """Return the motion of the carts; only this function contains the law of motion.

        Raises
        ------
        DataError : the effects make the simulation diverge.
        """
        chain, x = self.chain, np.zeros((self.chain.n, run.t.size))
        rows = [cart - 1 for cart in run.free]
        model = AugmentedChain(chain=chain, terms=self.effects)
        if run.controller is not None and run.reference is not None:
            plant = None
            if self.effects:
                from pipeline.plant.augmented import SteppedBench

                plant = SteppedBench(model, free=run.free)
            loop = simulate_loop(
                chain,
                run.controller,
                t=run.t,
                reference=run.reference,
                start=plant,
                setup=LoopSetup(
                    sample_time=self.sample_time,
                    input_limit=run.input_limit,
                    encoder_step=self.count,
                    # The encoders are zeroed where the carts rest.
                    rest=-plant.state[0::2] if plant else 0.0,
                    free=run.free,
                ),
            )
            x[rows] = loop.x
            return TrueMotion(u=loop.u, x=x)
        if self.effects and run.hand is not None:
            return TrueMotion(u=run.u, x=_release_with_effects(model, run, run.hand))
        if self.effects:
            from pipeline.plant.augmented import simulate_augmented

            return TrueMotion(u=run.u, x=simulate_augmented(model, run.t, run.u, free=run.free))
        if run.hand is not None:
            x[rows] = _release(chain, run.t, run.hand, free=run.free)
        else:
            x[rows] = simulate_linear(chain, run.t, run.u, free=run.free)
        return TrueMotion(u=run.u, x=x)

    def read(self, motion: TrueMotion, *, run: BenchRun, rng: np.random.Generator) -> Array:
        """Return the encoder readings (n_carts, n), whole counts in position units."""
        n_carts, n = motion.x.shape
        error = self.zero_error_counts * self.count
        zero = rng.uniform(-error, error, size=(n_carts, 1))
        if run.controller is not None:
            zero[:] = 0.0  # the controller needs its zero at rest
        shaken = np.isin(np.arange(1, n_carts + 1), run.free)[:, None]
        noise = self.noise_counts * self.count
        x = motion.x + zero + noise * shaken * rng.standard_normal((n_carts, n))
        return self.count * np.round(x / self.count)


def _release(chain: Chain, t: Array, hand: ReleasingHand, *, free: Sequence[int]) -> Array:
    """Return the positions (f, n) of the free carts before and after a hand releases one.

    Until the hand lets go, all other carts are at rest. At the release, the hand's force balances
    the springs, and then it fades. So the decay begins gradually, as with a real hand, and not with
    a step.
    """
    A, B, C, _ = chain.state_space(free=free)
    row = sorted(free).index(hand.cart)
    start = int(np.searchsorted(t, hand.release))
    x = np.zeros((len(free), t.size))
    x[row], _ = hand.hold(t)
    position, velocity = hand.hold(t[start])
    state = np.zeros(A.shape[0])
    state[2 * row : 2 * row + 2] = position, velocity
    push = np.zeros_like(B)
    push[2 * row + 1] = 1.0 / chain.m[hand.cart - 1]
    stiffness = chain.k[hand.cart - 1] + chain.k[hand.cart]
    force = stiffness * position * np.clip(1 - (t[start:] - t[start]) / hand.fade, 0.0, 1.0)
    x[:, start:] = C @ propagate(A, push, t[start:], force, x0=state, linear=True)
    return x


def _release_with_effects(model: AugmentedChain, run: BenchRun, hand: ReleasingHand) -> Array:
    """Return the readings (n_carts, n) of all carts, as `_release` does, but with effects.

    The hand pulls the cart out before the recording starts, which sets the state of friction and of
    hidden masses. The cart then follows the hand's tremor, and is released as in the linear chain.
    """
    from pipeline.plant.augmented import SteppedBench

    hand = before_stop(hand, model)
    bench, t, cart = SteppedBench(model, free=run.free), run.t, hand.cart
    start = int(np.searchsorted(t, hand.release))
    x = np.zeros((model.chain.n, t.size))
    # A hand takes 1.5 s to pull a cart out, before the recording starts.
    pull = np.linspace(0.0, np.pi, round(1.5 / float(t[1] - t[0])))
    path = np.append(hand.hold(t[0])[0] * (1 - np.cos(pull)) / 2, hand.hold(t[: start + 1])[0])
    for sample, position in enumerate(path, start=-pull.size):
        bench.move_by_hand(cart, to=float(position), interval=float(t[1] - t[0]))
        if sample >= 0:
            x[:, sample] = bench.readings
    force = bench.release(cart, velocity=float(hand.hold(t[start])[1]))
    ramp = force * np.clip(1 - (t - t[start]) / hand.fade, 0.0, 1.0)
    for sample in range(start, t.size - 1):
        # Between the samples the force falls linearly, in ten short steps.
        steps = 10 if ramp[sample] != 0.0 else 1  # while the hand's force falls
        for share in (np.arange(steps) + 0.5) / steps:
            push = float((1 - share) * ramp[sample] + share * ramp[sample + 1])
            bench.push(cart, push)
            bench.step(0.0, following=0.0, interval=float(t[sample + 1] - t[sample]) / steps)
            bench.push(cart, -push)
        x[:, sample + 1] = bench.readings
    return x


def before_stop(hand: ReleasingHand, model: AugmentedChain) -> ReleasingHand:
    """Return the hand, moved so that it holds its cart before any end stop."""
    row = model.tables()[0][hand.cart - 1]
    stiff = row[Cart.END_STOP_STIFFNESS] > model.chain.stiffness[hand.cart - 1, hand.cart - 1]
    # A hand pulls a cart to at most 0.9 of the way to its end stop.
    furthest = 0.9 * float(row[Cart.END_STOP_POSITION])
    beyond = hand.position * furthest > furthest**2
    return replace(hand, position=furthest) if stiff and beyond else hand
