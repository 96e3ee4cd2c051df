"""The state of a simulation and its derivatives, which are integrated with it.

A small change of a parameter acts like a small force on the same linear system. Per unit of change,
this force is -a for a mass, -v for a damping, the stretch for a spring, and the friction itself for
a friction factor. So each derivative is itself a motion. In every step it is advanced by the
matrix exponential of the carts' equations. Half of the small force's impulse is added before this,
half after.

If dry friction stops a cart or a contact switches, the instant depends on the parameter. At this
instant, the derivative of the velocity jumps in proportion to the jump of the acceleration (a
saltation). Impulses are accurate to second order in the step. A derivative is then accurate to
1e-3, which is enough to guide a fit.

Reference: I. A. Hiskens, M. A. Pai, IEEE Trans. Circuits and Systems I 47 (2000), 204-220.
"""

from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.simulator.compiler import jit
from pipeline.plant.simulator.generated_forces import (
    ON_CARTS,
    ON_DRIVE,
    ON_SPRINGS,
    bilinear_spring,
    cart_slopes,
    drive_slopes,
    hysteresis,
    hysteresis_slopes,
    motor_slopes,
    spring_slopes,
    stribeck_slope,
)

# -------------------------------------------------- structures that the compiled functions share
#
# They are named tuples, because numba compiles these to separate fields.

# Rows of the state table.
# - X to INV: position, velocity, presliding state, last acceleration and inverse mass.
# - MID_X to FORCE: position and velocity in the middle of the step, and the force.
# - D2 to D6: time derivatives 2 to 6 of the position.
# - SIDE to FIX: direction in which the cart slides, inverse mass (0 for a cart held by friction),
# decay of the presliding state over half a step, constant forces of closed contacts.
# - RUB to PAST: dry friction force, acceleration before an event, whether an event has just changed
# the acceleration, whether a spring is stretched past its gap.
# - HALF_X to HALF_A: position, velocity and acceleration halfway to the next event or to the end of
# the step.
X, V, Z, ACC, INV, MID_X, MID_V, FORCE, D2, D3, D4, D5, D6, SIDE, GRIP, DECAY, FIX = range(17)
RUB, BEFORE, TURNED, PAST, HALF_X, HALF_V, HALF_A = range(17, 24)
ROWS = 24


class Bodies(NamedTuple):
    """Carts, motor and hidden masses: the linear part of the plant, and its state.

    Attributes
    ----------
    n, N : number of carts, and of all bodies.
    motor : the motor's row, or -1 if the motor is not a separate body.
    driven : row of the body on which the input acts.
    parent : row of the cart that carries a hidden mass; -1 for other bodies.
    s : the state table.
    K, C : the stiffness and damping matrices. Closed contacts are included.
    switches : numbers of the existing contacts and slack springs, as in `contact_gap`.
    active : whether each of the switches is closed.
    """

    n: int
    N: int
    motor: int
    driven: int
    parent: NDArray
    s: Array
    K: Array
    C: Array
    switches: NDArray
    active: NDArray


class Push(NamedTuple):
    """The forces and options for a step of `h` s.

    Attributes
    ----------
    u : mean input that arrives during the step.
    on : 1 if the drive is powered, otherwise 0.
    scatter : factor (n,) on all dry friction of each cart.
    dry : whether there is dry friction.
    smooth : flags for the places of smooth forces, from `longest_step`.
    contact_step : longest step inside a contact.
    """

    u: float
    on: float
    h: float
    scatter: Array
    dry: bool
    smooth: int
    contact_step: float


@jit
def add_spring(M, j, n, value):
    """Add `value` for a spring j (0 to n) of n carts to a symmetric matrix."""
    if j < n:
        M[j, j] += value
    if j > 0:
        M[j - 1, j - 1] += value
    if 0 < j < n:
        M[j, j - 1] -= value
        M[j - 1, j] -= value


@jit
def pair(M, i, j, value):
    """Add `value` between bodies i and j, or i and a wall (-1), to a symmetric matrix."""
    M[i, i] += value
    if j >= 0:
        M[j, j] += value
        M[i, j] -= value
        M[j, i] -= value


@jit
def stretch(s, row, j, n):
    """Return the stretch of spring j of n carts, from a row of the state table."""
    return (s[row, j] if j < n else 0.0) - (s[row, j - 1] if j > 0 else 0.0)


