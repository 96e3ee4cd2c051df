"""Simulate the chain with effects: whole runs at once, or sample by sample under a controller.

The results are sensor readings, so scale errors of sensors are included. Importing this module
loads numba, which the linear chain never needs.
"""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.simulator import kernel
from pipeline.plant.simulator.generated_forces import hysteresis, longest_step, shaped_input
from pipeline.plant.simulator.kernel import advance, contact_gap, smooth_forces, toggle_contact
from pipeline.plant.simulator.sensitivity import Push, make_sensitivities
from pipeline.plant.simulator.tables import DRY, Cart, Drive, Spring, Tables

_RUN_AWAY = "with these effects the carts diverge: a spring softens too much, or a force is huge"


def simulate_augmented(
    model: AugmentedChain,
    t: Array,
    u: Array,
    *,
    free: Sequence[int] | None = None,
    x0: Array | None = None,
) -> Array:
    """Simulate one run that starts without velocity.

    Parameters
    ----------
    t, u : times (n,) in s, and input (n,), held from sample to sample.
    free : numbers of the carts that move; all by default. The others are held at zero.
    x0 : positions (n_carts,) at the start. By default the rest positions.

    Returns
    -------
    readings (n_carts, n).

    Raises
    ------
    DataError : the simulation diverges.
    """
    n = model.chain.n
    free = _all(n) if free is None else free
    x0 = rest_positions(model, free=free) if x0 is None else np.asarray(x0, dtype=np.float64)
    # The steps are smaller than usual, because other results are judged by this one.
    return _simulate(model.tables(), t, u, free=free, x0=x0, refine=4.0)


def rest_positions(model: AugmentedChain, *, free: Sequence[int] | None = None) -> Array:
    """Return the positions (n_carts,) at which the carts rest without input and dry friction.

    The carts are released at zero, with dampings so large that they creep to their rest. If no
    spring connects the carts to a wall, they can rest anywhere, so they stay at zero.
    """
    tables, n = model.tables(), model.chain.n
    cart = tables.cart
    pulled = np.any(cart[:, Cart.FORCE_OFFSET_FORCE]) or tables.drive[Drive.COGGING_FORCE] != 0.0
    if not (pulled and model.chain.is_tied):
        return np.zeros(n)
    cart[:, DRY] = 0.0
    cart[:, Cart.SENSOR_GAIN_GAIN] = 1.0
    stiffness, m = model.chain.stiffness, model.chain.m
    cart[:, Cart.DAMPING] = 2.0 * np.sqrt(np.diag(stiffness) * m)
    slowest = np.sqrt(np.linalg.eigvals(stiffness / m[:, None]).real.min())
    # After 40 periods of the slowest motion, with heavy damping, the start has no influence.
    t = np.array([0.0, 40.0 * 2 * np.pi / slowest])
    free = _all(n) if free is None else free
    return _simulate(tables, t, np.zeros(2), free=free, x0=np.zeros(n), refine=1.0)[:, -1]


def _simulate(
    tables: Tables, t: Array, u: Array, *, free: Sequence[int], x0: Array, refine: float
) -> Array:
    run = kernel.describe_run(t, u, free=np.isin(_all(x0.size), free))._replace(refine=refine)
    start = kernel.StartState(x0[None], np.zeros((1, x0.size)), np.ones(x0.size))
    (y,), _ = kernel.simulate([(tables, start)], run)
    if not np.all(np.isfinite(y)):
        raise DataError(_RUN_AWAY)
    return y


def _all(n: int) -> tuple[int, ...]:
    return tuple(range(1, n + 1))


def compile_simulator() -> None:
    """Run the simulator once, which compiles it in ten seconds unless compiled code is stored."""
    chain = Chain(m=np.ones(1), c=np.ones(1), k=np.array([1.0, 0.0]))
    simulate_augmented(AugmentedChain(chain=chain), np.array([0.0, 0.01]), np.zeros(2))


