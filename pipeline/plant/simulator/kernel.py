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
from pipeline.plant.simulator.compiler import inlined, jit
from pipeline.plant.simulator.generated_forces import (
    ON_CARTS,
    ON_DRIVE,
    ON_SPRINGS,
    bilinear_spring,
    cart_force,
    cart_matrix,
    drive_force,
    end_stop,
    hysteresis,
    longest_step,
    motor_force,
    shaped_input,
    sliding,
    spring_force,
    spring_matrix,
    stribeck,
)
from pipeline.plant.simulator.sensitivity import (
    ACC,
    D2,
    D3,
    D4,
    D5,
    D6,
    DECAY,
    FIX,
    FORCE,
    GRIP,
    INV,
    MID_V,
    MID_X,
    PAST,
    ROWS,
    RUB,
    SIDE,
    Bodies,
    Push,
    V,
    X,
    Z,
    add_spring,
    bend_presliding,
    make_sensitivities,
    pair,
    propagate,
    restart,
    saltation,
    stop,
    stretch,
)
from pipeline.plant.simulator.tables import Tables

# ------------------------------------------------------------ contacts that switch inside a step


@jit
def position(s, i, h):
    """Return the position of a body after a time h, by its Taylor series."""
    return s[X, i] + h * (
        s[V, i]
        + h
        / 2.0
        * (
            s[D2, i]
            + h
            / 3.0
            * (s[D3, i] + h / 4.0 * (s[D4, i] + h / 5.0 * (s[D5, i] + h / 6.0 * s[D6, i])))
        )
    )


@jit
def velocity(s, i, h):
    """Return the velocity of a body after a time h, by its Taylor series."""
    return s[V, i] + h * (
        s[D2, i]
        + h / 2.0 * (s[D3, i] + h / 3.0 * (s[D4, i] + h / 4.0 * (s[D5, i] + h / 5.0 * s[D6, i])))
    )


@jit
def contact(which, tables):
    """Return body, other body (-1 for a wall), side, stiffness, damping and reach of a contact.

    Contacts 0 to n - 1 are end stops. Contacts 2n + 1 and 2n + 2 are the two sides of the gap
    between cart 1 and the motor, which is body n.
    """
    n = tables.cart.shape[0]
    if which < n:
        k, c, at = end_stop(tables.cart, which)
        return which, -1, 1.0 if at > 0.0 else -1.0, k, c, abs(at)
    side, drive = 1.0 if which == 2 * n + 1 else -1.0, tables.drive
    k, c = drive[Drive.BACKLASH_CONTACT_STIFFNESS], drive[Drive.BACKLASH_CONTACT_DAMPING]
    return n, 0, side, k, c, 0.5 * drive[Drive.BACKLASH_GAP]


@jit
def contact_gap(which, active, tables, s, h):
    """Return how far past its switching point a switch is after a time h; it switches if > 0.

    Switches n to 2n are springs past a stretch, the others are contacts. A contact begins when the
    bodies meet and push each other. It ends when the push ends.
    """
    n = tables.cart.shape[0]
    if n <= which <= 2 * n:
        j = which - n
        reach = (position(s, j, h) if j < n else 0.0) - (position(s, j - 1, h) if j > 0 else 0.0)
        _, at, _ = bilinear_spring(tables.spring, j)
        beyond = reach - at if at >= 0.0 else at - reach
        return -beyond if active else beyond
    body, other, side, k, c, reach = contact(which, tables)
    x, v = position(s, body, h), velocity(s, body, h)
    if other >= 0:
        x -= position(s, other, h)
        v -= velocity(s, other, h)
    depth = k * (side * x - reach)
    push = depth + c * side * v
    return -push if active else min(depth, push)


@jit
def toggle_contact(which, sign, tables, s, K, C):
    """Add a contact or slack spring to the linear matrices (sign 1) or remove it (sign -1)."""
    n = tables.cart.shape[0]
    if n <= which <= 2 * n:
        j = which - n
        more, at, _ = bilinear_spring(tables.spring, j)
        k = sign * more
        add_spring(K, j, n, k)
        s[PAST, j] += sign
        if j < n:
            s[FIX, j] += k * at
        if j > 0:
            s[FIX, j - 1] -= k * at
    else:
        body, other, side, k, c, reach = contact(which, tables)
        pair(K, body, other, sign * k)
        pair(C, body, other, sign * c)
        s[FIX, body] += sign * k * side * reach
        if other >= 0:
            s[FIX, other] -= sign * k * side * reach


# ------------------------------------------------- one step: forces, the linear flow, and events

_MOST_EVENTS = 12  # per substep; more would be chatter


