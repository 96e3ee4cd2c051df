"""Random benches with hidden effects, and the recordings that a class would make of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.results import Record
from tests.truth.bench import Hand, Hidden, simulate_truth

COUNT = 0.00227  # cm, one encoder step
_SMALLER = (0.7, 0.95)  # input of the further records, as a share of the largest input of a case
RATES = (113.1, 200.0, 250.0, 500.0, 1000.0)  # Hz

_M = ([1.98587e-4], [3.128204e-4, 1.737182e-4], [3.2732e-4, 2.516715e-4, 1.960671e-4])
_C = ([5.2427e-4], [6.663748e-4, 4.408337e-4], [1.1e-3, 4.32763e-4, 3.40361e-4])
_K = (
    [0.0346021, 0.0],
    [0.03, 0.1274783, 0.06085252],
    [0.03, 0.1234592, 0.06648407, 0.06275727],
)

EFFECTS = (
    "coulomb_friction",
    "stiction",
    "presliding_friction",
    "load_friction",
    "quadratic_drag",
    "cubic_spring",
    "slack_spring",
    "coupling_damper",
    "force_offset",
    "drive_damping",
    "dead_zone",
    "saturation",
    "input_delay",
    "actuator_lag",
    "backlash",
    "end_stop",
    "sensor_gain",
    "extra_mode",
    "cogging",
    "asymmetric_spring",
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """A bench, its hidden effects, its records, and the hands in the records."""

    n: int
    springs: tuple[bool, ...]
    hidden: tuple[Hidden, ...]
    records: tuple[Record, ...]
    m: tuple[float, ...]
    c: tuple[float, ...]
    k: tuple[float, ...]
    hands: Mapping[str, tuple[Hand, ...]] = field(default_factory=dict)


def make_case(
    *,
    seed: int,
    n: int,
    effects: Sequence[str | Hidden] = (),
    severity: float = 1.0,
    dirt: bool = False,
    wide: bool = False,
    handled: bool = False,
    rate: float | None = None,
) -> Case:
    """Make a bench with the named effects at random places and sizes, or with given effects.

    `wide` draws sizes over a decade, soft and hard contacts of any damping, and motors of any mass.
    Some of these cases are hard to recognise or fit.

    `dirt` adds features of real benches: friction that varies by 4 % between runs, encoders zeroed
    where the cart happens to rest, and time stamps rounded to 0.1 ms.

    If `handled` is true, people pluck carts once or twice per record, nudge them, push at the end,
    and hold them with a hand that yields.
    """
    rng = np.random.default_rng(seed)
    m = np.array(_M[n - 1]) * rng.uniform(0.8, 1.25, n)
    c = np.array(_C[n - 1]) * rng.uniform(0.7, 1.4, n)
    k = np.array(_K[n - 1]) * rng.uniform(0.8, 1.25, n + 1)
    if n > 1 and rng.random() < 0.4:
        k[0] = 0.0
    rate = float(rng.choice(RATES)) if rate is None else rate
    stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    gain = float(np.linalg.inv(stiffness)[0, 0])
    large = rng.uniform(1.0, 1.5) / gain  # 1 to 1.5 cm, twice that with overshoot
    plan = _plan(n, large, rng, rate)
    linear = [
        simulate_truth(m=m, c=c, k=k, t=t, u=u, free=free, x0=x0, step=2e-4)
        for _, _, t, u, free, x0 in plan
    ]
    hidden = tuple(
        effect
        if isinstance(effect, Hidden)
        else _draw(effect, n, m, c, k, stiffness, large, rate, linear, severity, rng, wide)
        for effect in effects
    )
    hands = _lay_hands(n, large, rng) if handled else {}
    records = []
    for name, kind, t, u, free, x0 in plan:
        laid = hands.get(name, ())
        if any(hand.pull for hand in laid):
            x0 = np.zeros(n)
        moving = {*free, *(hand.cart for hand in laid)}
        scatter = 1.0 + (0.04 * rng.standard_normal(n) if dirt else np.zeros(n))
        lead = 0.0
        if dirt and kind != "decay":
            # The cart was left within its friction band, and its encoder was zeroed there.
            x0 = np.array([_rest_band(h, stiffness, i, rng) for i, h in _by_cart(hidden, n)])
            x0 = np.where([i + 1 in free for i in range(n)], x0, 0.0)
        y = simulate_truth(
            m=m, c=c, k=k, hidden=hidden, hands=laid, t=t, u=u, free=tuple(moving), x0=x0,
            scatter=scatter,
        )  # fmt: skip
        y = y + 0.3 * COUNT * rng.standard_normal(y.shape) + lead
        if dirt:
            y -= y[:, :1] if kind != "decay" else y[:, -1:]
        y = np.round(y / COUNT) * COUNT
        stamps = np.round(t, 4) if dirt else t
        records.append(_record(name, kind, stamps, u, y, free=free, count=COUNT))
    return _case(m, c, k, hidden, records, hands)


def further_records(case: Case, *, seed: int) -> tuple[Record, ...]:
    """Return new records of the bench of a case that has neither hands nor dirt.

    Steps and sweep have other sizes, no larger than before; releases and noise differ too.
    """
    rng = np.random.default_rng(seed)
    m, c, k = np.array(case.m), np.array(case.c), np.array(case.k)
    largest = max(np.abs(r.u).max() for r in case.records if r.u is not None)
    large = rng.uniform(*_SMALLER) * largest
    records = []
    for name, kind, t, u, free, x0 in _plan(case.n, large, rng, 1.0 / case.records[0].sample_time):
        y = simulate_truth(m=m, c=c, k=k, hidden=case.hidden, t=t, u=u, free=free, x0=x0)
        y = np.round((y + 0.3 * COUNT * rng.standard_normal(y.shape)) / COUNT) * COUNT
        records.append(_record(name, kind, t, u, y, free=free, count=COUNT))
    return tuple(records)


def make_rig(*, seed: int, n: int, trials: int = 3) -> Case:
    """Make a realistic bench with several effects, none of which alone explains the gap.

    Every cart has dry friction of nearly the same size, which differs between runs. The viscous
    damping of cart 1 doubles while the motor drives. Decays start from a hand's release, each with
    its own speed and zero. The encoder is coarse. Each run has `trials` repeats of a single size.
    """
    rng = np.random.default_rng(seed)
    m = np.array(_M[n - 1]) * rng.uniform(0.8, 1.25, n)
    c = np.array(_C[n - 1]) * rng.uniform(0.7, 1.4, n)
    k = np.array(_K[n - 1]) * rng.uniform(0.8, 1.25, n + 1)
    stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    force = rng.uniform(0.015, 0.025) * stiffness[0, 0]
    friction = [
        Hidden(
            effect="coulomb_friction",
            place=i + 1,
            parameters={"force": force * rng.uniform(0.85, 1.15)},
        )
        for i in range(n)
    ]
    braking = Hidden(effect="drive_damping", parameters={"coefficient": c[0]})
    hidden = (*friction, braking)
    count = 4.0 * COUNT
    everything, dt = tuple(range(1, n + 1)), 1.0 / 113.1
    runs = [("alone", "step", (1,)), *(("both", "step", everything),) * (n > 1)]
    runs += [(f"hand-{cart}", "decay", (cart,)) for cart in everything]
    records = []
    for name, kind, free in runs:
        held = stiffness[0, 0] if name == "alone" else 1.0 / np.linalg.inv(stiffness)[0, 0]
        size = held * rng.uniform(1.2, 1.8)
        for trial in range(trials):
            t = np.asarray(np.arange(round(6.0 / dt)) * dt, dtype=np.float64)
            x0, v0 = np.zeros(n), np.zeros(n)
            u = np.zeros(t.size)
            if kind == "step":
                u[:] = np.where((t >= 0.05) & (t < 3.05), size, 0.0)
            else:
                i = free[0] - 1
                x0[i] = rng.uniform(1.2, 2.2) * rng.choice([-1.0, 1.0])
                v0[i] = rng.uniform(-0.2, 0.2) * x0[i] * np.sqrt(stiffness[i, i] / m[i])
            scatter = (1.0 + 0.08 * rng.standard_normal()) * (1.0 + 0.02 * rng.standard_normal(n))
            y = simulate_truth(
                m=m, c=c, k=k, hidden=hidden, t=t, u=u, free=free, x0=x0, v0=v0, scatter=scatter
            )
            y = y + rng.uniform(-0.05, 0.05, (n, 1)) * np.array([[i in free] for i in everything])
            y = np.round((y + 0.3 * COUNT * rng.standard_normal(y.shape)) / count) * count
            records.append(_record(f"{name}-{trial}", kind, t, u, y, free=free, count=count))
    return _case(m, c, k, hidden, records)


def _record(name, kind, t, u, y, *, free, count):
    n = len(y)
    return Record(
        id=name,
        kind=kind,
        t=t,
        u=u,
        y=y,
        carts=tuple(range(1, n + 1)),
        free=free,
        resolution=np.full(n, count),
    )


def _case(m, c, k, hidden, records, hands=None):
    return Case(
        hands=hands or {},
        n=len(m),
        springs=tuple(bool(s > 0) for s in k),
        hidden=hidden,
        records=tuple(records),
        m=tuple(m),
        c=tuple(c),
        k=tuple(k),
    )


def _by_cart(hidden, n):
    dry = ("coulomb_friction", "stiction", "presliding_friction")
    for i in range(n):
        yield i, next((h for h in hidden if h.effect in dry and h.place == i + 1), None)


def _rest_band(h, stiffness, i, rng):
    return 0.0 if h is None else rng.uniform(-0.5, 0.5) * h.parameters["force"] / stiffness[i, i]


def _plan(n, large, rng, rate):
    """Return the plan: steps of two sizes (one repeated), a sweep, and decays released by hand."""
    dt = 1.0 / rate
    everything = tuple(range(1, n + 1))
    plan = []

    def step(name, size, seconds=6.0):
        t = np.arange(round(seconds * rate)) * dt
        on = (t >= 0.05) & (t < 0.05 + 0.5 * seconds)
        plan.append((name, "step", t, np.where(on, size, 0.0), everything, np.zeros(n)))

    step("step-a", large)
    step("step-b", 0.5 * large)
    step("step-c", large)
    step("step-d", -0.75 * large)
    t = np.arange(round(8.0 * rate)) * dt
    rate_of_sweep = (8.0 - 0.5) / 8.0
    chirp = np.sin(2 * np.pi * (0.5 + 0.5 * rate_of_sweep * t) * t)
    plan.append(("sweep", "sweep", t, 0.45 * large * chirp, everything, np.zeros(n)))
    for cart in everything:
        for trial in range(2):
            t = np.arange(round(5.0 * rate)) * dt
            x0 = np.zeros(n)
            x0[cart - 1] = rng.uniform(1.2, 2.2) * (1 if trial == 0 else -1)
            plan.append((f"decay-{cart}{'ab'[trial]}", "decay", t, 0 * t, (cart,), x0))
    return plan


def _lay_hands(n, large, rng) -> dict[str, tuple[Hand, ...]]:
    """Draw what hands do in the runs of `_plan`: all decays are plucked, one step is nudged."""
    hands = {}
    for cart in range(1, n + 1):
        soft = [
            Hand(cart=other, start=-1.0, end=1e9, grip=rng.uniform(15.0, 40.0))
            for other in (cart - 1, cart + 1)
            if 0 < other <= n
        ]
        for trial, starts in enumerate(((0.4, 2.6), (0.6,))):
            laid = []
            for start in starts:
                begin, seconds = start + rng.uniform(0.0, 0.3), rng.uniform(0.15, 0.7)
                pull = rng.uniform(1.2, 2.2) * rng.choice([-1.0, 1.0])
                laid.append(Hand(cart=cart, start=begin, end=begin + seconds, pull=pull,
                                 there=rng.uniform(0.5, 0.85)))  # fmt: skip
            if trial == 1:
                begin = rng.uniform(3.6, 4.2)
                push = rng.uniform(0.3, 0.8) * large * rng.choice([-1.0, 1.0])
                seconds = rng.uniform(0.15, 0.4)
                laid.append(Hand(cart=cart, start=begin, end=begin + seconds, push=push))
            hands[f"decay-{cart}{'ab'[trial]}"] = (*laid, *soft)
    begin, cart = rng.uniform(1.2, 2.4), int(rng.integers(1, n + 1))
    push = rng.uniform(0.3, 0.8) * large * rng.choice([-1.0, 1.0])
    hands["step-d"] = (Hand(cart=cart, start=begin, end=begin + rng.uniform(0.15, 0.4), push=push),)
    return hands


def _draw(name, n, m, c, k, stiffness, large, rate, linear, severity, rng, wide=False) -> Hidden:
    """Draw place and size of an effect; `severity` scales its difference from a linear bench."""
    s = severity * float(np.exp(rng.uniform(np.log(0.3), np.log(1.5)))) if wide else severity
    i = int(rng.integers(n))
    present = [j for j in range(n + 1) if k[j] > 0]
    j = int(rng.choice(present))
    reach = max(float(np.abs(y[i]).max()) for y in linear)
    steps = max(float(np.abs(y[i]).max()) for y in linear[:4])
    speed = 0.5 * reach * np.sqrt(stiffness[i, i] / m[i])
    force = s * float(rng.uniform(0.008, 0.03)) * stiffness[i, i]
    stretch = max(
        float(np.abs((y[j] if j < n else 0.0) - (y[j - 1] if j > 0 else 0.0)).max()) for y in linear
    )
    sign = float(rng.choice([-1.0, 1.0]))
    draw = rng.uniform
    match name:
        case "coulomb_friction":
            return Hidden(effect=name, place=i + 1, parameters={"force": force})
        case "stiction":
            parameters = {
                "force": force,
                "static_force": force * draw(1.5, 2.5),
                "velocity": draw(0.5, 2.0),
            }
            return Hidden(effect=name, place=i + 1, parameters=parameters)
        case "presliding_friction":
            parameters = {"force": force, "distance": draw(0.01, 0.05)}
            return Hidden(effect=name, place=i + 1, parameters=parameters)
        case "load_friction":
            return Hidden(effect=name, place=i + 1, parameters={"coefficient": s * draw(0.03, 0.1)})
        case "quadratic_drag":
            q = s * draw(0.5, 2.0) * c[i] / speed
            return Hidden(effect=name, place=i + 1, parameters={"coefficient": q})
        case "force_offset":
            return Hidden(
                effect=name,
                place=i + 1,
                parameters={"force": s * sign * draw(0.05, 0.2) * stiffness[i, i]},
            )
        case "cubic_spring":
            size = draw(0.08, 0.9 if wide else 0.3) if sign > 0 else draw(0.04, 0.12)
            a = s * sign * size * k[j] / stretch**2
            return Hidden(effect=name, place=j + 1, parameters={"coefficient": a})
        case "asymmetric_spring":
            b = s * sign * draw(0.08, 0.5 if wide else 0.3) * k[j] / stretch
            return Hidden(effect=name, place=j + 1, parameters={"coefficient": b})
        case "slack_spring":
            r = s * (draw(0.4, 1.5) if rng.random() < 0.6 else -draw(0.3, 0.6))
            side = sign * draw(0.15, 0.5) * stretch
            return Hidden(
                effect=name, place=j + 1, parameters={"stiffness_change": r, "stretch": side}
            )
        case "coupling_damper":
            inner = [p for p in present if 0 < p < n]
            place = int(rng.choice(inner))
            return Hidden(
                effect=name,
                place=place + 1,
                parameters={"coefficient": s * draw(0.4, 1.5) * c[place]},
            )
        case "drive_damping":
            return Hidden(effect=name, parameters={"coefficient": s * draw(0.2, 0.8) * c[0]})
        case "dead_zone":
            return Hidden(effect=name, parameters={"width": s * draw(0.05, 0.2) * large})
        case "saturation":
            return Hidden(effect=name, parameters={"limit": (1 - s * draw(0.1, 0.35)) * large})
        case "input_delay":
            return Hidden(effect=name, parameters={"delay": s * draw(0.006, 0.03)})
        case "actuator_lag":
            return Hidden(effect=name, parameters={"time_constant": s * draw(0.01, 0.04)})
        case "backlash" if wide:
            return Hidden(
                effect=name,
                parameters={
                    "gap": draw(0.05, 0.3),
                    "motor": draw(0.08, 0.4),
                    "contact": draw(20.0, 100.0),
                },
            )
        case "backlash":
            return Hidden(effect=name, parameters={"gap": s * draw(0.03, 0.12)})
        case "cogging":
            # At most 0.6 of the size at which the cart would jump from tooth to tooth.
            pitch = draw(0.2, 0.6)
            force = s * draw(0.2, 0.6) * stiffness[0, 0] * pitch / (2 * np.pi)
            parameters = {"force": force, "pitch": pitch, "phase": draw(-np.pi, np.pi)}
            return Hidden(effect=name, parameters=parameters)
        case "end_stop":
            side = 1.0 if linear[0][i].max() > -linear[0][i].min() else -1.0
            parameters = {
                "position": side * (1 - s * draw(0.1, 0.35)) * steps,
                "stiffness": draw(10.0, 40.0) * stiffness[i, i],
            }
            if wide:
                hard = float(np.exp(draw(np.log(1.5), np.log(30.0)))) * stiffness[i, i]
                damping = draw(0.05, 0.8) * np.sqrt(hard * m[i])
                parameters |= {"stiffness": hard, "damping": damping}
            return Hidden(effect=name, place=i + 1, parameters=parameters)
        case "sensor_gain":
            return Hidden(
                effect=name, place=i + 1, parameters={"gain": 1 + s * sign * draw(0.03, 0.1)}
            )
        case "extra_mode":
            mass = s * draw(0.06, 0.2) * m[i]
            omega = draw(0.6, 1.8) * np.sqrt(stiffness[i, i] / m[i])
            parameters = {
                "mass": mass,
                "stiffness": mass * omega**2,
                "damping": 2 * draw(0.01, 0.08) * mass * omega,
            }
            return Hidden(effect=name, place=i + 1, parameters=parameters)
        case other:
            raise ValueError(f"no effect {other}")