# --------------------------------------------------------------------- derivatives of the motion

# Kinds of variables for derivatives: an entry of the tables, for a cart or spring; the factor on a
# cart's dry friction; or the start of a cart. Start numbers from n on are hidden masses.
BY_MASS, BY_DAMPING, BY_STIFFNESS, BY_FRICTION, BY_POSITION, BY_VELOCITY = range(6)
_BLOCK = 4  # lanes that a processor computes at once, along the last axis


class Sensitivities(NamedTuple):
    """Derivatives of the state of N bodies, each in its own lane, with work arrays.

    Attributes
    ----------
    of : (2, lanes), the kind of variable of each lane, and its cart or spring (from 0).
    T : (5 N + 2, blocks, 4) array. Its rows are N positions, N velocities, N presliding states, the
        time of the current event, a force, and 2 N rows of work space.
    phi : (2 N + 1, 2 N) matrix that advances positions and velocities. Its last row holds the step
        and the inverse masses for which it is valid.
    work : (7, N) work space to compute `phi`.
    """

    of: NDArray[np.int64]
    T: Array
    phi: Array
    work: Array


def make_sensitivities(of: NDArray[np.int64], N: int) -> Sensitivities:
    """Return the lanes for the variables `of` (2, lanes) and N bodies, in whole blocks."""
    wanted = of.shape[1]
    blocks = (wanted + _BLOCK - 1) // _BLOCK
    padded = np.full((2, blocks * _BLOCK), BY_VELOCITY + 1)  # not a kind: fills up the last block
    padded[:, :wanted] = of
    T, phi = np.zeros((5 * N + 2, blocks, _BLOCK)), np.full((2 * N + 1, 2 * N), -1.0)
    return Sensitivities(padded, T, phi, np.empty((7, N)))


@jit
def _add(T, row, factor, other):
    """Add a multiple of another row to a row."""
    for block in range(T.shape[1]):
        for q in range(_BLOCK):
            T[row, block, q] += factor * T[other, block, q]


