"""Simulate the plant under a sampled controller, exactly between the samples.

The controller's clock ticks every `sample_time`. At tick k it does the following, in this order.

1. Read every free cart's encoder: y = x + rest, rounded to `encoder_step`.
2. Compute the effort from y and the reference (see below), then clip it to ± `input_limit`.
3. Apply the effort. With `delay` 1 it acts from tick k + 1 to k + 2, because the computer needs
   one sample to compute it. With `delay` 0 it acts from tick k to k + 1. Before the first effort
   the input is zero.

**State feedback.** The effort is prefilter r - gains · [x1, v1, x2, v2, …]. Positions are the
readings. Velocities come from an alpha-beta observer with alpha 1. It uses the prediction that was
made at the last tick:

    v = v_predicted + (VELOCITY_CORRECTION / sample_time) (y - x_predicted).

With a `model`, the prediction for the next tick is exact and includes the acting input. Without a
model it is x + sample_time v with v unchanged, so v is a filtered difference of the readings. With
`delay` 1 the gains multiply the prediction, which is the state at the moment when the effort begins
to act. So the delay needs no further gain. The poles of the delayed loop are those of the loop
without delay, and one more at z = 0. The observer starts at the first reading, at rest.

**PID.** The effort is scale (kp e + ki ∫e + kd de/dt) with e = r - y of one cart, in the units of
the readings. The integral is the sum of e · sample_time up to this tick. The derivative is the
change of e since the last tick, divided by sample_time. Before the first tick e is zero, so a
reference that is already on at the first tick causes a kick.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from pipeline.arrays import Array, frozen_array
from pipeline.errors import DataError
from pipeline.plant.chain import Chain

# Share of the prediction error that corrects the velocity at a tick. One half keeps three quarters
# of the encoder's rounding noise out of v, and corrects a wrong initial velocity in a few ticks.
VELOCITY_CORRECTION = 0.5
# The fastest mode may turn by this much (rad) from one simulated point to the next: about 12 points
# per period.
RADIANS_PER_STEP = 0.5
_MOST_PARTS = 100  # of a sample; with more, the input acts on a motion that has long decayed
MOST_TICKS = 200_000  # ticks per run: over three minutes at 1 kHz, simulated in some seconds


@dataclass(frozen=True, kw_only=True, eq=False)
class StateFeedback:
    """State feedback: effort = prefilter r - gains [x1, v1, x2, v2, …].

    Attributes
    ----------
    gains : gains (2f,) of the f free carts, input unit per position unit and per (position unit/s).
    model : the plant with which the observer predicts. Without a model, the observer
        assumes constant velocity.
    """

    gains: Array
    prefilter: float
    model: Chain | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "gains", frozen_array(self.gains, name="gains"))


@dataclass(frozen=True, kw_only=True)
class Pid:
    """PID control of one cart: effort = scale (kp e + ki ∫e + kd de/dt), e = r - y."""

    kp: float = 0.0
    ki: float = 0.0
    kd: float = 0.0
    scale: float = 1.0
    cart: int = 1


Controller = StateFeedback | Pid


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopRun:
    """A simulated run.

    Attributes
    ----------
    t : times (n,), s.
    x : readings (f, n) of the free carts. They include the rest position, but no encoder rounding.
    u : effort (n,) that acts from each time on, clipped like the input in a bench's log.
    """

    t: Array
    x: Array
    u: Array


class MovingPlant(Protocol):
    """A plant that may replace the chain in a loop; it keeps its own state."""

    @property
    def state(self) -> Array:
        """State (x1, v1, x2, v2, …) of the free carts as read by the sensors, (2f,)."""
        ...

    def step(self, u: float, *, following: float, interval: float) -> None:
        """Advance by `interval` s under the input `u`; `following` is the next input."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopSetup:
    """The connection of controller and carts.

    Attributes
    ----------
    sample_time : sample time of the controller, s. By default the mean interval of the run.
    delay : number of ticks from a reading to the effort computed from it, 0 or 1.
    input_limit : the effort is clipped to ± this limit.
    drive : force on cart 1 per unit of effort. It differs from 1 if the
        log has a wrong sign or scale.
    encoder_step : step to which the controller's readings are rounded, one number or (f,).
    rest : readings of the carts at rest without input, one number or (f,).
    free : numbers of the carts that move; all by default.
    """

    sample_time: float | None = None
    delay: int = 1
    input_limit: float | None = None
    drive: float = 1.0
    encoder_step: Array | float | None = None
    rest: Array | float = 0.0
    free: Sequence[int] | None = None

    def read(self, x: Array) -> Array:
        """Return the readings that the controller gets for the positions (f,)."""
        y, step = x + self.rest, self.encoder_step
        if step is None:
            return y
        coarse = np.asarray(step) > 0
        np.divide(y, step, out=y, where=coarse)
        np.rint(y, out=y, where=coarse)
        return np.multiply(y, step, out=y, where=coarse)


