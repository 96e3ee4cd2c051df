"""Simulate carts with dry friction, contact, slack and an imperfect drive: compiled, by events.

Every substep takes the linear part (springs, dampers, hidden masses) by a Taylor series to sixth
order, so the linear chain is exact to rounding, and holds the nonlinear forces at their value in
the middle of the step. Dry friction is set-valued: a cart that stops inside a step stops at the
root of its velocity polynomial, and from rest it either sticks (and then truly does not move) or
slides on. No tanh, no threshold velocity.

What is simulated is told by three tables, one row a cart, a spring, and one for the drive; an
effect fills columns of them (`plant.nonlinear.effects`), and the neutral values of all columns
give the linear chain back.

Reference: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., sec.
VIII.2; for the friction events B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit,
Automatica 30 (1994), section 4.
"""

from math import ceil, exp, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.nonlinear.columns import DRY, Cart, Drive, Spring
from pipeline.plant.nonlinear.simulator.contacts import guard, switch
from pipeline.plant.nonlinear.simulator.sensitivity import (
    bend_presliding,
    make_sensitivities,
    restart,
)
from pipeline.plant.nonlinear.simulator.step import advance, smooth_forces

# isort: off
from pipeline.plant.nonlinear.simulator.laws import (
    arriving, cart_matrix, reach_of, settling, slack_of, spring_matrix, stop_of,
)  # fmt: skip
from pipeline.plant.nonlinear.simulator.state import (
    ACC, FIX, FORCE, INV, MID_V, MID_X, ROWS, V, X, Z, jit, pair, tie,
)  # fmt: skip

_SERIES_REACH = 0.2  # omega h: the series' sixth order then leaves 1e-8 after seconds
_LONGEST_LINEAR = 4.5e-3  # s; springs, dampers and dry friction are exact at any step
_CONTACT_REACH = 0.4  # omega h inside a contact
_INSTANT = 1e-9  # s; times as near as this are one
_BLOWN_UP = 1e9  # positions beyond this are a diverged model


@jit
def _assemble(cart, spring, drive, free, s, K, C, parent, switches):
    """Fill the linear matrices and the numbers of what switches.

    Returns how many bodies there are, the motor's row or -1, and how many switches.
    """
    n = cart.shape[0]
    for i in range(n):
        s[INV, i] = 1.0 / cart[i, Cart.MASS] if free[i] else 0.0
        stiffness, damping = cart_matrix(cart, i)
        K[i, i] += stiffness
        C[i, i] += cart[i, Cart.DAMPING] + damping
    for j in range(n + 1):
        stiffness, damping = spring_matrix(spring, j)
        tie(K, j, n, spring[j, Spring.STIFFNESS] + stiffness)
        tie(C, j, n, damping)
    N = n
    motor = -1
    if drive[Drive.BACKLASH_GAP] > 0.0 and free[0]:
        motor = N
        s[INV, N] = 1.0 / drive[Drive.BACKLASH_MOTOR_MASS]
        s[INV, 0] = 1.0 / max(
            cart[0, Cart.MASS] - drive[Drive.BACKLASH_MOTOR_MASS], 0.02 * cart[0, Cart.MASS]
        )
        N += 1
    for i in range(n):
        if cart[i, Cart.EXTRA_MODE_MASS] > 0.0:
            s[INV, N] = 1.0 / cart[i, Cart.EXTRA_MODE_MASS]
            pair(K, i, N, cart[i, Cart.EXTRA_MODE_STIFFNESS])
            pair(C, i, N, cart[i, Cart.EXTRA_MODE_DAMPING])
            parent[N] = i
            N += 1
    count = 0
    for which in range(2 * n + 3):
        if which < n:
            there = stop_of(cart, which)[0] > 0.0
        elif which <= 2 * n:
            there = slack_of(spring, which - n)[0] != 0.0
        else:
            there = motor >= 0
        if there:
            switches[count] = which
            count += 1
    return N, motor, count


