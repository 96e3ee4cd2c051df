"""Simulate carts with dry friction, contact, slack and an imperfect drive: compiled, by events.

Every substep takes the linear part (springs, dampers, hidden masses) by a Taylor series to sixth
order, so the linear chain is exact to rounding, and holds the nonlinear forces at their value in
the middle of the step. Dry friction is set-valued: a cart that stops inside a step stops at the
root of its velocity polynomial, and from rest it either sticks (and then truly does not move) or
slides on. No tanh, no threshold velocity.

What is simulated is told by three tables, one row a cart, a spring, and one for the drive; an
effect fills columns of them (`pipeline.plant.effects`), and the neutral values of all columns
give the linear chain back.

Reference: E. Hairer, C. Lubich, G. Wanner, "Geometric Numerical Integration", 2nd ed., sec.
VIII.2; for the friction events B. Armstrong-Hélouvry, P. Dupont, C. Canudas de Wit,
Automatica 30 (1994), section 4.
"""

# The compiled functions index flat tables and are long: numba cannot see dataclasses.

import numpy as np
from numba import njit

_SERIES_REACH = 0.2  # omega h: the series' sixth order then leaves 1e-8 after seconds
_LONGEST_LINEAR = 4.5e-3  # s; springs, dampers and dry friction are exact at any step
_CONTACT_REACH = 0.25  # omega h inside a contact, whose force is held over the step
_DAHL_STEP = 2.3e-3  # s; the presliding state is held over half of it
_LONGEST_STEP = 2.5e-3  # s; nonlinear forces are held over it
_MAX_PIECES = 12  # events in one substep; more would be chatter
_BLOWN_UP = 1e9  # positions beyond this are a diverged model


# The columns of `pipeline.plant.tables` as plain integers, which compile to constants.
MASS, DAMPING, COULOMB, STATIC, STRIBECK, DAHL, DISTANCE, LOAD = (int(i) for i in range(8))
DRAG, OFFSET, STOP, STOP_K, STOP_D, GAIN, HID_M, HID_K, HID_C = (int(i) for i in range(8, 17))
STIFF, CUBIC, CHANGE, STRETCH, COUPLING = (int(i) for i in range(5))
DEAD, LIMIT, DELAY, LAG, DRIVE_C, GAP, MOTOR, CONTACT_K, CONTACT_D = (int(i) for i in range(9))

# Rows of the state table: position, velocity, presliding state, last acceleration, inverse mass,
# state in the middle of the step, force, time derivatives 2 to 6 of the position, and the dry
# friction's direction, the inverse mass it leaves (0 for a cart that sticks), and the decay of the
# presliding state over half a step.
X, V, Z, ACC, INV, MID_X, MID_V, FORCE, D2, D3, D4, D5, D6, SIDE, GRIP, DECAY = range(16)
ROWS = 16

_jit = njit(
    cache=True, nogil=True, fastmath={"contract", "reassoc", "arcp", "nsz"}, error_model="numpy"
)
_inl = njit(
    cache=True,
    nogil=True,
    fastmath={"contract", "reassoc", "arcp", "nsz"},
    error_model="numpy",
    inline="always",
)


