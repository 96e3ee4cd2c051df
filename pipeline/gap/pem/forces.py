"""The forces of the laws of a model that follows a record, and their derivatives."""

from math import exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.simulator.compiler import inlined
from pipeline.plant.simulator.state import add_spring
from pipeline.plant.simulator.terms import (
    FRICTION,
    HYSTERESIS,
    ON_SPRING,
    TERMS,
    EffectKind,
    settle,
    terms,
)

DRIVE = 4  # number of the drive's parameters: dead zone, limit, delay, lag
OWN = 2  # size of the state of a law's friction or body, at the start of its row
ROOM = OWN + TERMS


class ActingLaws(NamedTuple):
    """The laws that act: their kinds, places and parameters.

    `p` holds masses, dampings, springs (n + 1), the drive (4) and the laws' parameters. The
    parameters of each law begin at `first` (laws,). `play` is the index of the law of backlash
    between motor and cart 1, or -1.
    """

    p: Array
    kinds: NDArray[np.int64]
    places: NDArray[np.int64]
    first: NDArray[np.int64]
    play: int


class PemRunArrays(NamedTuple):
    """One run of n carts and the options of its simulation.

    Attributes
    ----------
    t, y : times (samples,) and readings (samples, n).
    seen, free : whether each cart is compared, and whether it moves (n,).
    guided : motion (samples, n) of held carts.
    knots, command : times and values of the input, held from knot to knot.
    held : input after dead zone and limit, its derivatives with respect to these two, and the
        integrals of all three, (3, 2, knots).
    zero, factor : this run's encoder zeros and factors on dry friction (n,).
    gain : share of the error that corrects the state.
    longest : longest step, s.
    """

    t: Array
    y: Array
    seen: NDArray[np.bool_]
    free: NDArray[np.bool_]
    guided: Array
    knots: Array
    command: Array
    held: Array
    zero: Array
    factor: Array
    gain: float
    longest: float


class PemState(NamedTuple):
    """Positions and velocities (n,), and the laws' states and terms `aux` (laws, ROOM).

    `DX`, `DV` (n, lanes) and `DA` (2 laws, lanes) are the derivatives. The lanes are the parameters
    `p`, then those of the run: zeros, starts, velocities and factors on dry friction (n each).
    Without derivatives there are no lanes.
    """

    x: Array
    v: Array
    aux: Array
    DX: Array
    DV: Array
    DA: Array


class WorkArrays(NamedTuple):
    """Work arrays of one step.

    Attributes
    ----------
    xm : positions (n,) at mid-step.
    f, R : forces and sliding friction (n,).
    K, C : derivatives (n, n) of the forces with respect to positions and velocities.
    du : derivatives (4,) of the input with respect to the drive's parameters.
    dlag : the same derivatives (4,) of the lag's state.
    DF, DR : derivatives (n, lanes) of forces and friction.
    """

    xm: Array
    f: Array
    R: Array
    K: Array
    C: Array
    du: Array
    dlag: Array
    DF: Array
    DR: Array


class Step(NamedTuple):
    """One step of `h` s with the input force `u`; `on` is 1 while the drive is powered."""

    u: float
    on: float
    h: float


@inlined
def pull(f, j, n, value):
    """Add the tension of spring j to the forces on its two ends."""
    if j < n:
        f[j] -= value
    if j > 0:
        f[j - 1] += value


@inlined
def pull_lane(DF, lane, j, n, value):
    """Add the tension of spring j to one lane of the forces on its two ends."""
    if j < n:
        DF[j, lane] -= value
    if j > 0:
        DF[j - 1, lane] += value


@inlined
def spring_stretch(x, j, n):
    """Return the stretch of spring j of n carts."""
    return (x[j] if j < n else 0.0) - (x[j - 1] if j > 0 else 0.0)


@inlined
def add_forces(laws, run, state, work, step):
    """Add the laws' forces at mid-step, and their slopes against position and velocity."""
    p, factor, aux, v, xm, h = laws.p, run.factor, state.aux, state.v, work.xm, step.h
    n, f, K, C = v.size, work.f, work.K, work.C
    for law in range(laws.kinds.size):
        kind, at, o, out = laws.kinds[law], laws.places[law], laws.first[law], aux[law, OWN:]
        if kind in ON_SPRING:
            d, rate, k = spring_stretch(xm, at, n), spring_stretch(v, at, n), p[2 * n + at]
            terms(kind, p, o, d, rate, k, step.u, step.on, out)
            pull(f, at, n, out[0])
            add_spring(K, at, n, out[1])
            add_spring(C, at, n, out[2])
        elif kind in HYSTERESIS:
            settle(kind, p, o, v[at], out)
            aux[law, 1] = out[1] + (aux[law, 0] - out[1]) * exp(-0.5 * h * out[2])
            f[at] -= factor[at] * out[0] * aux[law, 1]
        elif kind == EffectKind.EXTRA_MODE:
            rise = p[o + 1] * (aux[law, 0] + 0.5 * h * aux[law, 1] - xm[at])
            rise += p[o + 2] * (aux[law, 1] - v[at])
            f[at] += p[o] * rise
            K[at, at] += p[o] * p[o + 1]
            C[at, at] += p[o] * p[o + 2]
        else:
            terms(kind, p, o, xm[at], v[at], 0.0, step.u, step.on, out)
            if kind in FRICTION:
                work.R[at] += out[0]
            else:
                f[at] += out[0]
                K[at, at] -= out[1]
                C[at, at] -= out[2]