def simulate_loop(
    chain: Chain,
    controller: Controller,
    *,
    t: Array,
    reference: Array | float,
    setup: LoopSetup = LoopSetup(),
    start: Array | MovingPlant | None = None,
) -> LoopRun:
    """Simulate the free carts under a sampled controller.

    Parameters
    ----------
    t : times (n,) of the result, s, ascending. The run begins at t[0].
    reference : set point, in the units of the readings; one number, or (n,) values at `t`.
    start : initial state (2f,), (x1, v1, x2, v2, …), relative to the rest; at rest by default. A
        plant in its present state may be given instead, and then replaces the chain.

    Raises
    ------
    DataError : the controller does not fit the free carts, or the run has too many ticks.
    """
    t = np.asarray(t, dtype=np.float64)
    free = tuple(sorted(set(range(1, chain.n + 1) if setup.free is None else setup.free)))
    interval = (t[-1] - t[0]) / (t.size - 1)
    T = interval if setup.sample_time is None else setup.sample_time
    check_ticks(float(t[-1] - t[0]), T)
    # Time stamps are rounded and jitter, so an instant belongs to the nearest sample.
    ticks = np.arange(int(np.floor((t[-1] - t[0]) / T + 0.5)) + 2)
    r = np.broadcast_to(np.asarray(reference, dtype=np.float64), t.shape)
    nearest = np.searchsorted((t[1:] + t[:-1]) / 2, t[0] + T * ticks)
    plant = None if isinstance(start, np.ndarray) else start
    x = start if isinstance(start, np.ndarray) else np.zeros(2 * len(free))
    x = x if plant is None else plant.state
    law = _law(controller, free=free, sample_time=T, y0=setup.read(x[0::2]), delay=setup.delay)
    phi, gamma = discretise(chain, T, free=free)
    limit, drive = np.inf if setup.input_limit is None else setup.input_limit, setup.drive
    # One product advances carts, controller and effort, because many small ones take longer.
    moves, n = _block(phi, law.moves), x.size
    moves[:n, -1] = drive * gamma if setup.delay else 0.0
    late = np.append(drive * gamma, law.late)
    now = np.concatenate([x, law.start, np.zeros(len(free) + 2)])
    readings = slice(late.size, -2)
    states, efforts, acting = np.empty((ticks.size, n)), np.empty(ticks.size), 0.0
    for tick, set_point in enumerate(r[nearest].tolist()):
        now[readings] = setup.read(now[0:n:2])
        now[-2] = set_point
        states[tick] = now[:n]
        following = moves @ now
        asked = min(max(float(following[-1]), -limit), limit)
        now[: late.size] = following[:-1]
        if not setup.delay:
            now[: late.size] += late * asked
        efforts[tick] = applied = acting if setup.delay else asked
        now[-1] = acting = asked
        if plant is not None:
            plant.step(drive * applied, following=drive * asked, interval=T)
            now[:n] = plant.state

    elapsed = (t - t[0]) / T
    parts = 1 if plant else parts_per_sample(chain, T, free=free)
    between = np.empty((ticks.size, parts, n))
    between[:, 0] = states
    for part in range(1, parts):
        phi, gamma = discretise(chain, T * part / parts, free=free)
        between[:, part] = states @ phi.T + drive * efforts[:, None] * gamma
    states = between.reshape(-1, n)
    x = _hermite(parts * elapsed, states[:, 0::2].T, T / parts * states[:, 1::2].T)
    held = np.floor(elapsed + 0.5 * min(1.0, interval / T)).astype(int)
    return LoopRun(t=t, x=x + np.reshape(setup.rest, (-1, 1)), u=efforts[held])


