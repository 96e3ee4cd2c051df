"""The forces of the laws that a following model has, and what they are by each parameter."""

from math import cos, exp, pi, sin

from pipeline.plant.nonlinear.simulator.state import jit

# Laws, in the order of `SIZES`: how many parameters each has.
COULOMB, LOAD, DRAG, OFFSET, CUBIC, SLACK, COUPLING, BRAKING, STOP, STRIBECK, DAHL, HIDDEN = range(
    12
)
COGGING, GAIN, BACKLASH = 12, 13, 14
SIZES = (1, 1, 1, 1, 1, 2, 1, 1, 3, 2, 2, 3, 3, 1, 3)
DRIVE = 4  # parameters of the drive: dead zone, limit, delay, lag


@jit
def tie(M, j, n, value):
    """Add `value` between both ends of spring j (0 to n) of n carts to a symmetric matrix."""
    if j < n:
        M[j, j] += value
    if j > 0:
        M[j - 1, j - 1] += value
    if 0 < j < n:
        M[j, j - 1] -= value
        M[j - 1, j] -= value


@jit
def pull(f, j, n, value):
    """Add the tension of spring j to the forces on its two ends."""
    if j < n:
        f[j] -= value
    if j > 0:
        f[j - 1] += value


@jit
def pull_lane(DF, lane, j, n, value):
    """Add the tension of spring j to a lane of the forces on its two ends."""
    if j < n:
        DF[j, lane] -= value
    if j > 0:
        DF[j - 1, lane] += value


@jit
def add_forces(p, n, kinds, places, first, factor, u, braking, h, v, xm, aux, f, K, C, R, Rv):
    """Add the laws' forces in the middle of a step of h s, and their slopes by x and v.

    Forces `f` (n,), slopes `K` and `C` (n, n), sliding friction `R` and its slope `Rv` by v (n,).
    """
    L = kinds.size
    for law in range(L):
        kind, at, o = kinds[law], places[law], first[law]
        a = p[o]
        if kind == COULOMB:
            R[at] += a
        elif kind == LOAD:
            R[at] += a * abs(u)
        elif kind == DRAG:
            f[at] -= a * v[at] * abs(v[at])
            C[at, at] += 2.0 * a * abs(v[at])
        elif kind == OFFSET:
            f[at] += a
        elif kind == CUBIC or kind == SLACK or kind == COUPLING:
            d = (xm[at] if at < n else 0.0) - (xm[at - 1] if at > 0 else 0.0)
            if kind == CUBIC:
                pull(f, at, n, a * d * d * d)
                tie(K, at, n, 3.0 * a * d * d)
            elif kind == COUPLING:
                rate = (v[at] if at < n else 0.0) - (v[at - 1] if at > 0 else 0.0)
                pull(f, at, n, a * rate)
                tie(C, at, n, a)
            elif (d - p[o + 1]) * p[o + 1] > 0.0:
                pull(f, at, n, a * (d - p[o + 1]))
                tie(K, at, n, a)
        elif kind == BRAKING:
            f[0] -= a * braking * v[0]
            C[0, 0] += a * braking
        elif kind == STOP:
            side = 1.0 if p[o + 1] > 0.0 else -1.0
            depth = side * (xm[at] - p[o + 1])
            aux[law, 0] = 0.0
            if depth > 0.0:
                push = a * depth + p[o + 2] * side * v[at]
                if push > 0.0 or (a == 0.0 and p[o + 2] == 0.0):
                    aux[law, 0] = 1.0
                    f[at] -= side * push
                    K[at, at] += a
                    C[at, at] += p[o + 2]
        elif kind == STRIBECK:
            ratio = v[at] / p[o + 1]
            drop = exp(-ratio * ratio)
            R[at] += a * drop
            Rv[at] -= 2.0 * a * drop * ratio / p[o + 1]
        elif kind == DAHL:
            side = 1.0 if v[at] > 0.0 else -1.0
            half = exp(-0.5 * abs(v[at]) * h / p[o + 1])
            aux[law, 1] = side + (aux[law, 0] - side) * half
            f[at] -= factor[at] * a * aux[law, 1]
        elif kind == HIDDEN:
            rise = p[o + 1] * (aux[law, 0] + 0.5 * h * aux[law, 1] - xm[at])
            rise += p[o + 2] * (aux[law, 1] - v[at])
            f[at] += a * rise
            K[at, at] += a * p[o + 1]
            C[at, at] += a * p[o + 2]
        elif kind == COGGING:
            turn = 2.0 * pi / p[o + 2]
            s, c = sin(turn * xm[0]), cos(turn * xm[0])
            f[0] += a * s + p[o + 1] * c
            K[0, 0] -= turn * (a * c - p[o + 1] * s)


