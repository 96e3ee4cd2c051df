"""Simulate carts with dry friction, contact, slack and an imperfect drive: compiled, event-driven.

Every substep integrates the linear part (springs, dampers, hidden masses) by a Taylor series of
sixth order. So the linear chain is exact to rounding. Nonlinear forces are held at their value in
the middle of the step. Dry friction is set-valued. A cart that stops inside a step stops at the
root of its velocity polynomial. From rest it either sticks, and then does not move at all, or
slides on. There is no tanh and no threshold velocity.

Three tables define the simulation, with one row for each cart, each spring, and the drive. An
effect fills columns of them (`plant.catalogue`). The neutral values of all columns give the
linear chain.

Reference: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., sec. VIII.2;
for the friction events B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit, Automatica 30 (1994),
section 4.
"""

from collections.abc import Sequence
from math import ceil, exp, sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.simulator.columns import DRY, Cart, Drive, Spring
from pipeline.plant.simulator.contacts import contact_gap, toggle_contact
from pipeline.plant.simulator.sensitivity import bend_presliding, make_sensitivities, restart
from pipeline.plant.simulator.step import advance, smooth_forces
from pipeline.plant.simulator.tables import Tables

# isort: off
from pipeline.plant.simulator.laws import (
    shaped_input, cart_matrix, longest_step, hysteresis, bilinear_spring,
    spring_matrix, end_stop)  # fmt: skip
from pipeline.plant.simulator.compiler import inlined, jit
from pipeline.plant.simulator.state import (
    ACC, FIX, FORCE, INV, MID_V, MID_X, ROWS, V, X, Z, Bodies, Push,
    pair, add_spring)  # fmt: skip

_SERIES_REACH = 0.2  # omega h; with it, the sixth-order series has an error of 1e-8 after seconds
_CONTACT_REACH = 0.4  # omega h inside a contact
_INSTANT = 1e-9  # s; events closer than this count as simultaneous
_BLOWN_UP = 1e9  # position at which the simulation has diverged


class Excitation(NamedTuple):
    """The input of one run, and the prescribed motion of its carts.

    Attributes
    ----------
    t : times (samples,).
    knots, command : times and values (k,) of the input, held from knot to knot.
    held : work array (3, k) for the input after the drive's laws, and its two integrals.
    free : whether each cart moves (n,).
    guided : prescribed motion (n, samples) of the other carts; zero by default.
    shots : bounds (shots + 1,) of the pieces of the run, each of which has its own start.
    refine : number by which the step is divided.
    """

    t: Array
    knots: Array
    command: Array
    held: Array
    free: NDArray[np.bool_]
    guided: Array
    shots: NDArray[np.int64]
    refine: float


class StartState(NamedTuple):
    """The start state of the bodies of one run.

    `x` and `v` (shots, n) are those of the carts at the start of each shot. If their shape is
    (shots, 2 n), the hidden masses follow, relative to their carts; only the first shot uses these.
    `scatter` (n,) is a factor on all dry friction of a cart.
    """

    x: Array
    v: Array
    scatter: Array


def describe_run(
    t: Array,
    command: Any,
    *,
    free: Any,
    knots: Array | None = None,
    shots: Any = None,
    guided: Array | None = None,
) -> Excitation:
    """Return a run in the simulator's form.

    `command` (k,) is held from knot to knot, by default from sample to sample. Without `guided` (n,
    samples), carts that are not `free` (n,) stay at zero. By default there is one shot.
    """
    t, free = _plain(t, np.float64), _plain(free, np.bool_)
    command = _plain(command, np.float64)
    return Excitation(
        t=t,
        knots=t if knots is None else _plain(knots, np.float64),
        command=command,
        held=np.zeros((3, command.size)),
        free=free,
        guided=np.zeros((free.size, t.size)) if guided is None else _plain(guided, np.float64),
        shots=np.array([0, t.size] if shots is None else shots, dtype=np.int64),
        refine=1.0,
    )


