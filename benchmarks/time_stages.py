"""How well the time-domain stages measure sine dwells, decays, dry friction and steps."""

import numpy as np

from benchmarks.page import Table, share
from pipeline.arrays import Array
from pipeline.estimation.decay import fit_log_decrement
from pipeline.estimation.sine import Dwell
from pipeline.estimation.static_gain import fit_static_gain
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import simulate_linear
from pipeline.results import ExperimentKind, Record

TITLE = "Decays, dwells and steps"
WORDS = """
**How accurate are the numbers that come from a single record?**
"""
TOOLS = ()
COUNT = 0.00227  # cm
RATES = (113.1, 333.0, 1000.0)  # Hz
DWELL_RATES = (113.1, 500.0)  # Hz
ZETAS = (0.01, 0.03, 0.07, 0.15)
INSIDE = 1.96  # 95 % of the estimates are within this many standard errors, if these are right


def record(
    t: Array, y: Array, *, kind: ExperimentKind, u: Array | None = None, omega: float | None = None
):
    return Record(
        id=kind,
        kind=kind,
        t=t,
        u=u,
        y=np.round(np.atleast_2d(y) / COUNT) * COUNT,
        carts=tuple(range(1, np.atleast_2d(y).shape[0] + 1)),
        free=tuple(range(1, np.atleast_2d(y).shape[0] + 1)),
        omega=omega,
        resolution=np.full(np.atleast_2d(y).shape[0], COUNT),
    )


def release(t: Array, *, omega_n: float, zeta: float, start: float, d: float) -> Array:
    """Return the position of a cart released at 0.4 s; dry friction holds it within d of rest."""
    omega_d, decay = omega_n * np.sqrt(1 - zeta**2), zeta * omega_n
    half, turning, y = np.pi / omega_d, start, np.full_like(t, start)
    for k in range(int((t[-1] - 0.4) / half) + 1):
        now = t >= 0.4 + k * half
        if abs(turning) <= d:
            y[now] = turning
            break
        middle, tau = np.copysign(d, turning), t[now] - 0.4 - k * half
        swing = np.cos(omega_d * tau) + decay / omega_d * np.sin(omega_d * tau)
        y[now] = middle + (turning - middle) * np.exp(-decay * tau) * swing
        turning = middle - (turning - middle) * np.exp(-decay * half)
    return y


def random_release(rng: np.random.Generator, *, zeta: float, fs: float, d: float, noise: float):
    """Return a release of a random cart."""
    omega_n = rng.uniform(12, 35)
    t = np.arange(0, 0.4 + min(4.5 / (zeta * omega_n), 8.0), 1 / fs)
    start = rng.choice([-1, 1]) * rng.uniform(0.7, 1.8)
    y = release(t, omega_n=omega_n, zeta=zeta, start=start, d=d)
    return record(t, y + noise * COUNT * rng.normal(size=t.size), kind="decay")