@_jit
def _assemble(cart, spring, drive, free, s, K, C):
    """Fill the linear matrices; returns dof count, motor index or -1, parents of hidden masses."""
    n = cart.shape[0]
    K[:] = 0.0
    C[:] = 0.0
    for i in range(n):
        s[INV, i] = 1.0 / cart[i, MASS] if free[i] else 0.0
        C[i, i] += cart[i, DAMPING]
    for j in range(n + 1):
        k, c = spring[j, STIFF], spring[j, COUPLING]
        if j > 0:
            K[j - 1, j - 1] += k
            C[j - 1, j - 1] += c
        if j < n:
            K[j, j] += k
            C[j, j] += c
        if 0 < j < n:
            K[j - 1, j] -= k
            K[j, j - 1] -= k
            C[j - 1, j] -= c
            C[j, j - 1] -= c
    N = n
    motor = -1
    if drive[GAP] > 0.0 and free[0]:
        motor = N
        s[INV, N] = 1.0 / drive[MOTOR]
        s[INV, 0] = 1.0 / max(cart[0, MASS] - drive[MOTOR], 0.02 * cart[0, MASS])
        N += 1
    parent = np.full(2 * n + 1, -1)
    for i in range(n):
        if cart[i, HID_M] > 0.0:
            k, c = cart[i, HID_K], cart[i, HID_C]
            s[INV, N] = 1.0 / cart[i, HID_M]
            K[N, N] += k
            K[i, i] += k
            K[i, N] -= k
            K[N, i] -= k
            C[N, N] += c
            C[i, i] += c
            C[i, N] -= c
            C[N, i] -= c
            parent[N] = i
            N += 1
    return N, motor, parent


@_jit
def _nonlinear(cart, spring, drive, n, motor, s, at_x, at_v):
    """Set FORCE to the smooth and contact forces beyond the linear ones, friction excepted."""
    for i in range(n):
        f = cart[i, OFFSET]
        if cart[i, DRAG] != 0.0:
            f -= cart[i, DRAG] * s[at_v, i] * abs(s[at_v, i])
        if cart[i, STOP_K] > 0.0:
            side = 1.0 if cart[i, STOP] > 0.0 else -1.0
            depth = side * (s[at_x, i] - cart[i, STOP])
            if depth > 0.0:
                push = cart[i, STOP_K] * depth + cart[i, STOP_D] * side * s[at_v, i]
                f -= side * max(push, 0.0)
        s[FORCE, i] = f
    for j in range(n + 1):
        a, r = spring[j, CUBIC], spring[j, CHANGE]
        if a == 0.0 and r == 0.0:
            continue
        stretch = (s[at_x, j] if j < n else 0.0) - (s[at_x, j - 1] if j > 0 else 0.0)
        f = a * stretch * stretch * stretch
        if r != 0.0:
            side = 1.0 if spring[j, STRETCH] >= 0.0 else -1.0
            beyond = stretch - spring[j, STRETCH]
            if side * beyond > 0.0:
                f += r * spring[j, STIFF] * beyond
        if j < n:
            s[FORCE, j] -= f
        if j > 0:
            s[FORCE, j - 1] += f
    if motor >= 0:
        s[FORCE, motor] = 0.0
        lead = s[at_x, motor] - s[at_x, 0]
        half = 0.5 * drive[GAP]
        if abs(lead) > half:
            side = 1.0 if lead > 0.0 else -1.0
            push = drive[CONTACT_K] * (side * lead - half)
            push += drive[CONTACT_D] * side * (s[at_v, motor] - s[at_v, 0])
            if push > 0.0:
                s[FORCE, 0] += side * push
                s[FORCE, motor] -= side * push


@_inl
def _taylor(s, K, C, N):
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


