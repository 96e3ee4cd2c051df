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
from pipeline.plant.nonlinear.simulator.contacts import guard, switch
from pipeline.plant.nonlinear.simulator.sensitivity import (
    bend_presliding,
    make_sensitivities,
    restart,
)
from pipeline.plant.nonlinear.simulator.step import advance, smooth_forces

# isort: off
from pipeline.plant.nonlinear.simulator.state import (
    ACC, BACKLASH, CHANGE, COGGING, CONTACT_K, COULOMB, COUPLING, CUBIC, DAHL, DAMPING, DEAD, DELAY,
    DRAG, DRIVE_C, FIX, FORCE, GAIN, HID_C, HID_K, HID_M, INV, LAG, LIMIT, LOAD, MASS, MID_V,
    MID_X, MOTOR, OFFSET, ROWS, STATIC, STIFF, STOP_K, V, X, Z, jit, pair, tie,
)  # fmt: skip

_SERIES_REACH = 0.2  # omega h: the series' sixth order then leaves 1e-8 after seconds
_LONGEST_LINEAR = 4.5e-3  # s; springs, dampers and dry friction are exact at any step
_CONTACT_REACH = 0.4  # omega h inside a contact
_DAHL_STEP = 2.3e-3  # s; the presliding state is held over half of it
_STRIBECK_STEP = 1.2e-3  # s; the drop of friction from its static force is over in few of them
_COGGING_STEP = 1e-3  # s; a cart crosses a small part of the pitch in it
_LONGEST_STEP = 2.5e-3  # s; nonlinear forces are held over it
_INSTANT = 1e-9  # s; times as near as this are one
_BLOWN_UP = 1e9  # positions beyond this are a diverged model