@inlined
def smooth_forces(tables, bodies, u, on, smooth):
    """Add the forces that are neither linear nor dry, for the state in the middle of the step."""
    s, n, driven, drive = bodies.s, bodies.n, bodies.driven, tables.drive
    if smooth & ON_CARTS:
        for i in range(n):
            s[FORCE, i] += cart_force(tables.cart, i, s[MID_X, i], s[MID_V, i], u)
    if smooth & ON_DRIVE:
        s[FORCE, driven] += motor_force(drive, s[MID_X, driven], s[MID_V, driven], u, on)
        s[FORCE, 0] += drive_force(drive, s[MID_X, 0], s[MID_V, 0], u, on)
    if smooth & ON_SPRINGS:
        for j in range(n + 1):
            f = spring_force(tables.spring, j, stretch(s, MID_X, j, n), stretch(s, MID_V, j, n))
            if j < n:
                s[FORCE, j] -= f
            if j > 0:
                s[FORCE, j - 1] += f


@inlined
def dry_friction(cart, bodies, push, step):
    """Add dry friction to the forces; a cart held by friction gets the inverse mass 0."""
    s, n, scatter, u = bodies.s, bodies.n, push.scatter, push.u
    for i in range(n):
        s[RUB, i] = 0.0
        most, target, pace = hysteresis(cart, i, s[MID_V, i])
        if most > 0.0 and s[INV, i] > 0.0:
            s[DECAY, i] = exp(-0.5 * pace * step)
            s[RUB, i] -= most * (target + (s[Z, i] - target) * s[DECAY, i])
    for i in range(n):
        # direction in which the cart slides; 0 without dry friction
        s[SIDE, i] = 0.0
        if s[INV, i] == 0.0:
            continue
        slide = sliding(cart, i, u)
        size = slide + stribeck(cart, i, abs(s[MID_V, i]) if s[V, i] != 0.0 else 0.0, u)
        if size <= 0.0:
            continue
        if s[V, i] != 0.0:
            s[SIDE, i] = 1.0 if s[V, i] > 0.0 else -1.0
        else:
            net = s[FORCE, i] + scatter[i] * s[RUB, i]
            for j in range(bodies.N):
                net -= bodies.K[i, j] * s[X, j] + bodies.C[i, j] * s[V, j]
            if abs(net) <= scatter[i] * size:
                s[GRIP, i] = 0.0
                continue
            s[SIDE, i] = 1.0 if net > 0.0 else -1.0
            speed = 0.5 * step * (abs(net) - scatter[i] * slide) * s[INV, i]
            size = slide + stribeck(cart, i, speed, u)
        s[RUB, i] -= size * s[SIDE, i]
    for i in range(n):
        s[FORCE, i] += scatter[i] * s[RUB, i]


@inlined
def taylor(s, K, C, N):
    """Fill D2 to D6, the Taylor coefficients of the linear flow under a constant force."""
    for i in range(N):
        f = s[FORCE, i]
        for j in range(N):
            f -= K[i, j] * s[X, j] + C[i, j] * s[V, j]
        s[D2, i] = s[GRIP, i] * f
    for i in range(N):
        f = 0.0
        for j in range(N):
            f -= K[i, j] * s[V, j] + C[i, j] * s[D2, j]
        s[D3, i] = s[GRIP, i] * f
    for row in (D2, D3, D4):
        for i in range(N):
            f = 0.0
            for j in range(N):
                f -= K[i, j] * s[row, j] + C[i, j] * s[row + 1, j]
            s[row + 2, i] = s[GRIP, i] * f


@inlined
def first_stop(s, n, step, none):
    """Return when the first sliding cart stops within the step, and its index (or `none`)."""
    stopping = none
    for i in range(n):
        if s[SIDE, i] == 0.0:
            continue
        end = velocity(s, i, step)
        if s[SIDE, i] * end < 0.0 and s[V, i] != 0.0:
            # Root of the velocity by false position, which always keeps a bracket.
            low, high, v_low, v_high = 0.0, step, s[V, i], end
            for _ in range(4):
                guess = low + (high - low) * v_low / (v_low - v_high)
                value = velocity(s, i, guess)
                if s[SIDE, i] * value > 0.0:
                    low, v_low = guess, value
                else:
                    high, v_high = guess, value
            step = low + (high - low) * v_low / (v_low - v_high)
            stopping = i
    return step, stopping


@inlined
def first_switch(tables, bodies, step, none):
    """Return when the first contact or slack spring switches, and its index (or `none`)."""
    switching, switches, active, s = none, bodies.switches, bodies.active, bodies.s
    for e in range(switches.size):
        end = contact_gap(switches[e], active[e], tables, s, step)
        if end > 0.0:
            low, high = 0.0, step
            g_low = contact_gap(switches[e], active[e], tables, s, 0.0)
            g_low, g_high = min(g_low, -1e-300), end
            # Root by the Illinois method; the later end of the final bracket is taken.
            for _ in range(8):
                guess = low + (high - low) * g_low / (g_low - g_high)
                value = contact_gap(switches[e], active[e], tables, s, guess)
                if value > 0.0:
                    high, g_high, g_low = guess, value, 0.5 * g_low
                else:
                    low, g_low, g_high = guess, min(value, -1e-300), 0.5 * g_high
            step = high
            switching = e
    return step, switching