def parts_per_sample(chain: Chain, sample_time: float, *, free: Sequence[int] | None = None) -> int:
    """Return in how many parts a sample must be divided to show the motion between the ticks."""
    A, *_ = chain.state_space(free=free)
    turn = float(np.abs(np.linalg.eigvals(A)).max()) * sample_time
    return int(np.clip(np.ceil(turn / RADIANS_PER_STEP), 1, _MOST_PARTS))


def check_ticks(duration: float, sample_time: float) -> None:
    """Raise DataError if a run has more ticks than a simulation can handle."""
    if not duration <= MOST_TICKS * sample_time:
        raise DataError(
            f"a loop can be simulated over at most {MOST_TICKS:,} samples, found "
            f"{duration / sample_time:.3g}: {duration:.3g} s at {sample_time:.3g} s per sample"
        )


def replay(
    controller: Controller, *, t: Array, y: Array, reference: Array, free: Sequence[int]
) -> Array:
    """Return the effort (n,) that the controller computes at each reading of a recorded run.

    `y` (f, n) are the readings of the `free` carts. Efforts are neither delayed nor clipped, and
    the observer predicts without an input. The result is the response of the stated control law to
    the actual motion, for comparison with the logged input.
    """
    T = float(t[-1] - t[0]) / (t.size - 1)
    law = _law(controller, free=tuple(free), sample_time=T, y0=y[:, 0], delay=0)
    now = np.concatenate([law.start, np.zeros(len(y) + 2)])
    known = np.vstack([y, reference]).T
    efforts, n = np.empty(t.size), law.start.size
    for i in range(t.size):
        now[n:-1] = known[i]
        following = law.moves @ now
        now[:n], efforts[i] = following[:-1], following[-1]
    return efforts


def discretise(
    chain: Chain, sample_time: float, *, free: Sequence[int] | None = None
) -> tuple[Array, Array]:
    """Return Phi (2f, 2f) and Gamma (2f,) of the free carts for an input held over a sample."""
    from scipy.linalg import expm  # takes a tenth of a second, so it is imported here

    A, B, _, _ = chain.state_space(free=free)
    size = A.shape[0]
    augmented = np.zeros((size + 1, size + 1))
    augmented[:size, :size], augmented[:size, size] = A, B[:, 0]
    phi = np.asarray(expm(augmented * sample_time), dtype=np.float64)
    return phi[:size, :size], phi[:size, size]


def broken_loop(
    chain: Chain, controller: StateFeedback, *, sample_time: float
) -> tuple[Array, Array, Array]:
    """Return A, B and C, of size 4n + 1, of the loop cut where the effort drives cart 1.

    They describe the step from one tick to the next, from a force on cart 1 to minus the effort.
    The state is (x, prediction, acting effort). All carts are free, the delay is one tick, nothing
    is clipped or rounded, and the reference is zero.
    """
    A, gamma = _opened(chain, controller, sample_time=sample_time, delay=1)
    rest = np.zeros(len(A) - gamma.size)
    return A, np.append(gamma, rest), np.append(np.zeros(len(A) - 1), -1.0)


def loop_matrix(chain: Chain, controller: Controller, *, sample_time: float) -> Array:
    """Return the matrix that maps the loop's state to the next tick.

    The state is (x, prediction, acting effort), (4n + 1,), for state feedback with a delay of one
    tick, and (x, ∫e, last e) for a PID without delay. The loop is stable if and only if all
    eigenvalues lie inside the unit circle. Without an integral gain, ∫e has no effect and is left
    out.
    """
    if isinstance(controller, StateFeedback):
        A, B, C = broken_loop(chain, controller, sample_time=sample_time)
        return A - np.outer(B, C)
    A, gamma = _opened(chain, controller, sample_time=sample_time, delay=0)
    A[: gamma.size] += np.outer(gamma, A[-1])
    kept = np.delete(np.arange(len(A) - 1), [] if controller.ki else [gamma.size])
    return A[np.ix_(kept, kept)]


