"""Joint fit of one chain to time records: steps, sweeps, decays and closed loops at once.

It is an output-error fit: the chain is simulated exactly from the measured input, and simulated
positions are compared with the measured ones. The start and encoder zeros of each record enter
linearly and are eliminated, so the search moves only the physical parameters. It starts from a
linear regression and needs no initial guess.

Reference: L. Ljung, System Identification, 2nd ed., sections 7.5 and 10.2, and section 9.5 for
residuals that are not white.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.noise import long_run_variance, score_covariance
from pipeline.estimation.parametrisation import Parametrisation, critical_damping, named_estimates
from pipeline.estimation.time_search import (
    Attempt,
    evaluate_chain,
    minimise_from,
    search,
    stacked_triangle,
)
from pipeline.estimation.time_window import FitWindow, open_window
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.results import ChainFit, Estimate, Record
from pipeline.setup import Setup

_TOLERANCE = 1e-9  # relative change of the cost; far below one standard error for any record


def fit_records(records: Sequence[Record], *, bench: Setup, start: Chain | None = None) -> ChainFit:
    """Fit one chain to all records at once.

    Records may differ in length, sample rate, and free and measured carts; held carts are removed
    from the chain. Decays are used from their release, and a closed loop with its measured input. A
    record that cannot be used is left out, and the fit's message says so.

    Parameters
    ----------
    bench : the carts and springs of the bench.
    start : a chain to start from, in addition to the starts from the records.

    Returns
    -------
    The fit. Its covariance allows for correlated residuals, for example due to dry friction. But
    `chi_square_per_dof` compares the residuals only with encoder step and local noise.

    Raises
    ------
    DataError : no record drives cart 1, or the records do not determine a parameter.
    """
    parametrisation = Parametrisation(bench=bench)
    windows, remarks = _open(records)
    found = search(windows, parametrisation, given=start)
    attempt, explained = found.best, found.best.follows
    windows = [_informed(attempt, index) for index in range(len(windows))]
    attempt = minimise_from(windows, parametrisation, attempt.theta, tolerance=_TOLERANCE)
    covariance = _covariance(attempt)
    while zero := _negligible(attempt, covariance):
        parametrisation = parametrisation.holding_at_zero(*zero)
        theta = parametrisation.pack(attempt.chain)
        attempt = minimise_from(windows, parametrisation, theta, tolerance=_TOLERANCE)
        covariance = _covariance(attempt)
    if not explained:
        remarks.insert(0, "no chain reproduces the recordings")
    elif found.cut_short:
        remarks.insert(
            0, f"the search ended after {found.n_starts} starts; more might find a better fit"
        )
    elif not attempt.converged:
        remarks.insert(0, "the search did not converge")
    return _result(attempt, explained=explained, n_starts=found.n_starts, remarks=remarks)


def _open(records: Sequence[Record]) -> tuple[list[FitWindow], list[str]]:
    """Return the windows of all usable records, and notes on the records left out."""
    windows, left_out = [], []
    for record in records:
        try:
            windows.append(open_window(record))
        except DataError as error:
            left_out.append(str(error))
    if not any(window.drive_u is not None for window in windows):
        found = f"found none ({'; '.join(left_out)})" if left_out else "found none"
        raise DataError(f"time fit: needs a record that drives cart 1, {found}")
    return windows, [f"left out: {reason}" for reason in left_out]


# ----------------------------------------------------- knowledge from the residuals


def _informed(attempt: Attempt, index: int) -> FitWindow:
    """Return a window with the standard errors and the start condition that its residuals show."""
    window, misfit = attempt.windows[index], attempt.misfits[index]
    at_rest = window.kind != "decay" and _starts_at_rest(attempt, index)
    return window.informed(misfit.residual * window.sigma[:, None], at_rest=at_rest)


def _starts_at_rest(attempt: Attempt, index: int) -> bool:
    """Return whether a free start would improve the fit only by chance.

    The window then counts as starting at rest. The improvement is that of the fit to all windows,
    to first order. Residuals beyond the stated noise are an error of the chain, of which a record
    has few independent values.
    """
    resting = replace(attempt.windows[index], at_rest=True)
    (held,) = evaluate_chain([resting], attempt.parametrisation, attempt.theta).misfits
    others = [misfit for i, misfit in enumerate(attempt.misfits) if i != index]
    misfit = attempt.misfits[index]
    gain = (
        stacked_triangle([*others, held])[-1, -1] ** 2
        - stacked_triangle([*others, misfit])[-1, -1] ** 2
    )
    # A record is assumed to have 20 independent values of the chain's own error.
    structure = (np.sum(misfit.residual**2) - misfit.residual.size) / 20
    chance = max(long_run_variance(misfit.residual), structure)
    freed = misfit.n_nuisance - held.n_nuisance
    # The improvement may exceed the expected one by five standard deviations.
    return bool(gain <= chance * (freed + 5.0 * np.sqrt(2 * freed)))


def _covariance(attempt: Attempt) -> Array:
    """Return the covariance (n_p, n_p) of the free physical parameters.

    It is a sandwich of the Gauss-Newton Hessian and the long-run covariance of the scores. It is at
    least the covariance for white residuals of the same size.

    Raises
    ------
    DataError : the records do not determine a parameter.
    """
    names = attempt.parametrisation.names
    to_physical = attempt.parametrisation.dp_dtheta(attempt.theta)[:, None, None]
    jacobians = [misfit.jacobian / to_physical for misfit in attempt.misfits]
    scale = np.sqrt(sum(np.sum(s**2, axis=(1, 2)) for s in jacobians))
    if not np.all(scale > 0):
        raise _undetermined(names[int(np.argmin(scale))])
    jacobians = [s / scale[:, None, None] for s in jacobians]
    long = np.concatenate([s.reshape(scale.size, -1) for s in jacobians], axis=1)
    R = np.asarray(np.linalg.qr(long.T, mode="r"))
    _, singular, Vt = np.linalg.svd(R)
    # Limit on the smallest singular value of the scaled Jacobian over its largest.
    if singular[-1] < 1e-9 * singular[0]:
        raise _undetermined(names[int(np.argmax(np.abs(Vt[-1])))])
    whitening = np.linalg.inv(R)  # jacobians @ whitening are orthonormal
    scores = np.zeros_like(R)
    for misfit, s in zip(attempt.misfits, jacobians, strict=True):
        white = (whitening.T @ s.reshape(scale.size, -1)).reshape(s.shape)
        scores += score_covariance(misfit.residual, white)
    values, vectors = np.linalg.eigh(scores * (attempt.n_points / attempt.dof))
    values = np.maximum(values, attempt.cost / attempt.dof)
    half = (whitening @ vectors) * np.sqrt(values) / scale[:, None]
    return half @ half.T


def _undetermined(name: str) -> DataError:
    return DataError(f"time fit: the records do not determine {name}")


def _negligible(attempt: Attempt, covariance: Array) -> tuple[str, ...]:
    """Return the wall springs that the fit moved to zero; failing that, such dampings.

    Carts without springs keep their dampings, because a body without forces has no modes.
    """
    parametrisation, chain = attempt.parametrisation, attempt.chain
    share = parametrisation.physical(chain) / np.sqrt(np.diag(covariance))
    # A damping or wall spring below 5 % of its standard error is held at zero.
    gone = [name for name, value in zip(parametrisation.names, share, strict=True) if value < 0.05]
    walls = tuple(name for name in gone if name in ("k_1", f"k_{chain.n + 1}"))
    is_held = chain.k[0] > 0 or chain.k[-1] > 0
    return walls or tuple(name for name in gone if read_name(name).symbol == "c" and is_held)


def _released(attempt: Attempt) -> Attempt:
    """Return the attempt in which dampings that were held at zero are free.

    Every cart has some damping, and numbers that depend on it must not look more certain than it
    is. A spring, however, may really be missing.
    """
    held, chain = attempt.parametrisation, attempt.chain
    springs = tuple(name for name in held.zero if read_name(name).symbol == "k")
    if springs == held.zero:
        return attempt
    free = replace(held, zero=springs)
    # 1e-6 of critical damping: almost zero, but its logarithm has derivatives.
    c = np.where(chain.c > 0, chain.c, 1e-6 * critical_damping(chain))
    return evaluate_chain(attempt.windows, free, free.pack(replace(chain, c=c)))


# ------------------------------------------------------------------- the outcome


def _result(
    attempt: Attempt, *, explained: bool, n_starts: int, remarks: Sequence[str]
) -> ChainFit:
    """Return the fit's result; its χ² compares the residuals with the stated standard errors."""
    parametrisation, chain = attempt.parametrisation, attempt.chain
    released = _released(attempt)
    names, covariance = released.parametrisation.names, _covariance(released)
    try:
        parameters = named_estimates(chain, names=names, covariance=covariance, source="time_fit")
    except DataError:  # several carts without a spring to a wall have no gains
        parameters: dict[str, Estimate] = {}
    chi_square = 0.0
    standardised = {}
    for window, misfit in zip(attempt.windows, attempt.misfits, strict=True):
        residual = misfit.residual * (window.sigma / window.stated_sigma)[:, None]
        chi_square += float(np.sum(residual**2))
        for cart, row in zip(window.carts, residual, strict=True):
            standardised[f"{window.id} cart {cart}"] = row
    return ChainFit(
        method="time_fit",
        chain=chain,
        names=names,
        covariance=covariance,
        at_bound=parametrisation.zero,
        parameters=parameters,
        chi_square_per_dof=chi_square / attempt.dof,
        dof=attempt.dof,
        n_points=attempt.n_points,
        n_starts=n_starts,
        converged=attempt.converged and explained,
        message=_message(attempt, remarks),
        standardised=standardised,
        experiments=tuple(dict.fromkeys(window.id for window in attempt.windows)),
    )


def _message(attempt: Attempt, remarks: Sequence[str]) -> str:
    """Describe how the fit went."""
    count = len(attempt.windows)
    parts = [
        f"{count} time record{'s' * (count > 1)}, "
        f"{100 * (1 - attempt.unexplained_share):.1f} % of the motion explained",
        *remarks,
    ]
    if attempt.parametrisation.zero:
        parts.append(f"held at zero: {', '.join(attempt.parametrisation.zero)}")
    moving = [w.id for w in attempt.windows if w.kind != "decay" and not w.at_rest]
    if moving:
        parts.append(f"in motion at the start: {', '.join(moving)}")
    return "; ".join(parts)
