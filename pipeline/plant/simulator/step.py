"""One step of the simulator: forces, the series of the linear flow, and the events in the step."""

from math import exp

import numpy as np

from pipeline.plant.simulator.contacts import (
    contact,
    contact_gap,
    position,
    toggle_contact,
    velocity,
)
from pipeline.plant.simulator.sensitivity import propagate, saltation, stop

# isort: off
from pipeline.plant.simulator.laws import (
    ON_CARTS, ON_DRIVE, ON_SPRINGS, cart_force, drive_force, stribeck, motor_force, hysteresis,
    sliding, spring_force)  # fmt: skip
from pipeline.plant.simulator.compiler import inlined
from pipeline.plant.simulator.state import (
    ACC, D2, D3, D4, DECAY, FIX, FORCE, GRIP, INV, MID_V, MID_X, RUB, SIDE, V, X, Z,
    stretch)  # fmt: skip

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

    Derivatives are advanced too; see `make_lanes`.
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