@inlined
def advance(tables, bodies, push, lanes):
    """Advance x, v and the presliding state z by a step, from event to event.

    Derivatives are advanced too; see `make_sensitivities`.
    """
    s, K, C, n, N = bodies.s, bodies.K, bodies.C, bodies.n, bodies.N
    switches, active = bodies.switches, bodies.active
    left = push.h
    events = 0
    none = N + switches.size  # not the number of a body or switch
    while left > 1e-12:
        step = left
        for e in range(switches.size):
            # Inside a stiff contact the series needs shorter steps.
            if active[e] and not n <= switches[e] <= 2 * n:
                step = min(step, push.contact_step)
        for i in range(N):
            s[MID_X, i] = s[X, i] + 0.5 * step * (s[V, i] + 0.25 * step * s[ACC, i])
            s[MID_V, i] = s[V, i] + 0.5 * step * s[ACC, i]
            s[FORCE, i] = s[FIX, i]
            s[GRIP, i] = s[INV, i]
        if push.smooth:
            smooth_forces(tables, bodies, push.u, push.on, push.smooth)
        s[FORCE, bodies.driven] += push.u
        if push.dry:
            dry_friction(tables.cart, bodies, push, step)
        # Because the usual sizes are constants here, the compiler unrolls the loops.
        if N == 1:
            taylor(s, K, C, np.int64(1))
        elif N == 2:
            taylor(s, K, C, np.int64(2))
        elif N == 3:
            taylor(s, K, C, np.int64(3))
        else:
            taylor(s, K, C, N)
        whole = step
        stopping = switching = none
        if push.dry and events < _MOST_EVENTS:
            step, stopping = first_stop(s, n, step, none)
        if events < _MOST_EVENTS:
            step, switching = first_switch(tables, bodies, step, none)
            if switching != none:
                stopping = none
        if lanes.of.size > 0:
            propagate(tables, bodies, push, lanes, whole, step)
        for i in range(N):
            s[X, i], s[V, i] = position(s, i, step), velocity(s, i, step)
            s[ACC, i] = s[D2, i] + step * (s[D3, i] + 0.5 * step * s[D4, i])
        if push.dry:
            for i in range(n):
                most, target, pace = hysteresis(tables.cart, i, s[MID_V, i])
                if most > 0.0:
                    decay = s[DECAY, i] * s[DECAY, i] if step == whole else exp(-pace * step)
                    s[Z, i] = target + (s[Z, i] - target) * decay
                if s[SIDE, i] != 0.0 and s[SIDE, i] * s[V, i] < 0.0:
                    s[V, i] = 0.0
        if stopping != none:
            stop(lanes.T, s, N, stopping)
            s[V, stopping] = 0.0
            s[ACC, stopping] = 0.0
            events += 1
        if switching != none:
            which, ends = switches[switching], 1.0 if active[switching] else 0.0
            if not n <= which <= 2 * n:
                body, other, _, k, c, _ = contact(which, tables)
                saltation(lanes.T, bodies, body, other, k, ends * c)
            active[switching] = not active[switching]
            sign = 1.0 if active[switching] else -1.0
            lanes.phi[2 * N, 0] = -1.0  # the carts' equations change here
            toggle_contact(which, sign, tables, s, K, C)
            events += 1
        left -= step


# ---------------------------------------------------------------------- the simulation

_SERIES_REACH = 0.2  # omega h; with it, the sixth-order series has an error of 1e-8 after seconds
_CONTACT_REACH = 0.4  # omega h inside a contact
_INSTANT = 1e-9  # s; events closer than this count as simultaneous
_BLOWN_UP = 1e9  # position at which the simulation has diverged


class Excitation(NamedTuple):
    """The input of one run, and the prescribed motion of its carts.

    Attributes
    ----------
    t : times (samples,).
    knots, command : times and values (k,) of the input, held from knot to knot. The knots may begin
        before the first sample; the drive is at rest before them.
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
def _lag_before(run, time, tau):
    """Return the lagged input at `time`, if the drive was at rest before the first knot."""
    knots, held = run.knots, run.held
    lagged, at = held[0, 0], 0
    while at < knots.size and knots[at] < time:
        span = (min(knots[at + 1], time) if at < knots.size - 1 else time) - knots[at]
        lagged = held[0, at] + (lagged - held[0, at]) * exp(-span / tau)
        at += 1
    return lagged


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
    lagged = _lag_before(run, t[0] - delay, tau) if tau > 0.0 else 0.0
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
