"""The unexplained force on each cart, by position, velocity and input.

The model is restarted from the measurement again and again, and runs freely over a short stretch.
In the later part of each stretch, the curvature of its error shows the missing force. Modulating
functions average this force and suppress the effects of the start and of noise.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.polynomial import chebyshev

from pipeline.arrays import Array
from pipeline.estimation.modulating import window_weights
from pipeline.gap.data.runs import GapRun, cut_shots
from pipeline.gap.fit.linearise import Nuisance, fresh_nuisance, simulate_run
from pipeline.gap.fit.structure import GapModel
from pipeline.gap.types import WindowedResidualForce

_DEGREE = 4  # degree of the polynomial through the model's error in a window


def windowed_residual_forces(
    model: GapModel, runs: Sequence[GapRun], nuisance: Sequence[Nuisance]
) -> tuple[WindowedResidualForce, ...]:
    """Return the unexplained force on each cart of each run, if its neighbours were measured."""
    found = []
    for run, own in zip(runs, nuisance, strict=True):
        best: list[WindowedResidualForce] = []
        # Lengths of the windows in s, for a bench of carts. The shortest with little noise is used.
        for length in (0.05, 0.07, 0.1, 0.15, 0.2):
            forces = _of_run(model, run, own, length=length * run.pace)
            best = [force for force, _ in forces] or best
            # The noise must be less than 0.3 of the force.
            if forces and all(noise < 0.3 * _rms(force.force) for force, noise in forces):
                break
        found += best
    return tuple(found)


def _of_run(
    model: GapModel, run: GapRun, own: Nuisance, *, length: float
) -> list[tuple[WindowedResidualForce, float]]:
    """Return the unexplained force on each cart in windows of `length` s, each with its noise."""
    width = round(length / run.record.sample_time) + 1
    if not 9 <= width <= run.t.size // 3:
        return []
    # A stretch is half a window longer, so that hidden states (a lag, a bent bristle) settle first.
    cut = cut_shots(run, length=(1.0 + 0.5) * length / run.pace)
    cut = replace(cut, zero=np.where(run.free, own.zero, 0.0))
    read = simulate_run(model, cut, replace(fresh_nuisance(cut), scatter=own.scatter))
    first = np.array([end - width for start, end in pairwise(cut.shots) if end - start >= width])
    windows = first[:, None] + np.arange(width)
    w, w1, w2 = window_weights(t := cut.t[windows])
    n, chain = run.zero.size, model.structure.chain(model.theta)
    x, simulated = cut.by_cart(cut.y, own.zero), cut.by_cart(read, own.zero)
    speed = np.gradient(simulated, cut.t, axis=1)
    # A restart is a jump, so the speed at both ends of a stretch is computed from points inside it.
    bounds = np.array(cut.shots)
    for here, ahead in ((bounds[:-1], bounds[:-1] + 1), (bounds[1:] - 1, bounds[1:] - 2)):
        step = simulated[:, ahead] - simulated[:, here]
        speed[:, here] = step / (cut.t[ahead] - cut.t[here])
    off = x - simulated
    out = []
    for j, i in enumerate(run.rows):
        around = {i - 1, i + 1} & {k for k in range(n) if run.free[k]}
        if not run.free[i] or not around <= set(run.rows):
            continue
        own_weight = chain.m[i] * w2 - chain.c[i] * w1 + (chain.k[i] + chain.k[i + 1]) * w
        force = (own_weight * off[i][windows]).sum(1)
        for k, spring in ((i - 1, i), (i + 1, i + 1)):
            if 0 <= k < n:
                force -= chain.k[spring] * (w * off[k][windows]).sum(1)
        # A cart whose motion is within four times the noise is at rest; friction could then balance
        # any force.
        moves = np.ptp(x[i][windows], axis=1) > 4.0 * run.sigma[j]
        if not moves.any():
            continue
        drift, rate = _smooth(t, off[i][windows])
        noise = float(np.median(np.std(off[i][windows] - drift, axis=1)))
        left = WindowedResidualForce(
            experiment=run.id,
            cart=i + 1,
            weight=w[moves],
            t=t[moves],
            x=(simulated[i][windows] + drift)[moves],
            v=(speed[i][windows] + rate)[moves],
            u=(run.input if i == 0 else 0.0 * run.t)[windows[moves]],
            acceleration=(w2 * x[i][windows]).sum(1)[moves],
            force=force[moves],
        )
        out.append((left, noise * float(np.sqrt(np.median((own_weight**2).sum(1))))))
    return out


def _smooth(t: Array, values: Array) -> tuple[Array, Array]:
    """Fit a polynomial to each row of values (windows, samples); return it and its derivative."""
    span = t[:, -1:] - t[:, :1]
    # The samples are evenly spaced, or nearly so, and all windows share one basis.
    s = np.linspace(-1.0, 1.0, t.shape[1])
    basis = chebyshev.chebvander(s, _DEGREE)
    coefficients = np.linalg.lstsq(basis, values.T, rcond=None)[0]
    rate = chebyshev.chebvander(s, _DEGREE - 1) @ chebyshev.chebder(coefficients)
    return (basis @ coefficients).T, rate.T * 2.0 / span


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