@inlined
def add_slopes(laws, run, state, work, h, crossing):
    """Fill DF and DR with derivatives of forces and friction, directly and through the state.

    The parameters of the input have no effect while the motor crosses the backlash.
    """
    p, factor, aux, v, xm = laws.p, run.factor, state.aux, state.v, work.xm
    DX, DV, DA, DF, DR = state.DX, state.DV, state.DA, work.DF, work.DR
    n, L, lanes = v.size, laws.kinds.size, DX.shape[1]
    own, drive, du = p.size, 3 * n + 1, work.du
    for i in range(n):
        for q in range(lanes):
            DF[i, q] = 0.0
        for j in range(n):
            if work.K[i, j] != 0.0 or work.C[i, j] != 0.0:
                kij, cij = work.K[i, j], work.C[i, j]
                for q in range(lanes):
                    DF[i, q] -= kij * DX[j, q] + cij * DV[j, q]
    if not crossing:
        for q in range(DRIVE):
            DF[0, drive + q] += du[q]
    for j in range(n + 1):
        pull_lane(DF, 2 * n + j, j, n, spring_stretch(xm, j, n))
    for i in range(n):
        DR[i, own + 3 * n + i] = work.R[i]
    for law in range(L):
        kind, at, o, out = laws.kinds[law], laws.places[law], laws.first[law], aux[law, OWN:]
        size = (laws.first[law + 1] if law + 1 < L else own) - o
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
            for q in range(lanes if most != 0.0 else 0):
                DF[at, q] -= most * (left * DA[2 * law, q] + by_v * DV[at, q])
            for q in range(size):
                by_q = out[6 + 3 * q] * (1.0 - left) - fading * out[7 + 3 * q]
                DF[at, o + q] -= factor[at] * out[5 + 3 * q] * aux[law, 1] + most * by_q
            DF[at, own + 3 * n + at] -= out[0] * aux[law, 1]
        elif kind == EffectKind.EXTRA_MODE:
            a = p[o]
            apart = aux[law, 0] + 0.5 * h * aux[law, 1] - xm[at]
            rate = aux[law, 1] - v[at]
            moved = lanes if a != 0.0 else 0  # a hidden mass of zero pulls at nothing
            for q in range(moved):
                DA[2 * law, q] += 0.5 * h * DA[2 * law + 1, q]
                DF[at, q] += a * (p[o + 1] * DA[2 * law, q] + p[o + 2] * DA[2 * law + 1, q])
            DF[at, o] += p[o + 1] * apart + p[o + 2] * rate
            DF[at, o + 1] += a * apart
            DF[at, o + 2] += a * rate
            for q in range(moved):
                DA[2 * law + 1, q] -= h * (
                    p[o + 1] * (DA[2 * law, q] - DX[at, q])
                    + p[o + 2] * (DA[2 * law + 1, q] - DV[at, q])
                )
            DA[2 * law + 1, o + 1] -= h * apart
            DA[2 * law + 1, o + 2] -= h * rate
            for q in range(moved):
                DA[2 * law, q] += 0.5 * h * DA[2 * law + 1, q]
        else:
            for q in range(size):
                DF[at, o + q] += out[4 + q]
            if out[3] != 0.0:
                for q in range(DRIVE):
                    DF[at, drive + q] += out[3] * du[q]


@inlined
def settle_friction(laws, state, h):
    """Advance the states of presliding friction by a step of h s at the present velocities."""
    p, aux, DV, DA, L = laws.p, state.aux, state.DV, state.DA, laws.kinds.size
    for law in range(L):
        kind, at, o, out = laws.kinds[law], laws.places[law], laws.first[law], aux[law, OWN:]
        if kind in HYSTERESIS:
            settle(kind, p, o, state.v[at], out)
            left = exp(-h * out[2])
            fading = h * left * (aux[law, 0] - out[1])
            if DA.shape[1] > 0 and out[0] != 0.0:
                by_v = out[3] * (1.0 - left) - fading * out[4]
                for q in range(DA.shape[1]):
                    DA[2 * law, q] = left * DA[2 * law, q] + by_v * DV[at, q]
                size = (laws.first[law + 1] if law + 1 < L else p.size) - o
                for q in range(size):
                    DA[2 * law, o + q] += out[6 + 3 * q] * (1.0 - left) - fading * out[7 + 3 * q]
            aux[law, 0] = out[1] + left * (aux[law, 0] - out[1])