@_inl
def _advance(cart, spring, drive, n, N, motor, s, K, C, scatter, u, drive_c, h, dry, smooth):
    """Advance x, v and the presliding state z by h, from friction event to friction event."""
    driven = motor if motor >= 0 else 0
    left = h
    for _piece in range(_MAX_PIECES):
        for i in range(N):
            s[MID_X, i] = s[X, i] + 0.5 * left * (s[V, i] + 0.25 * left * s[ACC, i])
            s[MID_V, i] = s[V, i] + 0.5 * left * s[ACC, i]
            s[FORCE, i] = 0.0
            s[GRIP, i] = s[INV, i]
        if not smooth:
            _nonlinear(cart, spring, drive, n, motor, s, MID_X, MID_V)
        s[FORCE, driven] += u
        s[FORCE, 0] -= drive_c * s[MID_V, 0]
        if dry:
            for i in range(n):
                if cart[i, DAHL] > 0.0 and s[INV, i] > 0.0:
                    sign = 1.0 if s[MID_V, i] > 0.0 else -1.0
                    path = 0.5 * abs(s[MID_V, i]) * left / cart[i, DISTANCE]
                    s[DECAY, i] = np.exp(-path)
                    held = sign + (s[Z, i] - sign) * s[DECAY, i]
                    s[FORCE, i] -= scatter[i] * cart[i, DAHL] * held
            for i in range(n):
                # side: the direction the cart slides in, 0 where nothing dry acts on it.
                s[SIDE, i] = 0.0
                slide = cart[i, COULOMB] + cart[i, LOAD] * abs(u)
                if slide + cart[i, STATIC] <= 0.0 or s[INV, i] == 0.0:
                    continue
                if s[V, i] == 0.0:
                    net = s[FORCE, i]
                    for j in range(N):
                        net -= K[i, j] * s[X, j] + C[i, j] * s[V, j]
                    if abs(net) <= scatter[i] * (slide + cart[i, STATIC]):
                        s[GRIP, i] = 0.0
                        continue
                    s[SIDE, i] = 1.0 if net > 0.0 else -1.0
                    speed = 0.5 * left * (abs(net) - scatter[i] * slide) * s[INV, i]
                else:
                    s[SIDE, i] = 1.0 if s[V, i] > 0.0 else -1.0
                    speed = abs(s[MID_V, i])
                if cart[i, STATIC] != 0.0:
                    ratio = speed / cart[i, STRIBECK]
                    slide += cart[i, STATIC] * np.exp(-ratio * ratio)
                s[FORCE, i] -= scatter[i] * slide * s[SIDE, i]
        # The usual sizes as constants: the compiler then unrolls the loops.
        if N == 1:
            _taylor(s, K, C, 1)
        elif N == 2:
            _taylor(s, K, C, 2)
        elif N == 3:
            _taylor(s, K, C, 3)
        else:
            _taylor(s, K, C, N)
        step = left
        stopping = -1
        if dry:
            for i in range(n):
                if s[SIDE, i] == 0.0:
                    continue
                end = _velocity(s[V, i], s[D2, i], s[D3, i], s[D4, i], s[D5, i], s[D6, i], step)
                if s[SIDE, i] * end < 0.0 and s[V, i] != 0.0:
                    # The root of the velocity: false position, made safe by its bracket.
                    low, high, v_low, v_high = 0.0, step, s[V, i], end
                    for _ in range(4):
                        guess = low + (high - low) * v_low / (v_low - v_high)
                        value = _velocity(
                            s[V, i], s[D2, i], s[D3, i], s[D4, i], s[D5, i], s[D6, i], guess
                        )
                        if s[SIDE, i] * value > 0.0:
                            low, v_low = guess, value
                        else:
                            high, v_high = guess, value
                    step = low + (high - low) * v_low / (v_low - v_high)
                    stopping = i
        for i in range(N):
            s[X, i] += step * (
                s[V, i]
                + step
                / 2.0
                * (
                    s[D2, i]
                    + step
                    / 3.0
                    * (
                        s[D3, i]
                        + step / 4.0 * (s[D4, i] + step / 5.0 * (s[D5, i] + step / 6.0 * s[D6, i]))
                    )
                )
            )
            s[V, i] = _velocity(s[V, i], s[D2, i], s[D3, i], s[D4, i], s[D5, i], s[D6, i], step)
            s[ACC, i] = s[D2, i] + step * (s[D3, i] + 0.5 * step * s[D4, i])
        if dry:
            for i in range(n):
                if cart[i, DAHL] > 0.0:
                    sign = 1.0 if s[MID_V, i] > 0.0 else -1.0
                    decay = s[DECAY, i] * s[DECAY, i]
                    if stopping >= 0:
                        decay = np.exp(-abs(s[MID_V, i]) * step / cart[i, DISTANCE])
                    s[Z, i] = sign + (s[Z, i] - sign) * decay
                if s[SIDE, i] != 0.0 and s[SIDE, i] * s[V, i] < 0.0:
                    s[V, i] = 0.0
        if stopping < 0:
            return
        s[V, stopping] = 0.0
        s[ACC, stopping] = 0.0
        left -= step
        if left <= 1e-12:
            return


