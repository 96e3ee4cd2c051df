"""Build complete analyses from known chains, without running any stage.

The numbers are what the stages would plausibly find: the true values plus a small, seeded error.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.frequency_response import collect_dwells
from pipeline.names import read_name
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.results import (
    Analysis,
    ChainFit,
    Check,
    DecayLaw,
    Estimate,
    FeedbackDesign,
    HardwareCheck,
    LogDecrement,
    ParameterRow,
    Record,
    SinePoint,
    Skipped,
    Stage,
    StepEdge,
    StepGain,
)
from pipeline.setup import PAPER_UNITS, Setup
from tests.helpers.time_records import COUNT, record_of

NOTES = "## What we saw\n\nThe *dampings* differ, as `zeta_a` shows:\n\n- friction\n- play\n"
_SAMPLE_TIME = 0.00884  # s, the controller of the ECP bench
_AMPLITUDE = 0.1  # V
_PRESET = {1: "throne-1dof", 2: "throne-2dof", 3: "throne-3dof"}


@cache
def make_analysis(carts: int = 2, *, seed: int = 1, repeats: int = 2) -> Analysis:
    """Return a complete analysis of the preset of 1, 2 or 3 carts."""
    rng = np.random.default_rng(seed)
    chain = PRESETS[_PRESET[carts]]
    numbers = range(1, carts + 1)
    decays = [_decay(chain, cart, repeat, rng) for cart in numbers for repeat in range(repeats)]
    step, gains = _step(chain, rng)
    dwells, points = _dwells(chain, rng)
    control, hardware, feedback = _closed_loop(chain, rng)
    fit = _fit(chain, n_points=len(points), dwells=[record.id for record in dwells])
    records = (*(record for record, _ in decays), step, *dwells, control)
    return Analysis(
        title=f"The {carts}-cart system, bench 4",
        section="03",
        authors=(("s1024", "Ada Lovelace"), ("s1025", "Émilie du Châtelet")),
        bench=Setup(springs=(True,) * (carts + 1)),
        records=records,
        log_decrements=tuple(decay for _, decay in decays),
        step_gains=gains,
        sine_points=points,
        frequency_responses=collect_dwells(points),
        fit=fit,
        rows=_rows(fit, rng),
        checks=_checks(carts),
        feedback=feedback,
        hardware=hardware,
        skipped=(
            Skipped(stage=Stage.FREQUENCY_RESPONSE, reason="sweep: needs a record, found none"),
        ),
        warnings=("decay-1-1: the release was found at 0.62 s; what lies before is not used",),
        files={f"data/{record.id}.csv": f"{i:064x}" for i, record in enumerate(records)},
        discussion=NOTES,
    )


def _record(kind, id_, t, y, rng, *, u=None, carts=None, reference=None, omega=None) -> Record:
    """Return positions as an encoder with a little noise reads them."""
    y = y + rng.normal(0.0, 0.3 * COUNT, y.shape)
    record = record_of(t, u, y, kind=kind, id=id_, carts=carts, reference=reference, omega=omega)
    return replace(record, source=f"data/{id_}.csv")


def _decay(chain: Chain, cart: int, repeat: int, rng: np.random.Generator):
    omega, zeta = float(chain.omega_carts[cart - 1]), float(chain.zeta_carts[cart - 1])
    release = 0.62
    t = np.arange(0.0, min(release + 5.0 / (zeta * omega), 6.0), _SAMPLE_TIME)
    tau = np.clip(t - release, 0.0, None)
    omega_d = omega * np.sqrt(1 - zeta**2)

    def wave(s: Array) -> Array:
        swing = np.cos(omega_d * s) + zeta / np.sqrt(1 - zeta**2) * np.sin(omega_d * s)
        return 2.5 * np.exp(-zeta * omega * s) * swing

    name = f"decay-{cart}-{repeat + 1}"
    record = _record("decay", name, t, wave(tau)[None], rng, carts=(cart,))
    n_peaks = int(np.clip(np.log(2.5 / (4 * COUNT)) / (np.pi * zeta), 3, 14))
    peak_t = release + np.pi / omega_d * np.arange(n_peaks)
    fit_t = t[t >= release]
    envelope = 2.5 * np.exp(-zeta * omega * (fit_t - release)) / np.sqrt(1 - zeta**2)
    amplitude = 2.5 * np.exp(-zeta * omega * (peak_t[1:-1] - release))
    law = DecayLaw(
        name="dry_friction" if repeat else "exponential",
        statistic=24.0 if repeat else 1.4,
        limit=4.1,
        size=0.004 if repeat else float("nan"),
        size_std=0.0004 if repeat else float("nan"),
        omega_n=omega,
        omega_n_std=0.002 * omega,
        zeta=zeta * 0.9,
        zeta_std=0.002 * zeta,
    )
    scatter = 1 + rng.normal(0, 0.002, 4)
    return record, LogDecrement(
        experiment=record.id,
        cart=cart,
        release=release,
        peak_t=peak_t,
        peak_y=wave(peak_t - release),
        amplitude=amplitude,
        delta=2 * np.pi * zeta / np.sqrt(1 - zeta**2) * scatter[0],
        delta_std=0.003 * zeta,
        zeta_peaks=zeta * scatter[0],
        zeta_peaks_std=0.004 * zeta,
        omega_n_peaks=omega * scatter[1],
        omega_n_peaks_std=0.004 * omega,
        zeta=zeta * scatter[2],
        zeta_std=0.002 * zeta,
        omega_n=omega * scatter[3],
        omega_n_std=0.002 * omega,
        fit_t=fit_t,
        fit_y=wave(fit_t - release),
        envelope_upper=envelope,
        envelope_lower=-envelope,
        law=law,
        zeta_at_amplitude=np.vstack([amplitude, zeta * (1 + 0.03 / amplitude)]),
        note="",
    )


def _step(chain: Chain, rng: np.random.Generator):
    t = np.arange(0.0, 9.0, _SAMPLE_TIME)
    u = np.where((t > 0.5) & (t < 5.0), 0.05, 0.0)
    record = _record("step", "step-a", t, simulate_linear(chain, t, u), rng, u=u)
    gains = []
    for cart, K in enumerate(chain.static_gains(), start=1):
        K = float(K * (1 + rng.normal(0, 0.01)))
        edges = tuple(
            StepEdge(
                t=at,
                u_before=0.05 - after,
                u_after=after,
                level_before=K * (0.05 - after),
                level_after=K * after,
                window_before=(at - 0.5, at),
                window_after=(at + 2.5, at + 3.5),
                gain=K,
                gain_std=0.01 * K,
            )
            for at, after in ((0.5, 0.05), (5.0, 0.0))
        )
        gains.append(
            StepGain(
                experiment="step-a",
                cart=cart,
                edges=edges,
                gain=K,
                gain_std=0.01 * K,
                rest_shift=0.003,
                interval=None,
            )
        )
    return record, tuple(gains)


def _dwells(chain: Chain, rng: np.random.Generator):
    records, points = [], []
    for i, hertz in enumerate(np.geomspace(0.4, 8.0, 24)):
        omega = 2 * np.pi * hertz
        response = chain.frequency_response(np.array([omega]))[:, 0]
        t = np.arange(0.0, 8.0, _SAMPLE_TIME)
        u = _AMPLITUDE * np.sin(omega * t)
        id_ = f"sine-{i + 1:02d}"
        y = simulate_linear(chain, t, u)
        records.append(_record("sine", id_, t, y, rng, u=u, omega=float(omega)))
        for cart, value in enumerate(response, start=1):
            amplitude = _AMPLITUDE * abs(value)
            std = 0.01 * amplitude + 0.001
            points.append(
                SinePoint(
                    experiment=id_,
                    cart=cart,
                    omega=float(omega),
                    amplitude=float(abs(amplitude + rng.normal(0, std))),
                    amplitude_std=float(std),
                    phase=float(np.angle(value) + rng.normal(0, 0.01)),
                    phase_std=float(std / amplitude),
                    input_amplitude=_AMPLITUDE,
                    input_amplitude_std=1e-4,
                    steady_from=4.0,
                    settled=i != 3,
                    n_points=450,
                )
            )
    return records, tuple(points)


def _fit(chain: Chain, *, n_points: int, dwells: list[str]) -> ChainFit:
    sizes = (("m", chain.n), ("c", chain.n), ("k", chain.n + 1))
    names = tuple(f"{letter}_{i}" for letter, n in sizes for i in range(1, n + 1))
    values = np.concatenate([chain.m, chain.c, chain.k])
    parameters = {
        name: Estimate(value=value, std=0.003 * value, source="bode_fit")
        for name, value in chain.parameters().items()
    }
    return ChainFit(
        method="bode_fit",
        chain=chain,
        names=names,
        covariance=np.diag((0.005 * values + 1e-6) ** 2),
        parameters=parameters,
        staged={name: 1.01 * e.value for name, e in parameters.items()},
        chi_square_per_dof=1.04,
        dof=n_points - len(names),
        n_points=n_points,
        n_starts=1,
        converged=True,
        message="converged",
        experiments=tuple(dwells),
    )


def _rows(fit: ChainFit, rng: np.random.Generator) -> tuple[ParameterRow, ...]:
    rows = []
    for name, final in fit.parameters.items():
        is_damping = name.startswith("zeta")
        change = float(rng.normal(0, 30 if is_damping else 1))
        std = 0.02 * final.value
        value = final.value / (1 + change / 100)
        guess = name.startswith(("zeta_a", "zeta_b", "zeta_c"))
        initial = (
            Estimate(value=0.1, std=None, source="assumed")
            if guess
            else Estimate(value=value, std=std, source="log_decrement")
        )
        sigmas = None if guess else abs(final.value - value) / std
        rows.append(
            ParameterRow(
                name=name,
                unit=read_name(name).unit(PAPER_UNITS),
                initial=initial,
                final=final,
                change_percent=100 * (final.value / initial.value - 1),
                change_sigmas=sigmas,
                consistent=None if sigmas is None else sigmas < 3,
                note="a dwell at resonance sees dry friction too" if is_damping else "",
            )
        )
    return tuple(rows)


def _checks(carts: int) -> tuple[Check, ...]:
    return (
        Check(
            kind="order", parameter="omega_1", outcome="pass", value=0.0, limit=None,
            message="omega_a lies below omega_1, as it must",
        ),
        Check(
            kind="redundancy", parameter="R1", outcome="fail" if carts > 1 else "pass",
            value=0.041, limit=0.03,
            message="the two routes to the s coefficient differ by 4.1 %",
        ),
        Check(
            kind="step", run="step-a", outcome="skip", value=None, limit=None,
            message="the static gains need a step record",
        ),
    )  # fmt: skip


def _closed_loop(chain: Chain, rng: np.random.Generator):
    """Return a record under proportional-derivative feedback, its checks and a design."""
    n = chain.n
    A, B, C, _ = chain.state_space()
    gains = np.zeros(2 * n)
    gains[:2] = 0.3 / chain.static_gains()[0], 0.002
    prefilter = float(1 / (C[n - 1] @ np.linalg.solve(-(A - B * gains), B[:, 0])))
    loop = Chain(
        m=chain.m,
        c=chain.c + np.eye(n)[0] * gains[1],
        k=chain.k + np.eye(n + 1)[0] * gains[0],
    )
    t = np.arange(0.0, 4.0, _SAMPLE_TIME)
    reference = np.where(t > 0.2, 1.0, 0.0)
    model = simulate_linear(loop, t, prefilter * reference)
    record = _record("closed_loop", "control", t, 1.05 * model, rng, reference=reference)
    measured = record.y
    u = prefilter * reference - gains[0] * measured[0]
    record = replace(record, u=u)
    hardware = tuple(
        HardwareCheck(
            experiment="control",
            cart=cart,
            loop="closed",
            nrmse=0.05,
            overshoot_model=12.0,
            overshoot_measured=14.5,
            settling_model=0.9,
            settling_measured=1.1 if cart == 1 else None,
            steady_state_model=float(model[cart - 1, -1]),
            steady_state_measured=float(measured[cart - 1, -1]),
            input_scale=1.0,
            t=t,
            measured=measured[cart - 1],
            model=model[cart - 1],
        )
        for cart in range(1, n + 1)
    )
    feedback = FeedbackDesign(
        cart=n,
        method="lqr",
        reference=1.0,
        gains=gains,
        prefilter=prefilter,
        poles=np.linalg.eigvals(A - B * gains).astype(np.complex128),
        requested_poles=None,
        sample_time=_SAMPLE_TIME,
        overshoot_percent=12.0,
        settling_time=0.9,
        peak_input=float(np.max(np.abs(u))),
        t=t,
        y=model,
        u=prefilter * reference - gains[0] * model[0],
        reachable=True,
        message="overshoot, settling time and input limit are met",
    )
    return record, hardware, feedback