def _opened(
    chain: Chain, controller: Controller, *, sample_time: float, delay: int
) -> tuple[Array, Array]:
    """Return the matrix of (x, controller's state, effort) if no effort acts, and Gamma."""
    phi, gamma = discretise(chain, sample_time)
    free = tuple(range(1, chain.n + 1))
    law = _law(controller, free=free, sample_time=sample_time, y0=np.zeros(chain.n), delay=delay)
    size, own = gamma.size, law.start.size
    # The law's columns are its state, readings, reference and acting effort.
    by_state, by_reading, by_effort = np.split(law.moves, [own, own + chain.n], axis=1)
    A = np.zeros((size + own + 1, size + own + 1))
    A[:size, :size] = phi
    A[size:, 0:size:2] = by_reading
    A[size:, size:-1], A[size:, -1] = by_state, by_effort[:, -1]
    return A, gamma


# ------------------------------------------------------------------- private parts


@dataclass(frozen=True, kw_only=True, eq=False)
class _Law:
    """A controller with a state c, as a linear system.

    Attributes
    ----------
    start : state (n_c,) before the first tick.
    moves : matrix (n_c + 1, n_c + f + 2) from c, readings, reference and acting effort to the next
        c and the effort.
    late : what the applied effort adds to the next c, if this effort acts at once (n_c,).
    """

    start: Array
    moves: Array
    late: Array


def _law(
    controller: Controller, *, free: tuple[int, ...], sample_time: float, y0: Array, delay: int
) -> _Law:
    if isinstance(controller, Pid):
        if controller.cart not in free:
            raise DataError(f"PID needs cart {controller.cart} to be free, found free {list(free)}")
        return _pid_law(controller, free.index(controller.cart), sample_time, n=len(free))
    n = len(free)
    phi, gamma = _prediction(controller, free=free, sample_time=sample_time)
    # The observer takes its positions from the readings, and corrects its velocities.
    observed = np.zeros((2 * n, 3 * n + 2))
    observed[0::2, 2 * n : -2] = np.eye(n)
    observed[1::2, 1 : 2 * n : 2] = np.eye(n)
    correction = VELOCITY_CORRECTION / sample_time * np.eye(n)
    observed[1::2, 0 : 2 * n : 2], observed[1::2, 2 * n : -2] = -correction, correction
    predicted = phi @ observed
    predicted[:, -1] = gamma if delay else 0.0
    effort = -controller.gains @ (predicted if delay else observed)
    effort[-2] += controller.prefilter
    start = np.zeros(2 * n)
    start[0::2] = y0
    return _Law(start=start, moves=np.vstack([predicted, effort]), late=gamma)


def _pid_law(pid: Pid, row: int, sample_time: float, *, n: int) -> _Law:
    """Return the law of a PID controller; its state is the integral and the last error."""
    error = np.zeros(n + 4)
    error[2 + row], error[-2] = -1.0, 1.0
    integral, last = np.eye(2, n + 4)
    integral = integral + sample_time * error
    slope = (error - last) / sample_time
    effort = pid.scale * (pid.kp * error + pid.ki * integral + pid.kd * slope)
    return _Law(start=np.zeros(2), moves=np.array([integral, error, effort]), late=np.zeros(2))


def _block(first: Array, second: Array) -> Array:
    """Return the matrix with two blocks on its diagonal."""
    whole = np.zeros(np.add(first.shape, second.shape))
    whole[: len(first), : len(first)], whole[len(first) :, len(first) :] = first, second
    return whole


def _prediction(
    controller: StateFeedback, *, free: tuple[int, ...], sample_time: float
) -> tuple[Array, Array]:
    """Return Phi and Gamma of the observer's prediction."""
    if controller.gains.size != 2 * len(free):
        raise DataError(
            f"state feedback of {len(free)} carts needs {2 * len(free)} gains, "
            f"found {controller.gains.size}"
        )
    if controller.model is not None:
        return discretise(controller.model, sample_time, free=free)
    phi = np.eye(2 * len(free))
    phi[0::2, 1::2] = sample_time * np.eye(len(free))
    return phi, np.zeros(2 * len(free))


def _hermite(at: Array, x: Array, slope: Array) -> Array:
    """Interpolate values (f, n) with known slopes at 0, 1, 2, …; the error is O(h⁴)."""
    index = np.clip(np.floor(at).astype(int), 0, x.shape[1] - 2)
    s = at - index
    left, right = x[:, index], x[:, index + 1]
    rise = right - left
    return left + s * (
        slope[:, index]
        + s * (3 * rise - 2 * slope[:, index] - slope[:, index + 1])
        + s**2 * (slope[:, index] + slope[:, index + 1] - 2 * rise)
    )