class SteppedBench:
    """A bench that advances by one interval at a time and keeps all of its state.

    Friction, contacts, hidden masses, the delay line and the drive's lag keep their state between
    calls. A person's hand may move a cart, release it, or push it.
    """

    def __init__(
        self, model: AugmentedChain, *, free: Sequence[int] | None = None, x0: Array | None = None
    ) -> None:
        """Put the bench at rest at `x0` (n_carts,), by default at its rest positions."""
        n = model.chain.n
        free = _all(n) if free is None else sorted(set(free))
        x0 = rest_positions(model, free=free) if x0 is None else np.asarray(x0, dtype=np.float64)
        self._tables = model.tables()
        self._n, self._rows = n, [cart - 1 for cart in free]
        self._free = np.isin(_all(n), free)
        self._bodies = bodies = kernel.assemble(self._tables, self._free)
        self._state = bodies.s
        self._inverse_mass = self._state[kernel.INV].copy()
        self._state[kernel.X, :n] = np.where(self._free, x0, 0.0)
        for i in range(n, bodies.N):
            parent = 0 if i == bodies.motor else bodies.parent[i]
            self._state[kernel.X, i] = self._state[kernel.X, parent]
        self._no_lanes = make_sensitivities(kernel.NO_LANES, bodies.N)
        self._step, contact_step = self._step_lengths()
        self._push = Push(
            u=0.0,
            on=0.0,
            h=self._step,
            scatter=np.ones(n),
            dry=bool(np.any(self._tables.cart[:, DRY])),
            smooth=longest_step(*self._tables)[1],
            contact_step=contact_step,
        )
        for e, which in enumerate(bodies.switches):
            if contact_gap(which, False, self._tables, bodies.s, 0.0) > 0.0:  # closed at the start
                bodies.active[e] = True
                toggle_contact(which, 1.0, self._tables, bodies.s, bodies.K, bodies.C)
        # Presliding friction balances the forces at rest, if it can.
        net = self._static_forces()
        most = np.array([hysteresis(self._tables.cart, i, 0.0)[0] for i in range(n)])
        for i in np.flatnonzero(most):
            self._state[kernel.Z, i] = np.clip(net[i] / most[i], -1.0, 1.0)
        self._now = 0.0
        self._inputs: deque[tuple[float, float]] = deque([(-np.inf, 0.0)])
        self._lagged = 0.0

    # ------------------------------------------------------------------ its readings

    @property
    def readings(self) -> Array:
        """The readings (n_carts,) of all carts' sensors."""
        return self._tables.cart[:, Cart.SENSOR_GAIN_GAIN] * self._state[kernel.X, : self._n]

    @property
    def state(self) -> Array:
        """State of the free carts as sensors would read it: (x1, v1, x2, v2, …), (2f,)."""
        gains = self._tables.cart[:, Cart.SENSOR_GAIN_GAIN]
        return (gains * self._state[: kernel.V + 1, : self._n])[:, self._rows].T.ravel()

    @property
    def shortest_step(self) -> float:
        """The longest substep allowed where the bench is stiffest, s."""
        return min(self._step, self._push.contact_step)

    # ------------------------------------------------------------------ its motion

    def step(self, u: float, *, following: float, interval: float) -> None:
        """Advance by `interval` s under the input `u`; `following` is the next input.

        The next input is needed if the motor acts before its logged input (a negative delay).

        Raises
        ------
        DataError : the simulation diverges, or the motor acts earlier by more than the interval.
        """
        if -self._tables.drive[Drive.INPUT_DELAY_DELAY] > interval * (1 + 1e-9):
            raise DataError("in a closed loop the input cannot lead its log by more than a sample")
        self._inputs.append((self._now, shaped_input(self._tables.drive, u)))
        upcoming = (self._now + interval, shaped_input(self._tables.drive, following))
        on = 1.0 if u != 0.0 else 0.0
        count = max(1, int(np.ceil(interval / self._step - 1e-9)))
        h = interval / count
        for sub in range(count):
            start = self._now + sub * h
            push = self._push._replace(u=self._force(start, start + h, upcoming), on=on, h=h)
            advance(self._tables, self._bodies, push, self._no_lanes)
        self._now += interval
        begin = self._now - self._tables.drive[Drive.INPUT_DELAY_DELAY]
        while len(self._inputs) > 1 and self._inputs[1][0] <= begin:
            self._inputs.popleft()
        if not np.all(np.abs(self._state[kernel.X]) < kernel._BLOWN_UP):
            raise DataError(_RUN_AWAY)

    def move_by_hand(self, cart: int, *, to: float, interval: float) -> None:
        """Move one cart by hand to a position within `interval` s.

        The other free carts are held meanwhile.
        """
        # No force moves a carried cart, but its friction acts on the hand.
        self._state[kernel.INV, self._rows] = 1e-30
        self._state[kernel.V, self._rows] = 0.0
        self._state[kernel.V, cart - 1] = (to - self._state[kernel.X, cart - 1]) / interval
        self.step(0.0, following=0.0, interval=interval)

    def release(self, cart: int, *, velocity: float) -> float:
        """Release all free carts, and give `cart` an initial velocity.

        Return the force that held this cart against its springs.
        """
        self._state[kernel.INV] = self._inverse_mass
        self._state[kernel.V, self._rows] = 0.0
        self._state[kernel.V, cart - 1] = velocity
        return -float(self._static_forces()[cart - 1])

    def push(self, cart: int, force: float) -> None:
        """Add a constant force on one cart; the same force with opposite sign removes it."""
        self._state[kernel.FIX, cart - 1] += force

    # ------------------------------------------------------------------ private parts

    def _force(self, start: float, end: float, upcoming: tuple[float, float]) -> float:
        """Return the exact mean, from `start` to `end`, of the input after delay and lag."""
        if self._lagged == 0.0 and upcoming[1] == 0.0 and not any(u for _, u in self._inputs):
            return 0.0
        delay = float(self._tables.drive[Drive.INPUT_DELAY_DELAY])
        inputs = [*self._inputs, upcoming, (np.inf, 0.0)]
        mean = 0.0
        for (since, value), (until, _) in pairwise(inputs):
            overlap = min(end - delay, until) - max(start - delay, since)
            mean += value * max(overlap, 0.0) / (end - start)
        lag = float(self._tables.drive[Drive.ACTUATOR_LAG_TIME_CONSTANT])
        if lag > 0.0:
            decay = float(np.exp(-(end - start) / lag))
            target, off = mean, self._lagged - mean
            mean = target + off * lag / (end - start) * (1.0 - decay)
            self._lagged = target + off * decay
        return mean

    def _static_forces(self) -> Array:
        """Return the forces on all bodies except friction and the drive, at zero velocity."""
        s = self._state
        s[kernel.MID_X], s[kernel.MID_V], s[kernel.FORCE] = s[kernel.X], 0.0, s[kernel.FIX]
        smooth_forces(self._tables, self._bodies, 0.0, 0.0, self._push.smooth)
        return s[kernel.FORCE] - self._bodies.K @ s[kernel.X]

    def _step_lengths(self) -> tuple[float, float]:
        """Return the longest substep, and the longest inside a contact, s."""
        bodies, tables = self._bodies, self._tables
        inverse, N = self._inverse_mass[: bodies.N], bodies.N
        change = 1.0 + max(float(tables.spring[:, Spring.SLACK_SPRING_STIFFNESS_CHANGE].max()), 0.0)
        fastest = float(np.max(np.abs(bodies.K[:N, :N]).sum(1) * inverse)) * change
        damped = float(np.max(np.abs(bodies.C[:N, :N]).sum(1) * inverse))
        step = min(5e-4, kernel._SERIES_REACH / np.sqrt(max(fastest, 1e-12)))
        # A light hidden mass may be damped faster than it swings.
        step = min(step, 1.0 / max(damped, 1e-12))
        contact = float(np.max(tables.cart[:, Cart.END_STOP_STIFFNESS] * inverse[: self._n]))
        if bodies.motor >= 0:
            both = float(inverse[0] + inverse[bodies.motor])
            contact = max(contact, tables.drive[Drive.BACKLASH_CONTACT_STIFFNESS] * both)
        return step, kernel._CONTACT_REACH / np.sqrt(contact) if contact > 0.0 else step