def _plain(array: Any, dtype: Any) -> Any:
    """Return a contiguous and writable array, the only kind that the compiled function takes.

    For other arrays numba would compile again, which takes ten seconds.
    """
    array = np.asarray(array)
    fits = array.dtype == dtype and array.flags.carray
    return array if fits else np.array(array, dtype=dtype, order="C")


@jit
def _assemble(tables, free, s, K, C, parent, switches):
    """Fill in matrices and switches; return the number of bodies, motor's row, switch count."""
    cart, spring, drive = tables.cart, tables.spring, tables.drive
    n = cart.shape[0]
    for i in range(n):
        s[INV, i] = 1.0 / cart[i, Cart.MASS] if free[i] else 0.0
        stiffness, damping = cart_matrix(cart, i)
        K[i, i] += stiffness
        C[i, i] += cart[i, Cart.DAMPING] + damping
    for j in range(n + 1):
        stiffness, damping = spring_matrix(spring, j)
        add_spring(K, j, n, spring[j, Spring.STIFFNESS] + stiffness)
        add_spring(C, j, n, damping)
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
            there = end_stop(cart, which)[0] > 0.0
        elif which <= 2 * n:
            there = bilinear_spring(spring, which - n)[0] != 0.0
        else:
            there = motor >= 0
        if there:
            switches[count] = which
            count += 1
    return N, motor, count


def assemble(tables: Tables, free: NDArray[np.bool_]) -> Bodies:
    """Return the bodies of one bench, at rest at zero and with all contacts open."""
    n = len(tables.cart)
    size = 2 * n + 1
    s, K, C = np.zeros((ROWS, size)), np.zeros((size, size)), np.zeros((size, size))
    parent, numbers = np.full(size, -1), np.empty(2 * n + 3, dtype=np.int64)
    N, motor, count = _assemble(tables, free, s, K, C, parent, numbers)
    active = np.zeros(count, dtype=np.bool_)
    return Bodies(n, N, motor, max(motor, 0), parent, s, K, C, numbers[:count], active)


@jit
def _integral(run, time, at):
    """Integrate the held input up to `time`, once and twice; the search starts at interval `at`."""
    knots, held = run.knots, run.held
    last = knots.size - 1
    while at < last and knots[at + 1] <= time:
        at += 1
    while at > 0 and knots[at] > time:
        at -= 1
    since = time - knots[at]
    once = held[1, at] + held[0, at] * since
    return once, held[2, at] + 0.5 * (held[1, at] + once) * since, at


@jit
def _edge(run, delay, now, end, at):
    """Return when the delayed input first jumps after `now`, at the latest `end`."""
    knots, held = run.knots, run.held
    while at < knots.size - 1 and knots[at + 1] + delay < end - _INSTANT:
        at += 1
        if knots[at] + delay > now + _INSTANT and held[0, at] != held[0, at - 1]:
            return knots[at] + delay
    return end


@inlined
def _steps(tables, bodies, refine):
    """Return the longest step, the longest step in a contact (s), and the kinds of forces.

    The kinds are two numbers, positive if there is sliding or presliding friction, and flags for
    the places of smooth forces.
    """
    # Sums serve as flags here, because numba would compile a function for every constant flag.
    rubbing = presliding = fastest = contact = 0.0
    s, n, N, motor = bodies.s, bodies.n, bodies.N, bodies.motor
    for i in range(N):
        row = 0.0
        for j in range(N):
            row += abs(bodies.K[i, j])
        fastest = max(fastest, row * s[INV, i])
    for i in range(n):
        presliding += hysteresis(tables.cart, i, 0.0)[0]
        for column in DRY:
            rubbing += tables.cart[i, column]
        contact = max(contact, end_stop(tables.cart, i)[0] * s[INV, i])
    for j in range(n + 1):
        extra = bilinear_spring(tables.spring, j)[0]
        if extra > 0.0:
            # A spring that gets stiffer beyond its gap has the higher frequency.
            heavier = max(s[INV, j] if j < n else 0.0, s[INV, j - 1] if j > 0 else 0.0)
            fastest += extra * heavier
    reach, smooth = longest_step(tables.cart, tables.spring, tables.drive)
    # Springs, dampers and dry friction are exact for any step, so the limit is 4.5 ms.
    longest = min(4.5e-3, reach, _SERIES_REACH / sqrt(fastest + 1e-12))
    if motor >= 0:
        contact = max(
            contact,
            tables.drive[Drive.BACKLASH_CONTACT_STIFFNESS] * (s[INV, 0] + s[INV, motor]),
        )
    longest /= refine
    contact_step = _CONTACT_REACH / sqrt(contact) / refine if contact > 0.0 else longest
    return longest, contact_step, rubbing, presliding, smooth