@_jit
def _velocity(v, d2, d3, d4, d5, d6, h):
    return v + h * (d2 + h / 2.0 * (d3 + h / 3.0 * (d4 + h / 4.0 * (d5 + h / 5.0 * d6))))


@_jit
def _integral(time, knots, u, total, at):
    """Integrate the held input up to `time`; `at` is the interval found last."""
    last = knots.size - 1
    while at < last and knots[at + 1] <= time:
        at += 1
    while at > 0 and knots[at] > time:
        at -= 1
    return total[at] + u[at] * (time - knots[at]), at


@_jit
def _simulate(cart, spring, drive, x0, v0, scatter, free, t, knots, command, starts, refine, y):
    """Fill y (n, samples) with the readings of one run; False where the model diverged."""
    n = cart.shape[0]
    size = 2 * n + 1
    s, K, C = np.zeros((ROWS, size)), np.zeros((size, size)), np.zeros((size, size))
    N, motor, parent = _assemble(cart, spring, drive, free, s, K, C)

    dry = False
    smooth = motor < 0
    presliding = False
    fastest = 0.0
    contact = 0.0
    for i in range(N):
        row = 0.0
        for j in range(N):
            row += abs(K[i, j])
        fastest = max(fastest, row * s[INV, i])
    for i in range(n):
        dry = dry or cart[i, COULOMB] + cart[i, STATIC] + cart[i, LOAD] + cart[i, DAHL] > 0.0
        presliding = presliding or cart[i, DAHL] > 0.0
        smooth = smooth and cart[i, OFFSET] == 0.0 and cart[i, DRAG] == 0.0
        smooth = smooth and cart[i, STOP_K] == 0.0
        contact = max(contact, cart[i, STOP_K] * s[INV, i])
    for j in range(n + 1):
        smooth = smooth and spring[j, CUBIC] == 0.0 and spring[j, CHANGE] == 0.0
        if spring[j, CHANGE] > 0.0:
            # A spring that hardens past its gap is the faster one.
            extra = spring[j, CHANGE] * spring[j, STIFF]
            heavier = max(s[INV, j] if j < n else 0.0, s[INV, j - 1] if j > 0 else 0.0)
            fastest += extra * heavier
    longest = min(
        _LONGEST_LINEAR if smooth else _LONGEST_STEP, _SERIES_REACH / np.sqrt(fastest + 1e-12)
    )
    if presliding:
        longest = min(longest, _DAHL_STEP)
    if motor >= 0:
        rate = drive[CONTACT_K] * (s[INV, 0] + s[INV, motor])
        longest = min(longest, _CONTACT_REACH / np.sqrt(rate))
    longest /= refine
    contact_step = _CONTACT_REACH / np.sqrt(contact) / refine if contact > 0.0 else longest

    u = np.empty(command.size)
    total = np.zeros(command.size)
    for i in range(command.size):
        value = command[i]
        if drive[DEAD] != 0.0:
            size_past = abs(value) - drive[DEAD]
            value = np.sign(value) * size_past if size_past > 0.0 else 0.0
        u[i] = min(max(value, -drive[LIMIT]), drive[LIMIT])
        if i > 0:
            total[i] = total[i - 1] + u[i - 1] * (knots[i] - knots[i - 1])
    lagged = u[0]
    at = 0
    on = 0

    for shot in range(starts.size - 1):
        first, end = starts[shot], starts[shot + 1]
        for i in range(n):
            if free[i]:
                # Hidden masses and the motor keep their place relative to their cart.
                for j in range(n, N):
                    if (parent[j] == i) or (j == motor and i == 0):
                        s[X, j] += x0[shot, i] - s[X, i]
                        s[V, j] += v0[shot, i] - s[V, i]
                s[X, i], s[V, i] = x0[shot, i], v0[shot, i]
                s[ACC, i] = 0.0
        past, at = _integral(t[first] - drive[DELAY], knots, u, total, at)
        if shot == 0 and presliding:
            _nonlinear(cart, spring, drive, n, motor, s, X, V)
            for i in range(n):
                if cart[i, DAHL] > 0.0:
                    net = s[FORCE, i] + (u[0] if i == 0 else 0.0)
                    for j in range(N):
                        net -= K[i, j] * s[X, j]
                    s[Z, i] = min(max(net / (scatter[i] * cart[i, DAHL]), -1.0), 1.0)
                    if abs(s[V, i]) > 0.0:
                        s[Z, i] = np.sign(s[V, i])
        for sample in range(first, end):
            for i in range(n):
                y[i, sample] = cart[i, GAIN] * s[X, i]
            if sample == end - 1:
                break
            interval = t[sample + 1] - t[sample]
            count = int(np.ceil(interval / longest - 1e-9))
            if contact > 0.0:
                for i in range(n):
                    if cart[i, STOP_K] > 0.0:
                        side = 1.0 if cart[i, STOP] > 0.0 else -1.0
                        reach = side * (s[X, i] - cart[i, STOP]) + 1.5 * interval * abs(s[V, i])
                        reach += interval * interval * abs(s[ACC, i])
                        if reach > 0.0:
                            count = max(count, int(np.ceil(interval / contact_step)))
            h = interval / count
            for sub in range(count):
                now = t[sample] + sub * h
                upto, at = _integral(now + h - drive[DELAY], knots, u, total, at)
                mean = (upto - past) / h
                past = upto
                if drive[LAG] > 0.0:
                    decay = np.exp(-h / drive[LAG])
                    target = mean
                    mean = target + (lagged - target) * drive[LAG] / h * (1.0 - decay)
                    lagged = target + (lagged - target) * decay
                drive_c = 0.0
                if drive[DRIVE_C] != 0.0:
                    while on < knots.size - 1 and knots[on + 1] <= now + 0.5 * h:
                        on += 1
                    drive_c = drive[DRIVE_C] if command[on] != 0.0 else 0.0
                _advance(
                    cart,
                    spring,
                    drive,
                    n,
                    N,
                    motor,
                    s,
                    K,
                    C,
                    scatter,
                    mean,
                    drive_c,
                    h,
                    dry,
                    smooth,
                )
            if not abs(s[X, 0]) + abs(s[X, n - 1]) < _BLOWN_UP:
                return False
    return True


@_jit
def simulate_batch(cart, spring, drive, x0, v0, scatter, free, t, knots, command, starts, refine):
    """Simulate many variants of one run.

    Parameters
    ----------
    cart, spring, drive : (b, n, 17), (b, n + 1, 5), (b, 9) tables, see `Cart`, `Spring`, `Drive`.
    x0, v0 : (b, shots, n) positions and velocities of the carts at the start of each shot.
    scatter : (b, n) factor on all dry friction of a cart.
    free : (n,) which carts move.
    t : (samples,) times; knots (k,), command (k,): the input, held from knot to knot.
    starts : (shots + 1,) first sample of each shot, and the number of samples.
    refine : divides the step.

    Returns
    -------
    (b, n, samples) readings, encoder zero excluded; NaN where a variant diverged.
    """
    y = np.empty((cart.shape[0], cart.shape[1], t.size))
    for b in range(cart.shape[0]):
        if not _simulate(
            cart[b],
            spring[b],
            drive[b],
            x0[b],
            v0[b],
            scatter[b],
            free,
            t,
            knots,
            command,
            starts,
            refine,
            y[b],
        ):
            y[b] = np.nan
    return y