@jit
def propagate(tables, bodies, push, lanes, whole, step):
    """Advance the derivatives by `step`, before the state moves.

    Forces are those in the middle of the `whole` step.
    """
    s, n, N, cart = bodies.s, bodies.n, bodies.N, tables.cart
    T, phi, of = lanes.T, lanes.phi, lanes.of
    moved = 3 * N + 2
    # The matrix is computed again only if the step differs by more than this.
    changed = abs(step - phi[2 * N, 0]) > 1e-9 * step
    for i in range(N):
        if s[TURNED, i] != 0.0:
            _add(T, N + i, s[BEFORE, i] - s[D2, i], 3 * N)
            s[TURNED, i] = 0.0
        if s[GRIP, i] == 0.0:
            _add(T, N + i, -1.0, N + i)  # a held cart, even one just gripped, has no speed
        changed = changed or s[GRIP, i] != phi[2 * N, N + i]
        s[HALF_X, i] = s[X, i] + 0.5 * step * (s[V, i] + 0.25 * step * s[D2, i])
        s[HALF_V, i] = s[V, i] + 0.5 * step * s[D2, i]
        s[HALF_A, i] = s[D2, i] + 0.5 * step * s[D3, i]
    if changed:
        _exponential(bodies, lanes, step)
    for lane in range(of.shape[1]):
        if of[0, lane] > BY_FRICTION:
            continue
        force = _force(of[0, lane], of[1, lane], s, n, tables.spring)
        T[3 * N + 1, lane // _BLOCK, lane % _BLOCK] = force
    _impulse(tables, bodies, push, lanes, whole, 0.5 * step)
    for row in range(2 * N):
        for block in range(T.shape[1]):
            a = b = c = d = 0.0
            for column in range(2 * N):
                p = phi[row, column]
                a += p * T[column, block, 0]
                b += p * T[column, block, 1]
                c += p * T[column, block, 2]
                d += p * T[column, block, 3]
            T[moved + row, block, 0] = a
            T[moved + row, block, 1] = b
            T[moved + row, block, 2] = c
            T[moved + row, block, 3] = d
    for i in range(n):
        most, target, pace = hysteresis(cart, i, s[MID_V, i])
        if most > 0.0:
            decay = exp(-pace * step)
            slope = _settled(cart, i, s, target, decay, step)
            _add(T, 2 * N + i, decay - 1.0, 2 * N + i)
            _add(T, 2 * N + i, 0.5 * slope, N + i)
            _add(T, 2 * N + i, 0.5 * slope, moved + N + i)
    for row in range(2 * N):
        for block in range(T.shape[1]):
            for q in range(_BLOCK):
                T[row, block, q] = T[moved + row, block, q]
    _impulse(tables, bodies, push, lanes, whole, 0.5 * step)


@jit
def _exponential(bodies, lanes, step):
    """Fill `phi` with the matrix exponential, column by column, by a series to sixth order."""
    s, K, C, N, phi, work = bodies.s, bodies.K, bodies.C, bodies.N, lanes.phi, lanes.work
    for column in range(2 * N):
        for i in range(N):
            work[0, i] = 1.0 if column == i else 0.0
            work[1, i] = 1.0 if column == N + i else 0.0
        for row in range(2, 7):
            for i in range(N):
                f = 0.0
                for j in range(N):
                    f -= K[i, j] * work[row - 2, j] + C[i, j] * work[row - 1, j]
                work[row, i] = s[GRIP, i] * f
        for i in range(N):
            x, v = 0.0, 0.0
            for row in range(6, 1, -1):
                x = (x + work[row, i]) * step / row
                v = (v + work[row, i]) * step / (row - 1)
            phi[i, column] = work[0, i] + step * (work[1, i] + x)
            phi[N + i, column] = work[1, i] + v
    phi[2 * N, 0] = step
    for i in range(N):
        phi[2 * N, N + i] = s[GRIP, i]


@jit
def _force(kind, at, s, n, spring):
    """Return the force that a unit change of a parameter adds, in the middle of the step.

    It acts on the parameter's cart. For a spring, it pulls the two ends together.
    """
    if kind == BY_MASS:
        return -s[HALF_A, at]
    if kind == BY_DAMPING:
        return -s[HALF_V, at]
    if kind == BY_FRICTION:
        return s[RUB, at]
    reach = stretch(s, HALF_X, at, n)
    if s[PAST, at] != 0.0:
        _, past, share = bilinear_spring(spring, at)
        reach += share * (reach - past)
    return -reach


@jit
def _impulse(tables, bodies, push, lanes, whole, span):
    """Add to each lane the impulse, over `span` s, of its small force and of nonlinear forces."""
    s, n, N, driven, T, of = bodies.s, bodies.n, bodies.N, bodies.driven, lanes.T, lanes.of
    cart, drive, scatter = tables.cart, tables.drive, push.scatter
    u, on, smooth = push.u, push.on, push.smooth
    for lane in range(of.shape[1]):
        kind, at, block, q = of[0, lane], of[1, lane], lane // _BLOCK, lane % _BLOCK
        if kind > BY_FRICTION:
            continue
        pull = span * T[3 * N + 1, block, q]
        if at < n:
            T[N + at, block, q] += s[GRIP, at] * pull
        if kind == BY_STIFFNESS and at > 0:
            T[N + at - 1, block, q] -= s[GRIP, at - 1] * pull
    if smooth & ON_DRIVE:
        by_x, by_v = motor_slopes(drive, s[MID_X, driven], s[MID_V, driven], u, on)
        _bend(T, bodies, driven, driven, span, by_x, by_v)
        by_x, by_v = drive_slopes(drive, s[MID_X, 0], s[MID_V, 0], u, on)
        _bend(T, bodies, 0, 0, span, by_x, by_v)
    for j in range(n + 1 if smooth & ON_SPRINGS else 0):
        d, rate = stretch(s, MID_X, j, n), stretch(s, MID_V, j, n)
        by_d, by_rate = spring_slopes(tables.spring, j, d, rate)
        for body, near in ((j, j - 1), (j - 1, j)):
            if 0 <= body < n:
                _bend(T, bodies, body, body, span, -by_d, -by_rate)
                if 0 <= near < n:
                    _bend(T, bodies, body, near, span, by_d, by_rate)
    for i in range(n):
        by_x = by_v = 0.0
        if smooth & ON_CARTS:
            by_x, by_v = cart_slopes(cart, i, s[MID_X, i], s[MID_V, i], u)
        if s[SIDE, i] != 0.0 and s[V, i] != 0.0:
            by_v -= scatter[i] * stribeck_slope(cart, i, abs(s[MID_V, i]), u)
        most, target, _ = hysteresis(cart, i, s[MID_V, i])
        if most > 0.0:
            by_v -= scatter[i] * most * _settled(cart, i, s, target, s[DECAY, i], 0.5 * whole)
            _add(T, N + i, -s[GRIP, i] * span * scatter[i] * most * s[DECAY, i], 2 * N + i)
        _bend(T, bodies, i, i, span, by_x, by_v)


@jit
def _settled(cart, i, s, target, decay, span):
    """Return d/dv of cart i's presliding state after `span` s at constant velocity v."""
    by_target, by_pace = hysteresis_slopes(cart, i, s[MID_V, i])
    return by_target * (1.0 - decay) - (s[Z, i] - target) * decay * span * by_pace


@jit
def _bend(T, bodies, body, by, span, by_x, by_v):
    """Add to a body's lanes the impulse of a force that depends on the state of body `by`."""
    s, N = bodies.s, bodies.N
    if by_x != 0.0:
        _add(T, N + body, s[GRIP, body] * span * by_x, by)
    if by_v != 0.0:
        _add(T, N + body, s[GRIP, body] * span * by_v, N + by)


@jit
def stop(T, s, N, i):
    """For each lane, store the derivative of the time at which dry friction stops body i."""
    before = s[ACC, i]
    _add(T, 3 * N, -1.0, 3 * N)
    if before != 0.0:
        _add(T, 3 * N, -1.0 / before, N + i)
    s[BEFORE, i], s[TURNED, i] = before, 1.0


@jit
def saltation(T, bodies, body, other, stiffness, damping):
    """For each lane, store the derivative of the time at which a contact begins or ends.

    `other` is the other body, or -1 for a wall. A contact ends when its push, given by stiffness
    and damping, ends. It begins (with damping 0) when the bodies touch.
    """
    s, N = bodies.s, bodies.N
    rate = stiffness * s[V, body] + damping * s[ACC, body]
    if other >= 0:
        rate -= stiffness * s[V, other] + damping * s[ACC, other]
    _add(T, 3 * N, -1.0, 3 * N)
    if rate == 0.0:
        return
    for end, sign in ((body, -1.0), (other, 1.0)):
        if end >= 0:
            _add(T, 3 * N, sign * stiffness / rate, end)
            _add(T, 3 * N, sign * damping / rate, N + end)
            s[BEFORE, end], s[TURNED, end] = s[ACC, end], 1.0


@jit
def restart(bodies, lanes, shot, free):
    """Restart the derivatives at the beginning of a shot."""
    n, N, motor, parent, T, of = (
        bodies.n, bodies.N, bodies.motor, bodies.parent, lanes.T, lanes.of
    )  # fmt: skip
    for lane in range(of.shape[1]):
        kind, at, block, q = of[0, lane], of[1, lane], lane // _BLOCK, lane % _BLOCK
        for first, by in ((0, BY_POSITION), (N, BY_VELOCITY)):
            for i in range(n):
                if not free[i]:
                    continue
                start = 1.0 if kind == by and at == i else 0.0
                for j in range(n, N):
                    if parent[j] == i or (j == motor and i == 0):
                        T[first + j, block, q] += start - T[first + i, block, q]
                        if shot == 0 and j != motor and kind == by and at == n + i:
                            T[first + j, block, q] += 1.0
                T[first + i, block, q] = start


@jit
def bend_presliding(bodies, lanes, i, most, scatter):
    """Set the derivatives of cart i's presliding state at the start, given those of the forces."""
    s, n, N, T, of = bodies.s, bodies.n, bodies.N, lanes.T, lanes.of
    for lane in range(of.shape[1]):
        kind, at, block, q = of[0, lane], of[1, lane], lane // _BLOCK, lane % _BLOCK
        net = 0.0
        for j in range(N):
            net -= bodies.K[i, j] * T[j, block, q]
        if kind == BY_STIFFNESS and (at == i or at == i + 1):
            net += stretch(s, X, at, n) * (1.0 if at == i + 1 else -1.0)
        T[2 * N + i, block, q] = net / (scatter[i] * most)
        if kind == BY_FRICTION and at == i:
            T[2 * N + i, block, q] -= s[Z, i] / scatter[i]
