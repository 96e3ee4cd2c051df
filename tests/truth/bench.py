"""A bench with known, hidden physics, simulated independently of `pipeline.plant`.

It uses fixed steps of 50 µs (velocity Verlet), dry friction as an inclusion solved at every step
(Moreau's time stepping), penalty contacts, and past commands for the delay. It is slow and simple
on purpose, because it is the reference for the workflow's simulator.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

STEP = 5e-5  # s
CONTACT_STEP = 2e-6  # s; short, since each bounce multiplies the error of an impact
_CONTACTS = ("backlash", "end_stop")

# Parameters of one cart and one spring, in this simulator's own tables.
_CART = (
    "m c coulomb excess stribeck dahl delta mu drag offset stop stop_k stop_c gain hm hk hc"
).split()
_SPRING = "k cubic change stretch coupling square".split()
_DRIVE = "dead limit delay lag braking gap motor contact contact_c cog pitch phase".split()


@dataclass(frozen=True, kw_only=True)
class Hidden:
    """One effect hidden in the bench, with its place (0 for the input) and parameters."""

    effect: str
    place: int = 0
    parameters: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Hand:
    """An unmeasured hand on one cart from `start` to `end` (s).

    The hand may grip the cart with a spring and a damper. It then moves the cart by `pull`
    (position units), holds it, and releases it. The pull ends at the fraction `there` of the time,
    and the release takes the last tenth. Otherwise the hand pushes with a force that rises to
    `push` (input units) and falls again. A soft hold is a grip that never pulls.
    """

    cart: int
    start: float
    end: float
    pull: float = 0.0
    push: float = 0.0
    there: float = 0.8
    grip: float = 8.0  # stiffness of the grip, as a multiple of that of the springs beside the cart


@njit(cache=True)
def _limited(u, dead, limit):
    past = abs(u) - dead
    return min(max(np.sign(u) * past, -limit), limit) if past > 0.0 else 0.0


@njit(cache=True)
def _handled(hands, grabbed, i, now, x, v):
    """Return the force of all hands on cart i."""
    force = 0.0
    for j in range(hands.shape[0]):
        at, start, end, pull, push, there, k, c = hands[j]
        if at != i or now < start or now > end:
            continue
        if np.isnan(grabbed[j]):
            grabbed[j] = x
        s = (now - start) / (end - start)
        force += push * np.sin(np.pi * s) ** 2
        way = min(s / there, 1.0)
        path = way**3 * (10.0 - 15.0 * way + 6.0 * way**2)
        pace = 30.0 * way**2 * (1.0 - way) ** 2 / (there * (end - start))
        closed = min(10.0 * (1.0 - s), 1.0)
        force += closed * (k * (grabbed[j] + pull * path - x) + c * (pull * pace - v))
    return force


@njit(cache=True)
def _motion(cart, spring, drive, hands, free, t, times, command, x0, v0, scatter, h):
    n = cart.shape[0]
    x, v, z = x0.copy(), v0.copy(), np.zeros(n)
    xh, vh = x0.copy(), v0.copy()
    lag = command[0]
    xm, vm = x0[0], v0[0]
    # Velocities in the middle of a step are extrapolated from the last step, to second order.
    v_last, vh_last = v0.copy(), v0.copy()
    w, wh = v0.copy(), v0.copy()
    has_gap = drive[5] > 0.0
    m1 = cart[0, 0] - (drive[6] if has_gap else 0.0)
    out = np.zeros((n, t.size))
    f = np.zeros(n)
    grabbed = np.full(hands.shape[0], np.nan)
    now = t[0]
    sample = 0
    at = 0
    on = 0
    first = True
    while sample < t.size:
        # Readings are interpolated linearly within one 50-µs step.
        while sample < t.size and t[sample] <= now + h:
            part = t[sample] - now
            for i in range(n):
                out[i, sample] = cart[i, 13] * (x[i] + part * v[i])
            sample += 1
        mid = now + 0.5 * h
        while on < times.size - 1 and times[on + 1] <= mid:
            on += 1
        # The delayed command over this step. Steps are far shorter than samples, so at most one
        # edge is within a step; it counts for the rest of the step.
        begin = now - drive[2]
        while at < times.size - 1 and times[at + 1] <= begin:
            at += 1
        u = _limited(command[at], drive[0], drive[1])
        if at < times.size - 1 and times[at + 1] < begin + h:
            late = (begin + h - times[at + 1]) / h
            u += late * (_limited(command[at + 1], drive[0], drive[1]) - u)
        if drive[3] > 0.0:
            before = lag
            lag = u + (lag - u) * np.exp(-h / drive[3])
            u = 0.5 * (before + lag)
        for i in range(n):
            if free[i]:
                x[i] += 0.5 * h * v[i]
            if cart[i, 14] > 0.0:
                xh[i] += 0.5 * h * vh[i]
            w[i] = 1.5 * v[i] - 0.5 * v_last[i]
            wh[i] = 1.5 * vh[i] - 0.5 * vh_last[i]
            v_last[i], vh_last[i] = v[i], vh[i]
            f[i] = cart[i, 9] - cart[i, 1] * w[i] - cart[i, 8] * abs(w[i]) * w[i]
        xm += 0.5 * h * vm
        for j in range(n + 1):
            right = x[j] if j < n else 0.0
            left = x[j - 1] if j > 0 else 0.0
            rate = (w[j] if j < n else 0.0) - (w[j - 1] if j > 0 else 0.0)
            d = right - left
            tension = spring[j, 0] * d + spring[j, 1] * d**3 + spring[j, 4] * rate
            tension += spring[j, 5] * d**2
            if spring[j, 3] >= 0.0 and d > spring[j, 3]:
                tension += spring[j, 2] * spring[j, 0] * (d - spring[j, 3])
            if spring[j, 3] < 0.0 and d < spring[j, 3]:
                tension += spring[j, 2] * spring[j, 0] * (d - spring[j, 3])
            if j < n:
                f[j] -= tension
            if j > 0:
                f[j - 1] += tension
        if has_gap:
            lead = xm - x[0]
            push = 0.0
            if lead > 0.5 * drive[5]:
                push = max(drive[7] * (lead - 0.5 * drive[5]) + drive[8] * (vm - v[0]), 0.0)
            elif lead < -0.5 * drive[5]:
                push = min(drive[7] * (lead + 0.5 * drive[5]) + drive[8] * (vm - v[0]), 0.0)
            f[0] += push
            vm += h / drive[6] * (u - push)
        else:
            f[0] += u
        if drive[9] != 0.0:
            f[0] += drive[9] * np.sin(2.0 * np.pi * x[0] / drive[10] + drive[11])
        if drive[4] != 0.0 and command[on] != 0.0:
            f[0] -= drive[4] * w[0]
        for i in range(n):
            if cart[i, 11] > 0.0:
                if cart[i, 10] > 0.0 and x[i] > cart[i, 10]:
                    push = cart[i, 11] * (x[i] - cart[i, 10]) + cart[i, 12] * v[i]
                    f[i] -= max(push, 0.0)
                if cart[i, 10] < 0.0 and x[i] < cart[i, 10]:
                    push = cart[i, 11] * (cart[i, 10] - x[i]) - cart[i, 12] * v[i]
                    f[i] += max(push, 0.0)
            if cart[i, 14] > 0.0:
                pull = cart[i, 15] * (xh[i] - x[i]) + cart[i, 16] * (wh[i] - w[i])
                f[i] += pull
                vh[i] -= h / cart[i, 14] * pull
            if not free[i]:
                continue
            f[i] += _handled(hands, grabbed, i, mid, x[i], v[i])
            m = m1 if i == 0 else cart[i, 0]
            if cart[i, 5] > 0.0:
                if first and v[i] == 0.0:
                    z[i] = min(max(f[i] / (scatter[i] * cart[i, 5]), -1.0), 1.0)
                rise = h * (w[i] - abs(w[i]) * z[i]) / cart[i, 6]
                f[i] -= scatter[i] * cart[i, 5] * (z[i] + 0.5 * rise)
                z[i] += rise
            # The inclusion: the impulse that stops the cart, limited to what friction can give.
            target = v[i] + h / m * f[i]
            most = cart[i, 2] + cart[i, 7] * abs(u)
            if cart[i, 3] > 0.0:
                speed = v[i] / cart[i, 4]
                most += cart[i, 3] * np.exp(-speed * speed)
            most *= scatter[i] * h / m
            if abs(target) <= most:
                v[i] = 0.0
            else:
                v[i] = target - np.sign(target) * most
        first = False
        for i in range(n):
            if free[i]:
                x[i] += 0.5 * h * v[i]
            if cart[i, 14] > 0.0:
                xh[i] += 0.5 * h * vh[i]
        xm += 0.5 * h * vm
        now += h
    return out


def simulate_truth(
    *,
    m: Sequence[float] | np.ndarray,
    c: Sequence[float] | np.ndarray,
    k: Sequence[float] | np.ndarray,
    hidden: Sequence[Hidden] = (),
    hands: Sequence[Hand] = (),
    t: np.ndarray,
    u: np.ndarray,
    free: Sequence[int],
    x0: np.ndarray | None = None,
    v0: np.ndarray | None = None,
    scatter: np.ndarray | None = None,
    step: float | None = None,
) -> np.ndarray:
    """Return the true readings (n, samples), without noise and encoder steps.

    `t` are the sample times; the input is held between samples. By default `step` (s) is as small
    as the effects need.
    """
    if step is None:
        step = CONTACT_STEP if any(e.effect in _CONTACTS for e in hidden) else STEP
    n = len(m)
    cart, spring = np.zeros((n, len(_CART))), np.zeros((n + 1, len(_SPRING)))
    drive = np.zeros(len(_DRIVE))
    cart[:, 0], cart[:, 1], cart[:, 13] = m, c, 1.0
    cart[:, 4] = cart[:, 6] = 1.0
    spring[:, 0] = k
    drive[1] = np.inf
    for effect in hidden:
        _hide(effect, cart, spring, drive)
    return _motion(
        cart,
        spring,
        drive,
        _hands(hands, m, k),
        np.array([i + 1 in free for i in range(n)]),
        t,
        t,
        np.asarray(u, dtype=float),
        # For strided arrays numba would compile again.
        np.zeros(n) if x0 is None else np.ascontiguousarray(x0, dtype=float),
        np.zeros(n) if v0 is None else np.ascontiguousarray(v0, dtype=float),
        np.ones(n) if scatter is None else scatter,
        step,
    )


def _hands(hands: Sequence[Hand], m, k) -> np.ndarray:
    """Return an array (hands, 8): cart, start, end, pull, push, there, stiffness and damping."""
    rows = []
    for h in hands:
        i = h.cart - 1
        stiffness = h.grip * (k[i] + k[i + 1]) if h.push == 0.0 else 0.0
        damping = 1.4 * np.sqrt(stiffness * m[i])
        rows.append([i, h.start, h.end, h.pull, h.push, h.there, stiffness, damping])
    return np.array(rows, dtype=float).reshape(-1, 8)


def _hide(effect: Hidden, cart: np.ndarray, spring: np.ndarray, drive: np.ndarray) -> None:
    p, i = dict(effect.parameters), effect.place - 1
    match effect.effect:
        case "coulomb_friction":
            cart[i, 2] = p["force"]
        case "stiction":
            cart[i, 2:5] = p["force"], p["static_force"] - p["force"], p["velocity"]
        case "presliding_friction":
            cart[i, 5:7] = p["force"], p["distance"]
        case "load_friction":
            cart[i, 7] = p["coefficient"]
        case "quadratic_drag":
            cart[i, 8] = p["coefficient"]
        case "force_offset":
            cart[i, 9] = p["force"]
        case "end_stop":
            # This simulator has its own contact law: a fifth of critical damping on the contact
            # spring.
            damping = p.get("damping", 0.4 * np.sqrt(p["stiffness"] * cart[i, 0]))
            cart[i, 10:13] = p["position"], p["stiffness"], damping
        case "sensor_gain":
            cart[i, 13] = p["gain"]
        case "extra_mode":
            cart[i, 14:17] = p["mass"], p["stiffness"], p["damping"]
        case "cubic_spring":
            spring[i, 1] = p["coefficient"]
        case "asymmetric_spring":
            spring[i, 5] = p["coefficient"]
        case "slack_spring":
            spring[i, 2:4] = p["stiffness_change"], p["stretch"]
        case "coupling_damper":
            spring[i, 4] = p["coefficient"]
        case "dead_zone":
            drive[0] = p["width"]
        case "saturation":
            drive[1] = p["limit"]
        case "input_delay":
            drive[2] = p["delay"]
        case "actuator_lag":
            drive[3] = p["time_constant"]
        case "drive_damping":
            drive[4] = p["coefficient"]
        case "cogging":
            drive[9:12] = p["force"], p["pitch"], p["phase"]
        case "backlash":
            motor = p.get("motor", 0.15) * cart[0, 0]
            contact = p.get("contact", 60.0) * float(spring[:2, 0].sum())
            drive[5:9] = p["gap"], motor, contact, 0.3 * np.sqrt(contact * motor)
        case other:
            raise ValueError(f"the truth knows no {other}")