@jit
def _integral(time, knots, held, at):
    """Integrate the held input up to `time`, once and twice; `at` is the interval found last."""
    last = knots.size - 1
    while at < last and knots[at + 1] <= time:
        at += 1
    while at > 0 and knots[at] > time:
        at -= 1
    since = time - knots[at]
    once = held[1, at] + held[0, at] * since
    return once, held[2, at] + 0.5 * (held[1, at] + once) * since, at


@jit
def _edge(now, end, delay, knots, held, at):
    """Return when, between `now` and `end`, the delayed input first jumps: or `end`."""
    while at < knots.size - 1 and knots[at + 1] + delay < end - _INSTANT:
        at += 1
        if knots[at] + delay > now + _INSTANT and held[0, at] != held[0, at - 1]:
            return knots[at] + delay
    return end


@jit
def _simulate(
    cart, spring, drive, x0, v0, scatter, free, t, knots, command, starts, refine, guided, y, dy,
    N, motor, parent, s, K, C, switches, active, held, lanes, T, phi, work,
):  # fmt: skip
    """Fill y (n, samples) with the readings of one run; False where the model diverged.

    And dy (lanes, n, samples) with their derivatives.
    """
    n = cart.shape[0]
    # Sums, of which flags are made: numba compiles a function anew for every constant flag.
    rubbing = presliding = fastest = contact = 0.0
    for i in range(N):
        row = 0.0
        for j in range(N):
            row += abs(K[i, j])
        fastest = max(fastest, row * s[INV, i])
    for i in range(n):
        presliding += settling(cart, i, 0.0)[0]
        for column in DRY:
            rubbing += cart[i, column]
        contact = max(contact, stop_of(cart, i)[0] * s[INV, i])
    for j in range(n + 1):
        extra = slack_of(spring, j)[0]
        if extra > 0.0:
            # A spring that hardens past its gap is the faster one.
            heavier = max(s[INV, j] if j < n else 0.0, s[INV, j - 1] if j > 0 else 0.0)
            fastest += extra * heavier
    reach, smooth = reach_of(cart, spring, drive)
    dry = rubbing > 0.0
    longest = min(_LONGEST_LINEAR, reach, _SERIES_REACH / sqrt(fastest + 1e-12))
    if motor >= 0:
        contact = max(
            contact, drive[Drive.BACKLASH_CONTACT_STIFFNESS] * (s[INV, 0] + s[INV, motor])
        )
    longest /= refine
    contact_step = _CONTACT_REACH / sqrt(contact) / refine if contact > 0.0 else longest
    for i in range(command.size):
        held[0, i] = arriving(drive, command[i])
        if i > 0:
            span = knots[i] - knots[i - 1]
            held[1, i] = held[1, i - 1] + held[0, i - 1] * span
            held[2, i] = held[2, i - 1] + 0.5 * (held[1, i - 1] + held[1, i]) * span
    lagged = held[0, 0]
    driven = motor if motor >= 0 else 0
    at = knots.size - 1
    powered = 0

    for shot in range(starts.size - 1):
        first, end = starts[shot], starts[shot + 1]
        restart(lanes, T, shot, free, parent, motor, n, N)
        for i in range(n):
            if free[i]:
                # Hidden masses and the motor keep their place relative to their cart.
                for j in range(n, N):
                    if (parent[j] == i) or (j == motor and i == 0):
                        s[X, j] += x0[shot, i] - s[X, i]
                        s[V, j] += v0[shot, i] - s[V, i]
                s[X, i], s[V, i] = x0[shot, i], v0[shot, i]
                s[ACC, i] = 0.0
        if shot == 0 and x0.shape[1] > n:
            for j in range(n, N):
                if j != motor:
                    s[X, j] += x0[shot, n + parent[j]]
                    s[V, j] += v0[shot, n + parent[j]]
        for e in range(switches.size):
            # The state is new: a contact may be open or closed from the start.
            if guard(switches[e], active[e], cart, spring, drive, n, motor, s, 0.0) > 0.0:
                active[e] = not active[e]
                sign = 1.0 if active[e] else -1.0
                switch(switches[e], sign, cart, spring, drive, n, motor, s, K, C)
        past, past2, at = _integral(t[first] - drive[Drive.INPUT_DELAY_DELAY], knots, held, at)
        if shot == 0 and presliding > 0.0:
            for i in range(N):
                s[MID_X, i], s[MID_V, i], s[FORCE, i] = s[X, i], s[V, i], s[FIX, i]
            smooth_forces(cart, spring, drive, driven, n, s, held[0, 0], 0.0, smooth)
            for i in range(n):
                most, _, _ = settling(cart, i, 0.0)
                if most > 0.0:
                    net = s[FORCE, i] + (held[0, 0] if i == 0 else 0.0)
                    for j in range(N):
                        net -= K[i, j] * s[X, j]
                    s[Z, i] = min(max(net / (scatter[i] * most), -1.0), 1.0)
                    if abs(s[V, i]) > 0.0:
                        s[Z, i] = 1.0 if s[V, i] > 0.0 else -1.0
                    elif abs(s[Z, i]) < 1.0:
                        bend_presliding(lanes, T, s, K, most, scatter, i, n, N)
        for sample in range(first, end):
            for i in range(n):
                if not free[i]:
                    s[X, i] = guided[i, sample]
                y[i, sample] = cart[i, Cart.SENSOR_GAIN_GAIN] * s[X, i]
                for lane in range(dy.shape[0]):
                    dy[lane, i, sample] = cart[i, Cart.SENSOR_GAIN_GAIN] * T[i, lane // 4, lane % 4]
            if sample == end - 1:
                break
            interval = t[sample + 1] - t[sample]
            for i in range(n):
                if not free[i]:
                    s[V, i] = (guided[i, sample + 1] - guided[i, sample]) / interval
            count = ceil(interval / longest - 1e-9)
            whole, now, sub = interval / count, t[sample], 0
            while sub < count:
                upon = t[sample] + (sub + 1) * whole
                h = whole
                if (dry and s[V, driven] == 0.0) or now > upon - whole + _INSTANT:
                    # What friction holds is to feel the whole of it until the input jumps.
                    h = _edge(now, upon, drive[Drive.INPUT_DELAY_DELAY], knots, held, at) - now
                upto, upto2, at = _integral(
                    now + h - drive[Drive.INPUT_DELAY_DELAY], knots, held, at
                )
                mean = (upto - past) / h
                # What comes early in the step moves the body further than its mean would.
                early = upto2 - past2 - 0.5 * h * (past + upto)
                past, past2 = upto, upto2
                if drive[Drive.ACTUATOR_LAG_TIME_CONSTANT] > 0.0:
                    # Exact for the straight line that has the mean and the moment of the input.
                    tau, slope = drive[Drive.ACTUATOR_LAG_TIME_CONSTANT], -12.0 * early / h**3
                    decay = exp(-h / tau)
                    fading = lagged - mean + slope * (0.5 * h + tau)
                    lagged = mean + slope * (0.5 * h - tau) + fading * decay
                    mean += fading * tau / h * (1.0 - decay) - slope * tau
                    early += fading * tau * (0.5 * h * (1.0 + decay) - tau * (1.0 - decay))
                while powered < knots.size - 1 and knots[powered + 1] <= now + 0.5 * h:
                    powered += 1
                on = 1.0 if command[powered] != 0.0 else 0.0
                advance(
                    cart, spring, drive, n, N, motor, s, K, C, scatter, mean, on, h, dry,
                    smooth, switches, active, contact_step, lanes, T, phi, work,
                )  # fmt: skip
                if not dry or s[V, driven] != 0.0:
                    s[X, driven] += early * s[INV, driven]
                now += h
                if now > upon - _INSTANT:
                    now, sub = upon, sub + 1
            if not abs(s[X, 0]) + abs(s[X, n - 1]) < _BLOWN_UP:
                return False
    return True


class Bodies(NamedTuple):
    """Carts, motor and hidden masses before they move: tables of the simulator, and their size."""

    N: int
    motor: int  # its row, or -1
    parent: NDArray[np.int64]  # the carts of hidden masses, or -1
    state: Array
    K: Array
    C: Array
    switches: NDArray[np.int64]  # the numbers of the contacts and slack springs there are
    active: NDArray[np.bool_]


def assemble(cart: Array, spring: Array, drive: Array, free: NDArray[np.bool_]) -> Bodies:
    """Return the bodies of one bench at rest at zero, no contact closed."""
    n = len(cart)
    size = 2 * n + 1
    s, K, C = np.zeros((ROWS, size)), np.zeros((size, size)), np.zeros((size, size))
    parent = np.full(size, -1)
    numbers = np.empty(2 * n + 3, dtype=np.int64)
    N, motor, count = _assemble(cart, spring, drive, free, s, K, C, parent, numbers)
    switches = numbers[:count]
    return Bodies(N, motor, parent, s, K, C, switches, np.zeros(count, dtype=np.bool_))


NO_LANES = np.zeros((2, 0), dtype=np.int64)


def simulate_batch(
    cart, spring, drive, x0, v0, scatter, free, t, knots, command, starts, refine, *, guided=None
):
    """Simulate many variants of one run.

    Parameters
    ----------
    cart, spring, drive : (b, n, 17), (b, n + 1, 5), (b, 12) tables, see `Cart`, `Spring`, `Drive`.
    x0, v0 : (b, shots, n) positions and velocities of the carts at the start of each shot; or
        (b, shots, 2 n), where those of their hidden masses relative to them follow, which the
        first shot takes and the later ones carry over.
    scatter : (b, n) factor on all dry friction of a cart.
    free : (n,) which carts move.
    t : (samples,) times; knots (k,), command (k,): the input, held from knot to knot.
    starts : (shots + 1,) first sample of each shot, and the number of samples.
    refine : divides the step.
    guided : (n, samples) how the carts that are not free move; without, they stand still at zero.

    Returns
    -------
    (b, n, samples) readings, encoder zero excluded; NaN where a variant diverged.
    """
    return simulate_with_derivatives(
        cart, spring, drive, x0, v0, scatter, free, t, knots, command, starts, refine, NO_LANES,
        guided=guided,
    )[0]  # fmt: skip


def simulate_with_derivatives(
    cart, spring, drive, x0, v0, scatter, free, t, knots, command, starts, refine, of, *,
    guided=None,
):  # fmt: skip
    """Simulate many variants of one run, as `simulate_batch` does, the first with derivatives.

    Parameters
    ----------
    of : (2, lanes) by what: a kind of `sensitivity`, and a cart or spring, from 0.

    Returns
    -------
    (b, n, samples) readings, and (lanes, n, samples) derivatives of the first variant's.
    """
    # numba compiles anew, for ten seconds, for arrays that may not be written to, or for strides.
    guided = np.zeros((cart.shape[1], t.size)) if guided is None else guided
    floats = (cart, spring, drive, x0, v0, scatter, t, knots, command, guided)
    cart, spring, drive, x0, v0, scatter, t, knots, command, guided = (
        _plain(array, np.float64) for array in floats
    )
    free, starts, of = _plain(free, np.bool_), _plain(starts, np.int64), _plain(of, np.int64)
    y = np.empty((len(cart), cart.shape[1], t.size))
    dy = derivatives = np.empty((of.shape[1], *y.shape[1:]))
    run = free, t, knots, command, starts, float(refine), guided
    for b in range(len(cart)):
        bench, start = (cart[b], spring[b], drive[b]), (x0[b], v0[b], scatter[b])
        bodies = assemble(*bench, free)
        held, lanes = np.zeros((3, command.size)), make_sensitivities(of, bodies.N)
        if not _simulate(*bench, *start, *run, y[b], dy, *bodies, held, *lanes):
            y[b] = np.nan
        of, dy = NO_LANES, dy[:0]
    return y, derivatives


def _plain(array, dtype):
    """Return an array of the one kind the compiled function takes: whole, and writable."""
    fits = array.dtype == dtype and array.flags.carray
    return array if fits else np.array(array, dtype=dtype, order="C")