@jit
def _assemble(cart, spring, drive, free, s, K, C, parent):
    """Fill the linear matrices; returns how many bodies there are, and the motor's row or -1."""
    n = cart.shape[0]
    for i in range(n):
        s[INV, i] = 1.0 / cart[i, MASS] if free[i] else 0.0
        C[i, i] += cart[i, DAMPING]
    for j in range(n + 1):
        tie(K, j, n, spring[j, STIFF])
        tie(C, j, n, spring[j, COUPLING])
    N = n
    motor = -1
    if drive[BACKLASH] > 0.0 and free[0]:
        motor = N
        s[INV, N] = 1.0 / drive[MOTOR]
        s[INV, 0] = 1.0 / max(cart[0, MASS] - drive[MOTOR], 0.02 * cart[0, MASS])
        N += 1
    for i in range(n):
        if cart[i, HID_M] > 0.0:
            s[INV, N] = 1.0 / cart[i, HID_M]
            pair(K, i, N, cart[i, HID_K])
            pair(C, i, N, cart[i, HID_C])
            parent[N] = i
            N += 1
    return N, motor


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
    rubbing = presliding = stribeck = fastest = contact = 0.0
    rough = abs(drive[COGGING])
    for i in range(N):
        row = 0.0
        for j in range(N):
            row += abs(K[i, j])
        fastest = max(fastest, row * s[INV, i])
    for i in range(n):
        presliding += cart[i, DAHL]
        stribeck += cart[i, STATIC]
        rubbing += cart[i, COULOMB] + cart[i, STATIC] + cart[i, LOAD] + cart[i, DAHL]
        rough += abs(cart[i, OFFSET]) + abs(cart[i, DRAG])
        contact = max(contact, cart[i, STOP_K] * s[INV, i])
    for j in range(n + 1):
        rough += abs(spring[j, CUBIC])
        if spring[j, CHANGE] > 0.0:
            # A spring that hardens past its gap is the faster one.
            extra = spring[j, CHANGE] * spring[j, STIFF]
            heavier = max(s[INV, j] if j < n else 0.0, s[INV, j - 1] if j > 0 else 0.0)
            fastest += extra * heavier
    dry, smooth = rubbing > 0.0, rough == 0.0
    longest = min(
        _LONGEST_LINEAR if smooth else _LONGEST_STEP, _SERIES_REACH / sqrt(fastest + 1e-12)
    )
    if presliding > 0.0:
        longest = min(longest, _DAHL_STEP)
    if stribeck > 0.0:
        longest = min(longest, _STRIBECK_STEP)
    if drive[COGGING] != 0.0:
        longest = min(longest, _COGGING_STEP)
    if motor >= 0:
        contact = max(contact, drive[CONTACT_K] * (s[INV, 0] + s[INV, motor]))
    longest /= refine
    contact_step = _CONTACT_REACH / sqrt(contact) / refine if contact > 0.0 else longest
    for i in range(command.size):
        value = command[i]
        if drive[DEAD] != 0.0:
            past_zone = max(abs(value) - drive[DEAD], 0.0)
            value = past_zone if value > 0.0 else -past_zone
        held[0, i] = min(max(value, -drive[LIMIT]), drive[LIMIT])
        if i > 0:
            span = knots[i] - knots[i - 1]
            held[1, i] = held[1, i - 1] + held[0, i - 1] * span
            held[2, i] = held[2, i - 1] + 0.5 * (held[1, i - 1] + held[1, i]) * span
    lagged = held[0, 0]
    driven = motor if motor >= 0 else 0
    at = knots.size - 1
    on = 0

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
        past, past2, at = _integral(t[first] - drive[DELAY], knots, held, at)
        if shot == 0 and presliding > 0.0:
            for i in range(N):
                s[MID_X, i], s[MID_V, i], s[FORCE, i] = s[X, i], s[V, i], s[FIX, i]
            smooth_forces(cart, spring, drive, driven, n, s)
            for i in range(n):
                if cart[i, DAHL] > 0.0:
                    net = s[FORCE, i] + (held[0, 0] if i == 0 else 0.0)
                    for j in range(N):
                        net -= K[i, j] * s[X, j]
                    s[Z, i] = min(max(net / (scatter[i] * cart[i, DAHL]), -1.0), 1.0)
                    if abs(s[V, i]) > 0.0:
                        s[Z, i] = 1.0 if s[V, i] > 0.0 else -1.0
                    elif abs(s[Z, i]) < 1.0:
                        bend_presliding(lanes, T, s, K, cart, scatter, i, n, N)
        for sample in range(first, end):
            for i in range(n):
                if not free[i]:
                    s[X, i] = guided[i, sample]
                y[i, sample] = cart[i, GAIN] * s[X, i]
                for lane in range(dy.shape[0]):
                    dy[lane, i, sample] = cart[i, GAIN] * T[i, lane // 4, lane % 4]
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
                    h = _edge(now, upon, drive[DELAY], knots, held, at) - now
                upto, upto2, at = _integral(now + h - drive[DELAY], knots, held, at)
                mean = (upto - past) / h
                # What comes early in the step moves the body further than its mean would.
                early = upto2 - past2 - 0.5 * h * (past + upto)
                past, past2 = upto, upto2
                if drive[LAG] > 0.0:
                    # Exact for the straight line that has the mean and the moment of the input.
                    tau, slope = drive[LAG], -12.0 * early / h**3
                    decay = exp(-h / tau)
                    fading = lagged - mean + slope * (0.5 * h + tau)
                    lagged = mean + slope * (0.5 * h - tau) + fading * decay
                    mean += fading * tau / h * (1.0 - decay) - slope * tau
                    early += fading * tau * (0.5 * h * (1.0 + decay) - tau * (1.0 - decay))
                drive_c = 0.0
                if drive[DRIVE_C] != 0.0:
                    while on < knots.size - 1 and knots[on + 1] <= now + 0.5 * h:
                        on += 1
                    drive_c = drive[DRIVE_C] if command[on] != 0.0 else 0.0
                advance(
                    cart, spring, drive, n, N, motor, s, K, C, scatter, mean, drive_c, h, dry,
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
    N, motor = _assemble(cart, spring, drive, free, s, K, C, parent)
    switches = [i for i in range(n) if cart[i, STOP_K] > 0.0]
    switches += [n + j for j in range(n + 1) if spring[j, CHANGE] != 0.0]
    switches += [2 * n + 1, 2 * n + 2] if motor >= 0 else []
    numbers = np.array(switches, dtype=np.int64)
    return Bodies(N, motor, parent, s, K, C, numbers, np.zeros(numbers.size, dtype=np.bool_))


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
