"""How well the time-domain stages measure: sine dwells, decays, dry friction, steps."""

import numpy as np

from benchmarks.page import Table, share
from pipeline.arrays import Array
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.linear.simulate import simulate_linear
from pipeline.results import Kind, Record
from pipeline.stages.log_decrement import fit_log_decrement
from pipeline.stages.sine import fit_sine
from pipeline.stages.step_gain import fit_step_gain

TITLE = "Decays, dwells and steps"
WORDS = """
What the stages before the fit make of one record each. Random single carts and presets, the ECP
210's encoder (0.00227 cm a count), 113 Hz to 1 kHz; relative errors against the truth.
"""
TOOLS = ()
COUNT = 0.00227  # cm
RATES = (113.1, 333.0, 1000.0)  # Hz
ZETAS = (0.01, 0.03, 0.07, 0.15)


def record(t: Array, y: Array, *, kind: Kind, u: Array | None = None, omega: float | None = None):
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
    """Position of a cart let go at `start` at 0.4 s; dry friction holds it within d of rest."""
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
    seeds = 3 if quick else 300
    return [decays(-(-seeds // 12)), friction(seeds), dwells(-(-seeds // 3)), steps()]


def decays(seeds: int) -> Table:
    rows = []
    for zeta in ZETAS:
        for fs in RATES:
            rng = np.random.default_rng(1)
            errors = []
            for _ in range(seeds):
                got = fit_log_decrement(
                    random_release(rng, zeta=zeta, fs=fs, d=0.0, noise=0.0), cart=1
                )
                errors.append([got.zeta / zeta - 1, got.zeta_peaks / zeta - 1])
            rms = np.sqrt(np.mean(np.square(errors), axis=0))
            worst = np.max(np.abs(errors), axis=0)[0]
            rows.append([f"{zeta}", f"{fs:g}", f"{rms[0]:.1e}", f"{worst:.1e}", f"{rms[1]:.1e}"])
    return Table(
        title=f"ζ of a clean decay, {seeds} seeds a line",
        head=["ζ", "rate, Hz", "fit of the record, rms", "most", "logarithms of the peaks, rms"],
        rows=rows,
        note="The peaks' logarithms are the textbook's method, which the report shows beside.",
    )


def friction(seeds: int) -> Table:
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
            test = fit_log_decrement(run, cart=1).friction
            present.append(test is not None and test.present)
        rows.append([f"{d}", share(sum(present), seeds)])
    return Table(
        title="Dry friction in one decay",
        head=["a cart is held within, cm", "friction said to be present"],
        rows=rows,
    )


def dwells(seeds: int) -> Table:
    rows = []
    for fs in (113.1, 500.0):
        for from_rest in (True, False):
            errors = np.array([_dwell_errors(seed, fs, from_rest) for seed in range(seeds)])
            rms = np.sqrt(np.mean(errors[:, :2] ** 2, axis=0))
            covered = 100 * np.mean(np.abs(errors[:, 2:]) < 1.96, axis=0)
            rows.append(
                [
                    f"{fs:g}",
                    "rest" if from_rest else "steady motion",
                    f"{rms[0]:.1e}",
                    f"{np.max(np.abs(errors[:, 0])):.1e}",
                    f"{rms[1]:.1e}",
                    f"{covered[0]:.0f} %, {covered[1]:.0f} %",
                ]
            )
    head = ["rate, Hz", "kept from", "gain, rms", "most", "phase, rms rad"]
    return Table(
        title=f"Sine dwells of 1 cm, {seeds} a line",
        head=[*head, "within 95 % limits: gain, phase"],
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
    got = fit_sine(run, cart=1)
    phase = float(np.angle(np.exp(1j * (got.phase - np.angle(truth)))))
    return [
        got.gain / abs(truth) - 1,
        phase,
        (got.gain - abs(truth)) / got.gain_std,
        phase / got.phase_std,
    ]


def steps() -> Table:
    rows = []
    for wait in (6.0, 2.0, 1.0):
        t = np.arange(0, 0.5 + 2 * wait, 0.00884)
        u = 0.03 * np.asarray((t >= 0.5) & (t < 0.5 + wait), dtype=np.float64)
        for name, chain in PRESETS.items():
            run = record(t, simulate_linear(chain, t, u), kind="step", u=u)
            errors = []
            for cart, truth in enumerate(chain.static_gains(), start=1):
                got = fit_step_gain(run, cart=cart)
                errors.append(f"{got.gain / truth - 1:+.1e} ± {got.gain_std / truth:.1e}")
            rows.append([f"{wait:g}", name, ", ".join(errors)])
    return Table(
        title="Steps of 0.03 V, on and off",
        head=["s each", "plant", "error of the static gain and its standard error, by cart"],
        rows=rows,
    )