def tables(*, quick: bool) -> list[Table]:
    """Return the errors of the stages, and how often dry friction is reported in a decay."""
    seeds = 3 if quick else 300
    return [errors(decays=-(-seeds // 12), dwells=-(-seeds // 3)), friction(seeds)]


def errors(*, decays: int, dwells: int) -> Table:
    """Return a row for each kind of number, from this many decays and dwells."""
    damping = np.concatenate([_decay_errors(decays, zeta, fs) for zeta in ZETAS for fs in RATES])
    rows = [
        _row("ζ of a clean decay: fit of the record", damping[:, 0]),
        _row("the same: logarithms of its peaks", damping[:, 1]),
    ]
    for words, from_rest in (("from rest", True), ("in steady motion", False)):
        found = [_dwell_errors(seed, fs, from_rest) for fs in DWELL_RATES for seed in range(dwells)]
        gain, phase, gain_z, phase_z = np.transpose(found)
        rows += [
            _row(f"gain of a dwell recorded {words}", gain, gain_z),
            _row("its phase, rad", phase, phase_z),
        ]
    rows.append(_row("static gain from a step", *np.transpose(_step_errors())))
    head = ["number", "measured", "error, rms", "largest", "within its 95 % limits"]
    return Table(title="How far off is each number?", head=head, rows=rows, note=_NOTE)


def _row(words: str, off: Array, z: Array | None = None) -> list[str]:
    """Return a table row: count, RMS and largest error, and the share with |z| below `INSIDE`."""
    inside = "–" if z is None else f"{np.mean(np.abs(z) < INSIDE):.0%}"
    size = np.abs(off)
    return [
        words, f"{size.size}", f"{np.sqrt(np.mean(size**2)):.1e}", f"{size.max():.1e}", inside
    ]  # fmt: skip


def _decay_errors(seeds: int, zeta: float, fs: float) -> Array:
    """Return relative errors of ζ in random clean decays, from the fit and from the peaks."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(seeds):
        got = fit_log_decrement(random_release(rng, zeta=zeta, fs=fs, d=0.0, noise=0.0), cart=1)
        found.append([got.zeta / zeta - 1, got.zeta_peaks / zeta - 1])
    return np.array(found)


def friction(seeds: int) -> Table:
    """Return how often dry friction is reported in a decay, by the size of the friction."""
    rows = []
    for d in (0.0, 0.002, 0.01):
        present = []
        for seed in range(seeds):
            rng = np.random.default_rng(seed)
            run = random_release(
                rng,
                zeta=rng.uniform(0.01, 0.2),
                fs=rng.choice([113.1, 250.0]),
                d=d,
                noise=rng.choice([0.0, 0.2, 0.5]),
            )
            present.append(fit_log_decrement(run, cart=1).law.is_friction)
        rows.append([f"{d}", share(sum(present), seeds)])
    return Table(
        title="Is dry friction reported only if it is there?",
        head=["the cart sticks within, cm", "decays reported with friction"],
        rows=rows,
    )


def _dwell_errors(seed: int, fs: float, from_rest: bool) -> list[float]:
    rng = np.random.default_rng(seed)
    chain = PRESETS[f"throne-{1 + seed % 3}dof"]
    hertz = rng.uniform(0.7, 7.0)
    truth = chain.frequency_response(np.array([2 * np.pi * hertz]))[0, 0]
    wait = 7 / float(np.min(-chain.poles.real))
    t = np.arange(0, wait + max(7 / hertz, 1.6), 1 / fs)
    u = np.asarray(np.sin(2 * np.pi * hertz * t) / abs(truth), dtype=float)
    y = simulate_linear(chain, t, u)
    keep = t >= (0 if from_rest else wait)
    run = record(t[keep], y[:, keep], kind="sine", u=u[keep], omega=2 * np.pi * hertz)
    got = Dwell(run).fit(cart=1)
    phase = float(np.angle(np.exp(1j * (got.phase - np.angle(truth)))))
    return [
        got.gain / abs(truth) - 1,
        phase,
        (got.gain - abs(truth)) / got.gain_std,
        phase / got.phase_std,
    ]


def _step_errors() -> list[tuple[float, float]]:
    """Return each static gain's relative error, and its error in standard errors."""
    found = []
    for wait in (6.0, 2.0, 1.0):
        t = np.arange(0, 0.5 + 2 * wait, 0.00884)
        u = 0.03 * np.asarray((t >= 0.5) & (t < 0.5 + wait), dtype=np.float64)
        for chain in PRESETS.values():
            run = record(t, simulate_linear(chain, t, u), kind="step", u=u)
            for cart, truth in enumerate(chain.static_gains(), start=1):
                got = fit_static_gain(run, cart=cart)
                found.append((got.gain / truth - 1, (got.gain - truth) / got.gain_std))
    return found


_NOTE = """
Errors of ζ and gains are relative. Random single carts and the presets; an ECP 210's encoder
(0.00227 cm a count) at 113 Hz to 1 kHz. Decays have ζ from 0.01 to 0.15, dwells 1 cm, steps 0.03 V
for 1 to 6 s. A textbook takes the logarithms of the peaks; the report shows both.
"""
