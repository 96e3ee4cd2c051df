"""Fit the linear chain to all runs at once, so that only the missing effects remain."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.arrays import Array
from pipeline.estimation.modulating import bump
from pipeline.estimation.noise import high_frequency_noise
from pipeline.gap.data.runs import GapRun, cut_shots
from pipeline.gap.fit.levenberg_marquardt import Fitting, GapFit, Mapper, fit_model
from pipeline.gap.fit.linearise import fresh_nuisance, simulate_run
from pipeline.gap.fit.restart import restart_runs
from pipeline.gap.fit.structure import Structure
from pipeline.plant.chain import Chain


def first_chain(runs: Sequence[GapRun], *, springs: Sequence[bool]) -> Chain:
    """Estimate masses, dampings and springs by modulating functions.

    Without any input the first mass is 1.
    """
    n = len(springs) - 1
    rows = [j for j, there in enumerate(springs) if there]
    rows = rows[:1] if n == 1 else rows
    columns = 2 * n + len(rows)
    equations, sides = zip(*(_equations(run, rows) for run in runs), strict=True)
    A, b = np.concatenate(equations), np.concatenate(sides)
    if not np.any(b):
        # With free decays alone, forces are relative to the first mass.
        A, b = np.vstack([A, np.zeros(columns)]), np.append(b, 0.0)
        first = int(np.argmax(np.abs(A[:, :n]).max(axis=0) > 0.0))  # the first cart that moves
        # The equation m_1 = 1 gets a large weight, because nothing else sets the scale.
        A[-1, first] = b[-1] = 1e3 * float(np.abs(A[:, first]).max())
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0  # a cart that never moves keeps the smallest values
    p = np.linalg.lstsq(A / scale, b, rcond=None)[0] / scale
    m = np.maximum(p[:n], 0.02 * max(1e-12, np.abs(p[:n]).max()))
    k = np.zeros(n + 1)
    k[rows] = np.maximum(p[2 * n :], 1e-3 * max(1e-12, np.abs(p[2 * n :]).max(initial=0.0)))
    diagonal = k[:-1] + k[1:]
    # Every damping ratio is at least 0.002.
    floor = 2 * 0.002 * np.sqrt(m * np.maximum(diagonal, 1e-12))
    return Chain(m=m, c=np.maximum(p[n : 2 * n], floor), k=k)


def _equations(run: GapRun, rows: Sequence[int]) -> tuple[Array, Array]:
    """Return the coefficients and right sides of equations, one per moving cart and window."""
    # Windows of 0.3 s, every 50 ms, for a bench of carts.
    step = max(1, round(0.05 * run.pace / run.record.sample_time))
    width = max(8, round(0.3 * run.pace / run.record.sample_time))
    x, n = run.by_cart(run.y, run.zero), run.zero.size
    columns = 2 * n + len(rows)
    moving = [i for i in run.rows if run.free[i]]
    if run.t.size <= width or not moving:
        return np.zeros((0, columns)), np.zeros(0)

    def windows(signal: Array) -> Array:
        return sliding_window_view(signal, width, axis=-1)[..., :-1:step, :]

    t = windows(run.t)
    span = t[:, -1:] - t[:, :1]
    # Weights of the trapezoidal rule, (windows, width).
    dt = np.diff(t, axis=1, prepend=t[:, :1], append=t[:, -1:])
    rule = 0.5 * (dt[:, 1:] + dt[:, :-1])
    w, w1, w2 = (rule * one for one in bump((t - t[:, :1]) / span, span=span))
    stretch = np.diff(x, axis=0, prepend=0.0, append=0.0)
    # A held input acts during the interval after its sample.
    u = windows(run.input)
    force = 0.5 * (u + np.concatenate([u[:, :1], u[:, :-1]], axis=1))
    A, b = np.zeros((len(moving), len(t), columns)), np.zeros((len(moving), len(t)))
    for equation, right, i in zip(A, b, moving, strict=True):
        equation[:, i] = (w2 * windows(x[i])).sum(1)
        equation[:, n + i] = -(w1 * windows(x[i])).sum(1)
        for at, j in enumerate(rows, start=2 * n):
            if j in (i, i + 1):
                pull = (w * windows(stretch[j])).sum(1)
                equation[:, at] += pull if j == i else -pull
        if i == 0:
            right[:] = (w * force).sum(1)
    size = max(1e-12, float(np.abs(x).max()))
    return A.reshape(-1, columns) / size, b.ravel() / size


def fit_baseline(
    runs: Sequence[GapRun], *, springs: Sequence[bool], start: Chain | None, mapper: Mapper = map
) -> tuple[GapFit, list[GapRun]]:
    """Fit the linear chain; return the fit and the runs with their measured noise.

    Short pieces, each with a start state, are fitted first, from two initial chains: the identified
    one and an independent estimate. From the better result, whole runs are then fitted.
    """
    structure = Structure(springs=tuple(springs))
    # In pieces of 0.6 s, a missing effect does little harm.
    shots = [cut_shots(run, length=0.6) for run in runs]
    starts = [chain for chain in (start,) if chain is not None]
    starts.append(first_chain(runs, springs=springs))
    how = Fitting(mapper=mapper, iterations=15)
    fits = [fit_model(structure.start(chain), shots, how) for chain in starts]
    best = min(fits, key=lambda fit: fit.cost)
    noisy = measure_noise(best, shots, runs)
    return fit_model(best.without_nuisance, noisy, replace(how, iterations=25)), noisy


def measure_noise(fit: GapFit, shots: Sequence[GapRun], runs: Sequence[GapRun]) -> list[GapRun]:
    """Return the runs with measured noise: encoder rounding or high-frequency residual.

    The larger of the two counts for each cart.
    """
    found: dict[int, list[float]] = {}
    resting: dict[int, list[float]] = {}
    for shot, nuisance in zip(shots, fit.nuisance, strict=True):
        model = simulate_run(fit, shot, nuisance)
        for j, row in enumerate(shot.rows):
            for part in (slice(a, b) for a, b in pairwise(shot.shots)):
                # Only a moving encoder shows its noise, because one at rest repeats the same
                # reading.
                moving = np.mean(shot.weight[j, part] ** 2) > 0.9
                side = found if moving else resting
                side.setdefault(row, []).append(high_frequency_noise((shot.y - model)[j, part]))
    out = []
    for run in runs:
        floor = np.array([run.record.encoder_step(row + 1) / np.sqrt(12.0) for row in run.rows])
        measured = np.array([np.median(found.get(row) or resting[row]) for row in run.rows])
        span = np.ptp(run.y, axis=1)
        out.append(replace(run, sigma=np.maximum(np.maximum(floor, measured), 1e-7 * span)))
    return out


def fit_nuisance(fit: GapFit, runs: Sequence[GapRun], mapper: Mapper = map) -> GapFit:
    """Fit only the nuisance parameters of runs to which the model was not fitted."""
    how = Fitting(mapper=mapper, shared=False, iterations=10)
    fresh = tuple(fresh_nuisance(run) for run in runs)
    found = fit_model(replace(fit, nuisance=fresh), runs, how)
    if fit.structure.many_rests and found.chi > fit.chi:
        found = fit_model(restart_runs(found, runs, mapper), runs, how)
    return found