@jit
def add_slopes(
    p, n, kinds, places, first, factor, u, du, braking, crossing, h, v, xm, aux, K, C, R, Rv, DX,
    DV, DF, DR, DA,
):  # fmt: skip
    """Fill DF and DR (n, lanes): forces and friction by every lane, through the state or not.

    `du` (4,) is the input's by the drive's parameters, which act but where a play is crossed.
    """
    L, lanes = kinds.size, DX.shape[1]
    own, drive = p.size, 3 * n + 1
    for i in range(n):
        for q in range(lanes):
            DF[i, q] = 0.0
        for j in range(n):
            if K[i, j] != 0.0 or C[i, j] != 0.0:
                kij, cij = K[i, j], C[i, j]
                for q in range(lanes):
                    DF[i, q] -= kij * DX[j, q] + cij * DV[j, q]
    if not crossing:
        for q in range(DRIVE):
            DF[0, drive + q] += du[q]
    for j in range(n + 1):
        d = (xm[j] if j < n else 0.0) - (xm[j - 1] if j > 0 else 0.0)
        pull_lane(DF, 2 * n + j, j, n, d)
    for i in range(n):
        DR[i, own + 3 * n + i] = R[i]
    for law in range(L):
        kind, at, o = kinds[law], places[law], first[law]
        a = p[o]
        if kind == COULOMB:
            DR[at, o] += factor[at]
        elif kind == LOAD:
            DR[at, o] += factor[at] * abs(u)
            side = 1.0 if u > 0.0 else -1.0
            for q in range(DRIVE):
                DR[at, drive + q] += factor[at] * a * side * du[q]
        elif kind == DRAG:
            DF[at, o] -= v[at] * abs(v[at])
        elif kind == OFFSET:
            DF[at, o] += 1.0
        elif kind == CUBIC or kind == SLACK or kind == COUPLING:
            d = (xm[at] if at < n else 0.0) - (xm[at - 1] if at > 0 else 0.0)
            if kind == CUBIC:
                pull_lane(DF, o, at, n, d * d * d)
            elif kind == COUPLING:
                rate = (v[at] if at < n else 0.0) - (v[at - 1] if at > 0 else 0.0)
                pull_lane(DF, o, at, n, rate)
            elif (d - p[o + 1]) * p[o + 1] > 0.0:
                pull_lane(DF, o, at, n, d - p[o + 1])
                pull_lane(DF, o + 1, at, n, -a)
        elif kind == BRAKING:
            DF[0, o] -= braking * v[0]
        elif kind == STOP:
            if aux[law, 0] != 0.0:
                DF[at, o] -= xm[at] - p[o + 1]
                DF[at, o + 1] += a
                DF[at, o + 2] -= v[at]
        elif kind == STRIBECK:
            ratio = v[at] / p[o + 1]
            drop = exp(-ratio * ratio)
            DR[at, o] += factor[at] * drop
            DR[at, o + 1] += factor[at] * a * drop * 2.0 * ratio * ratio / p[o + 1]
            for q in range(lanes):
                DR[at, q] += factor[at] * Rv[at] * DV[at, q]
        elif kind == DAHL:
            side = 1.0 if v[at] > 0.0 else -1.0
            half = exp(-0.5 * abs(v[at]) * h / p[o + 1])
            slope = (aux[law, 0] - side) * half
            by_v = -slope * side * 0.5 * h / p[o + 1]
            fa = factor[at] * a
            for q in range(lanes):
                DF[at, q] -= fa * (half * DA[2 * law, q] + by_v * DV[at, q])
            DF[at, o] -= factor[at] * aux[law, 1]
            DF[at, o + 1] -= fa * slope * 0.5 * abs(v[at]) * h / p[o + 1] ** 2
            DF[at, own + 3 * n + at] -= a * aux[law, 1]
        elif kind == HIDDEN:
            apart = aux[law, 0] + 0.5 * h * aux[law, 1] - xm[at]
            rate = aux[law, 1] - v[at]
            for q in range(lanes):
                DA[2 * law, q] += 0.5 * h * DA[2 * law + 1, q]
                DF[at, q] += a * (p[o + 1] * DA[2 * law, q] + p[o + 2] * DA[2 * law + 1, q])
            DF[at, o] += p[o + 1] * apart + p[o + 2] * rate
            DF[at, o + 1] += a * apart
            DF[at, o + 2] += a * rate
            for q in range(lanes):
                DA[2 * law + 1, q] -= h * (
                    p[o + 1] * (DA[2 * law, q] - DX[at, q])
                    + p[o + 2] * (DA[2 * law + 1, q] - DV[at, q])
                )
            DA[2 * law + 1, o + 1] -= h * apart
            DA[2 * law + 1, o + 2] -= h * rate
            for q in range(lanes):
                DA[2 * law, q] += 0.5 * h * DA[2 * law + 1, q]
        elif kind == COGGING:
            turn = 2.0 * pi / p[o + 2]
            s, c = sin(turn * xm[0]), cos(turn * xm[0])
            DF[0, o] += s
            DF[0, o + 1] += c
            DF[0, o + 2] -= turn / p[o + 2] * xm[0] * (a * c - p[o + 1] * s)
