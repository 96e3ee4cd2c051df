"""Simulate a chain with many laws while it follows a record: compiled, with all derivatives.

At every sample the simulated state is corrected by a share `gain` of the error:

    e = y - x,   x <- x + gain e,   v <- v + 0.3 gain² e / Δt.

Then it moves freely to the next sample. So the model is never far from the data, and its cost has
a single minimum, while a free simulation's cost has many. With `gain` 0 the simulation is free.
The derivatives are integrated with the state and are exact for the numerical scheme.

The steps are those of the leapfrog method. Dry friction is set-valued, and a cart that reverses
within a step reverses at that instant.

References: H. Abarbanel, D. Creveling, R. Farsian, M. Kostuk, SIAM J. Applied Dynamical Systems 8
(2009) 1341-1381; L. Ljung, System Identification, 2nd ed., chapter 7 (fixed-gain predictors).
"""

from math import ceil, exp
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.simulator.compiler import inlined, jit
from pipeline.plant.simulator.sensitivity import add_spring
from pipeline.plant.simulator.terms import (
    FRICTION,
    HYSTERESIS,
    ON_SPRING,
    TERMS,
    EffectKind,
    settle,
    terms,
)

# ----------------------------------------------------- forces of the laws, and their derivatives

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
    """One run of n carts, thinned, and the options of its simulation.

    Attributes
    ----------
    t, y : times (samples,) and readings (samples, n).
    weight : weight (samples, n) of each reading, over the noise.
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
    weight: Array
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


# ---------------------------------------------------------------------- following a record

_LEAST_SHARE = 0.02  # share of cart 1's mass that remains at least when the motor is separated
_BLOWN_UP = 1e6  # position at which the simulation has diverged


@jit
def predict_run(laws, run, state, work, E, J):
    """Simulate a run; fill its errors E (samples, n) and derivatives J (lanes, samples, n).

    Return False if the simulation diverges. `state` holds the start of the run and is overwritten.
    """
    p, kinds, places, first, play = laws.p, laws.kinds, laws.places, laws.first, laws.play
    t, knots, held, free, guided = run.t, run.knots, run.held, run.free, run.guided
    x, v, aux, DX, DV, DA = state.x, state.v, state.aux, state.DX, state.DV, state.DA
    xm, f, R, K, C, du, dlag = work.xm, work.f, work.R, work.K, work.C, work.du, work.dlag
    DF, DR, n, gain = work.DF, work.DR, state.x.size, run.gain
    own = p.size  # index of the first lane of the run
    lanes = DX.shape[1]
    derive = lanes > 0
    drive, L = 3 * n + 1, kinds.size
    delay, lag = p[drive + 2], max(p[drive + 3], 1e-7)
    lagged = held[0, 0, 0]  # the drive at rest, before the first knot
    position = 0
    on = 0
    # The motor is a separate body while it crosses the backlash. In contact it is one body with
    # cart 1.
    side_of = 0.0
    gap = p[first[play]] if play >= 0 else 0.0
    motor = p[first[play] + 1] if play >= 0 else 0.0
    past, past_w, past_l, u_past = 0.0, 0.0, 0.0, held[0, 0, 0]
    for sample in range(t.size):
        step = t[min(sample + 1, t.size - 1)] - t[min(sample, t.size - 2)]
        for i in range(n):
            if not run.seen[i]:
                continue
            scale = 1.0
            lane_gain = -1
            for law in range(L):
                if kinds[law] == EffectKind.SENSOR_GAIN and places[law] == i:
                    lane_gain = first[law]
                    scale += p[lane_gain]
            e = run.y[sample, i] - scale * x[i] - run.zero[i]
            E[sample, i] = e
            if derive:
                for q in range(lanes):
                    J[q, sample, i] = scale * DX[i, q]
                J[own + i, sample, i] += 1.0
                if lane_gain >= 0:
                    J[lane_gain, sample, i] += x[i]
            if gain > 0.0:
                # Dry friction may hold the cart, so only its position is corrected, without a jolt.
                x[i] += gain * e
                # This share damps the correction a little more than critically.
                kick = 0.3 * gain * gain / step
                v[i] += kick * e
                if derive:
                    for q in range(lanes):
                        DX[i, q] -= gain * J[q, sample, i]
                        DV[i, q] -= kick * J[q, sample, i]
                if i == 0 and play >= 0:
                    # The motor is corrected too, because a correction of the cart alone would cause
                    # impacts.
                    aux[play, 0] += gain * e
                    aux[play, 1] += kick * e
                    if derive:
                        for q in range(lanes):
                            DA[2 * play, q] -= gain * J[q, sample, 0]
                            DA[2 * play + 1, q] -= kick * J[q, sample, 0]
            if not abs(x[i]) < _BLOWN_UP:
                return False
        if sample == t.size - 1:
            break
        for i in range(n):
            if not free[i]:
                x[i] = guided[sample, i]
                v[i] = (guided[sample + 1, i] - guided[sample, i]) / step
        count = ceil(step / run.longest - 1e-9)
        h = step / count
        for sub in range(count):
            now = t[sample] + sub * h
            # ------------------------------------------------ the mean input over the step
            end = now + h - delay
            if sample == 0 and sub == 0:
                begin = now - delay
                while knots[position] < begin:
                    u, u_w, u_l = held[0, 0, position], held[1, 0, position], held[2, 0, position]
                    last = position == knots.size - 1 or knots[position + 1] > begin
                    since = (begin if last else knots[position + 1]) - knots[position]
                    decay = exp(-since / lag)
                    dlag[0] = u_w + (dlag[0] - u_w) * decay
                    dlag[1] = u_l + (dlag[1] - u_l) * decay
                    dlag[3] = dlag[3] * decay + (lagged - u) * decay * since / (lag * lag)
                    lagged = u + (lagged - u) * decay
                    dlag[2] = (lagged - u) / lag
                    if last:
                        break
                    position += 1
                since = begin - knots[position]
                past = held[0, 1, position] + held[0, 0, position] * since
                past_w = held[1, 1, position] + held[1, 0, position] * since
                past_l = held[2, 1, position] + held[2, 0, position] * since
                u_past = held[0, 0, position]
            while position < knots.size - 1 and knots[position + 1] <= end:
                position += 1
            since = end - knots[position]
            upto = held[0, 1, position] + held[0, 0, position] * since
            upto_w = held[1, 1, position] + held[1, 0, position] * since
            upto_l = held[2, 1, position] + held[2, 0, position] * since
            u, u_w, u_l = (upto - past) / h, (upto_w - past_w) / h, (upto_l - past_l) / h
            u_t = -(held[0, 0, position] - u_past) / h
            past, past_w, past_l, u_past = upto, upto_w, upto_l, held[0, 0, position]
            decay = exp(-h / lag)
            share = lag / h * (1.0 - decay)
            mean = u + (lagged - u) * share
            by_lag = (lagged - u) * ((1.0 - decay) / h - decay / lag)
            du[0] = u_w * (1.0 - share) + dlag[0] * share
            du[1] = u_l * (1.0 - share) + dlag[1] * share
            du[2] = u_t * (1.0 - share) + dlag[2] * share
            du[3] = by_lag + dlag[3] * share
            dlag[0] = u_w + (dlag[0] - u_w) * decay
            dlag[1] = u_l + (dlag[1] - u_l) * decay
            dlag[2] = u_t + (dlag[2] - u_t) * decay
            dlag[3] = dlag[3] * decay + (lagged - u) * decay * h / (lag * lag)
            lagged = u + (lagged - u) * decay
            u = mean
            while on < knots.size - 1 and knots[on + 1] <= now + 0.5 * h:
                on += 1
            powered = 1.0 if run.command[on] != 0.0 else 0.0
            # ------------------------------------------------ forces in the middle of the step
            for i in range(n):
                xm[i] = x[i] + 0.5 * h * v[i]
                f[i] = R[i] = 0.0
                for j in range(n):
                    K[i, j] = C[i, j] = 0.0
                if derive:
                    for q in range(lanes):
                        DX[i, q] += 0.5 * h * DV[i, q]
                        DR[i, q] = 0.0
            crossing = play >= 0 and side_of == 0.0
            if not crossing:
                f[0] += u
            before = v[0]
            for j in range(n + 1):
                k = p[2 * n + j]
                pull(f, j, n, k * spring_stretch(xm, j, n))
                add_spring(K, j, n, k)
            add_forces(laws, run, state, work, Step(u, powered, h))
            if derive:
                add_slopes(laws, run, state, work, h, crossing)
            for law in range(L):
                if kinds[law] == EffectKind.EXTRA_MODE:
                    at, o = places[law], first[law]
                    aux[law, 0] += 0.5 * h * aux[law, 1]
                    rise = p[o + 1] * (aux[law, 0] - xm[at]) + p[o + 2] * (aux[law, 1] - v[at])
                    aux[law, 1] -= h * rise
                    aux[law, 0] += 0.5 * h * aux[law, 1]
            # ------------------------------------------------ velocities, with dry friction last
            for i in range(n):
                if not free[i]:
                    x[i] = xm[i] + 0.5 * h * v[i]
                    continue
                half_c = 0.5 * h * p[n + i]
                mass = p[i]
                if i == 0 and crossing:
                    mass = max(mass - motor, _LEAST_SHARE * mass)
                whole = mass + half_c
                pushed = h * f[i] / whole
                rub = h * run.factor[i] * R[i] / whole
                target = v[i] * (mass - half_c) / whole + pushed
                side = 1.0 if (v[i] if v[i] != 0.0 else pushed) > 0.0 else -1.0
                after = target - side * rub
                ratio = 1.0
                if rub > 0.0:
                    if v[i] == 0.0:
                        if abs(pushed) <= rub:
                            after = ratio = 0.0
                    elif side * after < 0.0:
                        beyond = pushed + side * rub
                        ratio = beyond / (after - v[i]) if side * beyond < 0.0 else 0.0
                        after *= ratio
                elif v[i] == 0.0 and pushed == 0.0:
                    side = 0.0
                if derive:
                    if ratio == 0.0:
                        for q in range(lanes):
                            DV[i, q] = 0.0
                    else:
                        keep, kick = ratio * (mass - half_c) / whole, ratio * h / whole
                        rubbed = kick * side
                        for q in range(lanes):
                            DV[i, q] = keep * DV[i, q] + kick * DF[i, q] - rubbed * DR[i, q]
                        by_mass = ratio * (v[i] - after) / whole
                        DV[i, i] += by_mass
                        if i == 0 and crossing:
                            DV[i, first[play] + 1] -= by_mass
                        DV[i, n + i] -= ratio * 0.5 * h * (v[i] + after) / whole
                v[i] = after
                x[i] = xm[i] + 0.5 * h * after
                if derive:
                    for q in range(lanes):
                        DX[i, q] += 0.5 * h * DV[i, q]
            if play >= 0 and free[0]:
                o, at, vat = first[play], 2 * play, 2 * play + 1
                if crossing:
                    push = h * u / motor
                    aux[play, 0] += h * (aux[play, 1] + 0.5 * push)
                    aux[play, 1] += push
                    if derive:
                        for q in range(lanes):
                            DA[at, q] += h * DA[vat, q]
                        for q in range(DRIVE):
                            kick = h * du[q] / motor
                            DA[at, drive + q] += 0.5 * h * kick
                            DA[vat, drive + q] += kick
                        DA[at, o + 1] -= 0.5 * h * push / motor
                        DA[vat, o + 1] -= push / motor
                    apart = aux[play, 0] - x[0]
                    rate = aux[play, 1] - v[0]
                    if abs(apart) > 0.5 * gap and apart * rate > 0.0:
                        side = 1.0 if apart > 0.0 else -1.0
                        late = min((abs(apart) - 0.5 * gap) / abs(rate), h)
                        share = min(motor / p[0], 1.0 - _LEAST_SHARE)
                        # If the bodies are pushed together again within the step, they stay in
                        # contact.
                        bounce = p[o + 2]
                        if 2.0 * bounce * abs(rate) < side * (push - v[0] + before):
                            bounce = 0.0
                            side_of = side
                        whole = (1.0 + bounce) * rate
                        if derive:
                            for q in range(lanes):
                                off = DA[at, q] - DX[0, q]
                                if q == o:
                                    off -= 0.5 * side
                                # The instant of contact depends on the parameter.
                                DX[0, q] += share * whole * off / rate
                                DA[at, q] += (share - 1.0) * whole * off / rate
                                off = (1.0 + bounce) * (DA[vat, q] - DV[0, q])
                                DV[0, q] += share * off
                                DA[vat, q] += (share - 1.0) * off
                            for q, by in ((o + 1, whole / p[0]), (0, -whole * share / p[0])):
                                DV[0, q] += by
                                DA[vat, q] += by
                            if bounce > 0.0:
                                DV[0, o + 2] += share * rate
                                DA[vat, o + 2] += (share - 1.0) * rate
                        x[0] += share * whole * late
                        v[0] += share * whole
                        aux[play, 0] += (share - 1.0) * whole * late
                        aux[play, 1] += (share - 1.0) * whole
                elif (u - motor * (v[0] - before) / h) * side_of < 0.0:
                    aux[play, 0] = x[0] + 0.5 * side_of * gap
                    aux[play, 1] = v[0]
                    if derive:
                        for q in range(lanes):
                            DA[at, q], DA[vat, q] = DX[0, q], DV[0, q]
                        DA[at, o] += 0.5 * side_of
                    side_of = 0.0
            settle_friction(laws, state, h)
    return True
