"""Standard errors of a fitted model whose residual is not white.

While a cart rests, its encoder repeats one reading, and friction lets it rest anywhere. All these
readings share one rounding error, which limits how well friction is known. So the covariance is H⁻¹
S H⁻¹, where H is the information of the fit. S is the covariance caused by such encoder errors,
computed from many random draws. Variances are
raised, if necessary, to those of white noise and to those that the residual's correlation implies.

Reference: L. Ljung, System Identification, 2nd ed., section 9.5, for this formula; B. Efron, R. J.
Tibshirani, An Introduction to the Bootstrap, 1993, section 6.5, for the random draws.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.estimation.noise import noise_beyond_rounding, score_covariance
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.levenberg_marquardt import GapFit, Mapper, anchor
from pipeline.gap.fit.linearise import (
    Nuisance,
    columns_of,
    layout_of,
    run_prior,
    simulate_run,
    start_prior,
    usual_sizes,
)

_DRAWS = 60  # random draws of encoder errors; a standard error is then accurate to 9 %
_HIDDEN = 1e-9  # share of the strongest direction; weaker ones count as unknown


def covariance(fit: GapFit, runs: Sequence[GapRun], mapper: Mapper = map) -> GapFit:
    """Return the fit with the covariance of its parameters, or without it if the model diverges.

    If the fit used the same friction for all runs, the standard errors do not include the variation
    of friction.
    """

    def weigh(job: tuple[int, tuple[GapRun, Nuisance]]) -> Array:
        index, (run, nuisance) = job
        # Seeded by the run's index, so that each run has its own draws.
        rng = np.random.default_rng([0, index])
        return _weigh(fit, run, nuisance, rng=rng)

    told = np.sum(list(mapper(weigh, enumerate(zip(runs, fit.nuisance, strict=True)))), axis=0)
    if not np.all(np.isfinite(told)):
        return fit
    held = anchor(runs, fit.theta.size)[:, :-1]
    H, expected, found = told + np.stack([held.T @ held, *np.zeros((2, *told.shape[1:]))])
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    size = np.maximum(size, _HIDDEN * size.max())
    power, directions = np.linalg.eigh(H / np.outer(size, size))
    power = np.maximum(power, _HIDDEN * power[-1])
    inverse = (directions / power) @ directions.T / np.outer(size, size)
    expected, found = inverse @ expected @ inverse, inverse @ found @ inverse
    least = np.maximum(np.diag(found), np.diag(inverse))
    more = np.sqrt(np.maximum(1.0, least / np.maximum(np.diag(expected), _HIDDEN * least)))
    cov = expected * np.outer(more, more)
    # The encoders cause no error in a direction that no run determines; its variance is that of
    # H⁻¹.
    np.fill_diagonal(cov, np.maximum(np.diag(cov), least))
    return replace(fit, covariance=cov)


def _weigh(fit: GapFit, run: GapRun, nuisance: Nuisance, *, rng: np.random.Generator) -> Array:
    """Return H, S from encoder errors, and S from the residual's correlation, each (size, size).

    All of them are NaN if the model diverges at these parameters or next to them.
    """
    thin, inflate = run.thin, fit.inflation
    layout = layout_of(fit.structure, thin, scatter_free=fit.scattered)
    columns = columns_of(fit, thin, nuisance, layout)
    if not np.all(np.isfinite(columns)):
        return np.full((3, fit.theta.size, fit.theta.size), np.nan)
    columns = columns * thin.weight / thin.sigma[:, None]
    starts = len(layout.x0) + len(layout.v0)
    local = starts + len(layout.scatter) + len(layout.zero)
    own = _by_piece(columns[:starts], thin)
    N = np.concatenate([own, columns[starts:local].reshape(local - starts, own.shape[1])]).T
    prior = np.zeros((N.shape[1], N.shape[1]))
    pieces = start_prior(layout, thin, usual_sizes(fit, thin), inflate=inflate)
    for piece, firm in enumerate(pieces):
        at = slice(piece * starts, (piece + 1) * starts)
        prior[at, at] = firm
    wide = 1 + local - starts  # the last column is the residual
    firm = run_prior(layout, thin, nuisance, wide, spread=fit.spread, inflate=inflate)
    prior[len(own) :, len(own) :] = firm[:, :-1]
    J = columns[local:-1].reshape(fit.theta.size, -1).T
    known = np.concatenate([J, np.zeros((len(prior), fit.theta.size))])
    taken = np.linalg.lstsq(np.concatenate([N, prior]), known, rcond=None)[0]
    H = J.T @ (J - N @ taken)
    J = (J - N @ taken).T.reshape(columns[local:-1].shape)
    weight = J * thin.weight / thin.sigma[:, None]
    errors = np.array(list(_errors(fit, run, nuisance, rng=rng)))
    scores = np.tensordot(errors, weight, axes=((1, 2), (1, 2)))
    return np.stack([H, scores.T @ scores / _DRAWS, score_covariance(columns[-1], J)])


def _by_piece(columns: Array, run: GapRun) -> Array:
    """Rearrange columns (starts, rows, samples) to (starts of all pieces, points)."""
    pieces = np.zeros((len(run.shots) - 1, *columns.shape))
    for piece, (first, end) in enumerate(zip(run.shots, run.shots[1:], strict=False)):
        pieces[piece, :, :, first:end] = columns[:, :, first:end]
    return pieces.reshape(-1, columns[0].size)


def _errors(
    fit: GapFit, run: GapRun, nuisance: Nuisance, *, rng: np.random.Generator
) -> Iterator[Array]:
    """Yield random encoder errors (rows, samples) of the fitted motion, averaged as in the fit."""
    x = simulate_run(fit, run, nuisance)
    steps = np.array([run.record.encoder_step(row + 1) for row in run.rows])
    noise = [noise_beyond_rounding(s, step=step) for s, step in zip(run.sigma, steps, strict=True)]
    for _ in range(_DRAWS):
        read = x + np.array(noise)[:, None] * rng.standard_normal(x.shape)
        for row, step in zip(read, steps, strict=True):
            if step > 0:
                phase = rng.uniform(-0.5, 0.5)
                row[:] = step * (np.round(row / step + phase) - phase)
        yield run.thinned(read - x)
