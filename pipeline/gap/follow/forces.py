"""The forces of the laws that a following model has, and what they are by each parameter."""

from math import exp

from pipeline.plant.nonlinear.simulator.state import inlined, tie
from pipeline.plant.nonlinear.simulator.terms import (
    FRICTION,
    HYSTERESIS,
    ON_SPRING,
    TERMS,
    Kind,
    settle,
    terms,
)

# Laws by their effect; that of stiction is what it has beyond Coulomb's friction.
COULOMB, STRIBECK, LOAD = Kind.COULOMB_FRICTION, Kind.STICTION, Kind.LOAD_FRICTION
DAHL, DRAG, OFFSET = Kind.PRESLIDING_FRICTION, Kind.QUADRATIC_DRAG, Kind.FORCE_OFFSET
CUBIC, SLACK, COUPLING = Kind.CUBIC_SPRING, Kind.SLACK_SPRING, Kind.COUPLING_DAMPER
BRAKING, COGGING, BACKLASH = Kind.DRIVE_DAMPING, Kind.COGGING, Kind.BACKLASH
STOP, GAIN, HIDDEN = Kind.END_STOP, Kind.SENSOR_GAIN, Kind.EXTRA_MODE
DRIVE = 4  # parameters of the drive: dead zone, limit, delay, lag
OWN = 2  # numbers of a law's own state, its friction's or a body's; behind them its terms
ROOM = OWN + TERMS


@inlined
def pull(f, j, n, value):
    """Add the tension of spring j to the forces on its two ends."""
    if j < n:
        f[j] -= value
    if j > 0:
        f[j - 1] += value


@inlined
def pull_lane(DF, lane, j, n, value):
    """Add the tension of spring j to a lane of the forces on its two ends."""
    if j < n:
        DF[j, lane] -= value
    if j > 0:
        DF[j - 1, lane] += value


@inlined
def reach(x, j, n):
    """Return by how much spring j of n carts is stretched."""
    return (x[j] if j < n else 0.0) - (x[j - 1] if j > 0 else 0.0)


@inlined
def add_forces(p, n, kinds, places, first, factor, u, on, h, v, xm, aux, f, K, C, R):
    """Add the laws' forces in the middle of a step of h s, and their slopes by x and v.

    Forces `f` (n,), slopes `K` and `C` (n, n), sliding friction `R` (n,).
    """
    for law in range(kinds.size):
        kind, at, o, out = kinds[law], places[law], first[law], aux[law, OWN:]
        if kind in ON_SPRING:
            terms(kind, p, o, reach(xm, at, n), reach(v, at, n), p[2 * n + at], u, on, out)
            pull(f, at, n, out[0])
            tie(K, at, n, out[1])
            tie(C, at, n, out[2])
        elif kind in HYSTERESIS:
            settle(kind, p, o, v[at], out)
            aux[law, 1] = out[1] + (aux[law, 0] - out[1]) * exp(-0.5 * h * out[2])
            f[at] -= factor[at] * out[0] * aux[law, 1]
        elif kind == HIDDEN:
            rise = p[o + 1] * (aux[law, 0] + 0.5 * h * aux[law, 1] - xm[at])
            rise += p[o + 2] * (aux[law, 1] - v[at])
            f[at] += p[o] * rise
            K[at, at] += p[o] * p[o + 1]
            C[at, at] += p[o] * p[o + 2]
        else:
            terms(kind, p, o, xm[at], v[at], 0.0, u, on, out)
            if kind in FRICTION:
                R[at] += out[0]
            else:
                f[at] += out[0]
                K[at, at] -= out[1]
                C[at, at] -= out[2]


@inlined
def add_slopes(
    p, n, kinds, places, first, factor, du, crossing, h, v, xm, aux, K, C, R, DX, DV, DF, DR, DA
):
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
        pull_lane(DF, 2 * n + j, j, n, reach(xm, j, n))
    for i in range(n):
        DR[i, own + 3 * n + i] = R[i]
    for law in range(L):
        kind, at, o, out = kinds[law], places[law], first[law], aux[law, OWN:]
        size = (first[law + 1] if law + 1 < L else own) - o
        if kind in ON_SPRING:
            for q in range(size):
                pull_lane(DF, o + q, at, n, out[4 + q])
        elif kind in FRICTION:
            for q in range(size):
                DR[at, o + q] += factor[at] * out[4 + q]
            if out[3] != 0.0:
                for q in range(DRIVE):
                    DR[at, drive + q] += factor[at] * out[3] * du[q]
            if out[2] != 0.0:
                for q in range(lanes):
                    DR[at, q] += factor[at] * out[2] * DV[at, q]
        elif kind in HYSTERESIS:
            left = exp(-0.5 * h * out[2])
            fading = 0.5 * h * left * (aux[law, 0] - out[1])
            by_v = out[3] * (1.0 - left) - fading * out[4]
            most = factor[at] * out[0]
            for q in range(lanes):
                DF[at, q] -= most * (left * DA[2 * law, q] + by_v * DV[at, q])
            for q in range(size):
                by_q = out[6 + 3 * q] * (1.0 - left) - fading * out[7 + 3 * q]
                DF[at, o + q] -= factor[at] * out[5 + 3 * q] * aux[law, 1] + most * by_q
            DF[at, own + 3 * n + at] -= out[0] * aux[law, 1]
        elif kind == HIDDEN:
            a = p[o]
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
        else:
            for q in range(size):
                DF[at, o + q] += out[4 + q]
            if out[3] != 0.0:
                for q in range(DRIVE):
                    DF[at, drive + q] += out[3] * du[q]


@inlined
def settle_friction(p, n, kinds, places, first, h, v, aux, derive, DV, DA):
    """Let the states of presliding friction move on by a step of h s, at its last velocities."""
    for law in range(kinds.size):
        kind, at, o, out = kinds[law], places[law], first[law], aux[law, OWN:]
        if kind in HYSTERESIS:
            settle(kind, p, o, v[at], out)
            left = exp(-h * out[2])
            fading = h * left * (aux[law, 0] - out[1])
            if derive:
                by_v = out[3] * (1.0 - left) - fading * out[4]
                for q in range(DA.shape[1]):
                    DA[2 * law, q] = left * DA[2 * law, q] + by_v * DV[at, q]
                size = (first[law + 1] if law + 1 < kinds.size else p.size) - o
                for q in range(size):
                    DA[2 * law, o + q] += out[6 + 3 * q] * (1.0 - left) - fading * out[7 + 3 * q]
            aux[law, 0] = out[1] + left * (aux[law, 0] - out[1])