@inlined
def _start_shot(bodies, run, start, lanes, shot):
    """Put the bodies at the start of a shot."""
    s, n, N, motor, parent = bodies.s, bodies.n, bodies.N, bodies.motor, bodies.parent
    restart(bodies, lanes, shot, run.free)
    for i in range(n):
        if run.free[i]:
            # Hidden masses and the motor keep their position relative to their carts.
            for j in range(n, N):
                if (parent[j] == i) or (j == motor and i == 0):
                    s[X, j] += start.x[shot, i] - s[X, i]
                    s[V, j] += start.v[shot, i] - s[V, i]
            s[X, i], s[V, i] = start.x[shot, i], start.v[shot, i]
            s[ACC, i] = 0.0
    if shot == 0 and start.x.shape[1] > n:
        for j in range(n, N):
            if j != motor:
                s[X, j] += start.x[shot, n + parent[j]]
                s[V, j] += start.v[shot, n + parent[j]]


@inlined
def _bend(tables, bodies, lanes, scatter, u, smooth):
    """Set the presliding states so that friction balances the forces at the start, if it can."""
    s, n, N = bodies.s, bodies.n, bodies.N
    for i in range(N):
        s[MID_X, i], s[MID_V, i], s[FORCE, i] = s[X, i], s[V, i], s[FIX, i]
    smooth_forces(tables, bodies, u, 0.0, smooth)
    for i in range(n):
        most, _, _ = hysteresis(tables.cart, i, 0.0)
        if most > 0.0:
            net = s[FORCE, i] + (u if i == 0 else 0.0)
            for j in range(N):
                net -= bodies.K[i, j] * s[X, j]
            s[Z, i] = min(max(net / (scatter[i] * most), -1.0), 1.0)
            if abs(s[V, i]) > 0.0:
                s[Z, i] = 1.0 if s[V, i] > 0.0 else -1.0
            elif abs(s[Z, i]) < 1.0:
                bend_presliding(bodies, lanes, i, most, scatter)


