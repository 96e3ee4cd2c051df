"""Switching inside a step: end stops, springs past a stretch, both sides of a backlash."""

from pipeline.plant.simulator.columns import Drive
from pipeline.plant.simulator.laws import bilinear_spring, end_stop

# isort: off
from pipeline.plant.simulator.compiler import jit
from pipeline.plant.simulator.state import (
    D2, D3, D4, D5, D6, FIX, PAST, V, X, pair, add_spring)  # fmt: skip


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