@jit
def _simulate(tables, bodies, run, start, lanes, y, dy):
    """Fill y (n, samples) with the readings of one run, and dy (lanes, n, samples).

    dy are the derivatives of the readings. Return False if the simulation diverges.
    """
    s, n = bodies.s, bodies.n
    t, knots, held, free, guided = run.t, run.knots, run.held, run.free, run.guided
    delay = tables.drive[Drive.INPUT_DELAY_DELAY]
    tau = tables.drive[Drive.ACTUATOR_LAG_TIME_CONSTANT]
    longest, contact_step, rubbing, presliding, smooth = _steps(tables, bodies, run.refine)
    dry = rubbing > 0.0
    for i in range(run.command.size):
        held[0, i] = shaped_input(tables.drive, run.command[i])
        if i > 0:
            span = knots[i] - knots[i - 1]
            held[1, i] = held[1, i - 1] + held[0, i - 1] * span
            held[2, i] = held[2, i - 1] + 0.5 * (held[1, i - 1] + held[1, i]) * span
    lagged = held[0, 0]
    driven = bodies.driven
    at = knots.size - 1
    powered = 0

    for shot in range(run.shots.size - 1):
        first, end = run.shots[shot], run.shots[shot + 1]
        _start_shot(bodies, run, start, lanes, shot)
        for e in range(bodies.switches.size):
            # A contact may be open or closed at the start.
            if contact_gap(bodies.switches[e], bodies.active[e], tables, s, 0.0) > 0.0:
                bodies.active[e] = not bodies.active[e]
                sign = 1.0 if bodies.active[e] else -1.0
                toggle_contact(bodies.switches[e], sign, tables, s, bodies.K, bodies.C)
        past, past2, at = _integral(run, t[first] - delay, at)
        if shot == 0 and presliding > 0.0:
            _bend(tables, bodies, lanes, start.scatter, held[0, 0], smooth)
        for sample in range(first, end):
            for i in range(n):
                if not free[i]:
                    s[X, i] = guided[i, sample]
                gain = tables.cart[i, Cart.SENSOR_GAIN_GAIN]
                y[i, sample] = gain * s[X, i]
                for lane in range(dy.shape[0]):
                    dy[lane, i, sample] = gain * lanes.T[i, lane // 4, lane % 4]
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
                    # A cart that friction holds feels the actual input instead of its mean over the
                    # step. So the step ends at the next jump of the input.
                    h = _edge(run, delay, now, upon, at) - now
                upto, upto2, at = _integral(run, now + h - delay, at)
                mean = (upto - past) / h
                # Input early in the step moves the body further than its mean would.
                early = upto2 - past2 - 0.5 * h * (past + upto)
                past, past2 = upto, upto2
                if tau > 0.0:
                    # Exact for a straight line that has the mean and the moment of the input.
                    slope = -12.0 * early / h**3
                    decay = exp(-h / tau)
                    fading = lagged - mean + slope * (0.5 * h + tau)
                    lagged = mean + slope * (0.5 * h - tau) + fading * decay
                    mean += fading * tau / h * (1.0 - decay) - slope * tau
                    early += fading * tau * (0.5 * h * (1.0 + decay) - tau * (1.0 - decay))
                while powered < knots.size - 1 and knots[powered + 1] <= now + 0.5 * h:
                    powered += 1
                on = 1.0 if run.command[powered] != 0.0 else 0.0
                push = Push(mean, on, h, start.scatter, dry, smooth, contact_step)
                advance(tables, bodies, push, lanes)
                if not dry or s[V, driven] != 0.0:
                    s[X, driven] += early * s[INV, driven]
                now += h
                if now > upon - _INSTANT:
                    now, sub = upon, sub + 1
            if not abs(s[X, 0]) + abs(s[X, n - 1]) < _BLOWN_UP:
                return False
    return True


NO_LANES = np.zeros((2, 0), dtype=np.int64)


def simulate(
    variants: Sequence[tuple[Tables, StartState]],
    run: Excitation,
    *,
    of: NDArray[np.int64] = NO_LANES,
) -> tuple[Array, Array]:
    """Simulate variants of one run, with derivatives for the first variant.

    Parameters
    ----------
    variants : b variants, each with its tables and its start.
    of : (2, lanes), the kind of variable of each derivative, and its cart or spring (from 0).

    Returns
    -------
    readings (b, n, samples) without encoder zero; derivatives (lanes, n, samples) of the first
    variant's readings. Both are NaN for a variant that diverged.
    """
    of = _plain(of, np.int64)
    run = run._replace(held=np.zeros_like(run.held))  # threads may share a run
    y = np.empty((len(variants), run.free.size, run.t.size))
    dy = derivatives = np.empty((of.shape[1], *y.shape[1:]))
    for b, (tables, start) in enumerate(variants):
        tables = Tables(*(_plain(table, np.float64) for table in tables))
        start = StartState(*(_plain(array, np.float64) for array in start))
        bodies = assemble(tables, run.free)
        if not _simulate(tables, bodies, run, start, make_sensitivities(of, bodies.N), y[b], dy):
            y[b] = dy[:] = np.nan
        of, dy = NO_LANES, dy[:0]
    return y, derivatives
