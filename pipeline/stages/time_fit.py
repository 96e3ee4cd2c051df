"""Joint fit of one chain to time records: steps, sweeps, decays and closed loops at once.

Output-error fit: the chain is simulated exactly from the measured input, and the simulated
positions are held against the measured ones. Start and encoder zeros of each record enter
linearly and are eliminated, so the search moves the physical parameters alone. It starts from a
linear regression and needs no guess.

Reference: L. Ljung, System Identification, 2nd ed., sections 7.5 and 10.2; for residuals that
are not white section 9.5.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares

from pipeline.errors import DataError
from pipeline.plant.chain import Array, Chain
from pipeline.results import ChainFit, Estimate, Record
from pipeline.stages.chain_parameters import Parametrisation, named_estimates
from pipeline.stages.modal_response import find_modes
from pipeline.stages.residual_colour import long_run_variance, score_covariance
from pipeline.stages.time_start import WIDTHS, even_chains, regress_chain
from pipeline.stages.time_window import Misfit, Window, compare, open_window

# A fit that leaves more than this share of the motion's power unexplained has not found the
# chain (dry friction leaves some 2 %): further starts are tried.
_LOST = 0.1
_NOISE_EXPLAINS = 2.0  # chi² per degree of freedom below which there is nothing more to find
_NEGLIGIBLE = 0.05  # of its standard error: such a damping or wall spring is held at zero
_REST_SIGMAS = 5.0  # how far beyond chance a free start must improve the fit to be kept
_STRUCTURE_VALUES = 20  # independent values of the chain's own error in a record
_DETERMINED = 1e-9  # smallest singular value of the scaled Jacobian over its largest
# A damping or spring that is not there sends its logarithm towards minus infinity: e^-15 of a
# start is nothing, and no step may overflow.
_LOG_REACH = 15.0
_MOST_EVALUATIONS = 60


def fit_records(
    records: Sequence[Record], *, n: int, springs: tuple[bool, ...], start: Chain | None = None
) -> ChainFit:
    """Fit one chain to all records at once.

    Records may differ in length, rate, free and measured carts; held carts drop out of the
    chain. Decays are used from their release on. A closed loop is used with its measured input.

    Parameters
    ----------
    springs : (n + 1,) which springs there are.
    start : tried besides what the records themselves suggest.

    Returns
    -------
    The fit. Its covariance allows for residuals that are not white, such as dry friction leaves;
    `chi_square_per_dof` counts them against the encoder step and the local noise.

    Raises
    ------
    DataError : no record drives cart 1, or the records do not determine a parameter.
    """
    parametrisation = Parametrisation(n=n, springs=springs)
    windows = [open_window(record) for record in records]
    if not any(window.drive_u is not None for window in windows):
        raise DataError("time fit: needs a record that drives cart 1, found none")
    stated = [window.sigma for window in windows]
    found, n_starts = _search(windows, parametrisation, given=start)
    windows = [
        window.weighted(np.maximum(sigma, sigma * np.std(misfit.residual, axis=1)))
        for window, sigma, misfit in zip(windows, stated, found.misfits, strict=True)
    ]
    found = _descend(windows, parametrisation, found.theta)
    windows = [
        window.resting()
        if record.kind != "decay" and _starts_at_rest(found, index, noise=sigma)
        else window
        for index, (window, record, sigma) in enumerate(zip(windows, records, stated, strict=True))
    ]
    found = _descend(windows, parametrisation, found.theta)
    covariance = found.covariance()
    while zero := found.negligible(covariance):
        parametrisation = parametrisation.holding_at_zero(*zero)
        theta = parametrisation.pack(found.chain)
        found = _descend(windows, parametrisation, theta)
        covariance = found.covariance()
    return _result(found, covariance, stated=stated, n_starts=n_starts, records=records)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found:
    """Where a search came to: theta (n_p,), and how its chain misses each window."""

    parametrisation: Parametrisation
    theta: Array
    windows: Sequence[Window]
    misfits: Sequence[Misfit]
    converged: bool

    @property
    def chain(self) -> Chain:
        return self.parametrisation.unpack(self.theta)

    @property
    def cost(self) -> float:
        return float(sum(np.sum(misfit.residual**2) for misfit in self.misfits))

    @property
    def lost(self) -> float:
        """Share of the motion's power (about its mean) that the chain does not explain."""
        power = sum(
            np.sum(((w.y - w.y.mean(axis=1, keepdims=True)) / w.sigma[:, None]) ** 2)
            for w in self.windows
        )
        return self.cost / float(power) if power > 0 else 1.0

    @property
    def dof(self) -> int:
        n_points = sum(window.y.size for window in self.windows)
        return n_points - self.theta.size - sum(misfit.n_local for misfit in self.misfits)

    def covariance(self) -> Array:
        """Return the covariance (n_p, n_p) of the physical parameters.

        Sandwich of the Gauss-Newton Hessian and the scores' long-run covariance, nowhere below
        what white residuals of the same size would give.
        """
        names = self.parametrisation.names
        slopes = [
            m.slopes / self.parametrisation.slopes(self.theta)[:, None, None] for m in self.misfits
        ]
        scale = np.sqrt(sum(np.sum(s**2, axis=(1, 2)) for s in slopes))
        if not np.all(scale > 0):
            raise _undetermined(names[int(np.argmin(scale))])
        slopes = [s / scale[:, None, None] for s in slopes]
        R = np.linalg.qr(np.concatenate([s.reshape(scale.size, -1).T for s in slopes]), mode="r")
        _, singular, Vt = np.linalg.svd(R)
        if singular[-1] < _DETERMINED * singular[0]:
            raise _undetermined(names[int(np.argmax(np.abs(Vt[-1])))])
        whitening = np.linalg.inv(R)  # slopes @ whitening have unit Gram matrix
        meat = sum(
            score_covariance(misfit.residual, np.einsum("pq,pij->qij", whitening, s))
            for misfit, s in zip(self.misfits, slopes, strict=True)
        )
        n_points = sum(window.y.size for window in self.windows)
        values, vectors = np.linalg.eigh(meat * (n_points / self.dof))
        values = np.maximum(values, self.cost / self.dof)
        half = (whitening @ vectors) * np.sqrt(values) / scale[:, None]
        return half @ half.T

    def negligible(self, covariance: Array) -> tuple[str, ...]:
        """Return the dampings and wall springs that the fit has driven to zero."""
        physical = self.parametrisation.physical(self.chain)
        wall = {"k_1", f"k_{self.parametrisation.n + 1}"}
        return tuple(
            name
            for name, value, variance in zip(
                self.parametrisation.names, physical, np.diag(covariance), strict=True
            )
            if (name[0] == "c" or name in wall) and value < _NEGLIGIBLE * np.sqrt(variance)
        )


def _undetermined(name: str) -> DataError:
    return DataError(f"time fit: the records do not determine {name}")


def _search(
    windows: Sequence[Window], parametrisation: Parametrisation, *, given: Chain | None
) -> tuple[_Found, int]:
    """Return the best fit from as many starts as it takes, and their number."""
    springs = parametrisation.springs
    regressed = [regress_chain(windows, springs=springs, width=width) for width in WIDTHS]
    near = [parametrisation.pack(chain) for chain in (given, *regressed) if chain is not None]
    near.sort(key=lambda theta: _look(windows, parametrisation, theta).cost)
    best: _Found | None = None
    tried = 0
    for theta in near:
        best, tried = _better(best, _descend(windows, parametrisation, theta)), tried + 1
        if best.lost < _LOST:
            return best, tried
    # Even chains are far from the truth: the search may end beside it, so all are tried unless
    # one explains the records down to their noise.
    for chain in even_chains(windows, springs=springs):
        theta = parametrisation.pack(chain)
        best, tried = _better(best, _descend(windows, parametrisation, theta)), tried + 1
        if best.cost < _NOISE_EXPLAINS * best.dof:
            break
    if best is None:
        raise DataError("time fit: needs records that show a chain in motion, found no start")
    return best, tried


def _better(best: _Found | None, found: _Found) -> _Found:
    """Return the fit that leaves less."""
    return found if best is None or found.cost < best.cost else best


def _look(windows: Sequence[Window], parametrisation: Parametrisation, theta: Array) -> _Found:
    """Compare the chain of theta with all windows."""
    chain, slopes = parametrisation.unpack(theta), parametrisation.slopes(theta)
    modes = {
        free: find_modes(chain, free=free, parametrisation=parametrisation, slopes=slopes)
        for free in {window.free for window in windows}
    }
    return _Found(
        parametrisation=parametrisation,
        theta=theta,
        windows=windows,
        misfits=[compare(window, modes[window.free]) for window in windows],
        converged=False,
    )


def _descend(windows: Sequence[Window], parametrisation: Parametrisation, theta: Array) -> _Found:
    """Minimise the sum of squared residuals from theta on."""

    @lru_cache(maxsize=2)  # the residual and its Jacobian are asked for one after the other
    def triangle(theta_bytes: bytes) -> Array:
        misfits = _look(windows, parametrisation, np.frombuffer(theta_bytes)).misfits
        return _triangle([_triangle_of(misfit) for misfit in misfits])

    reach = np.where(parametrisation.logarithmic, _LOG_REACH, np.inf)
    lower = np.maximum(parametrisation.bounds[0], theta - reach)
    upper = np.minimum(parametrisation.bounds[1], theta + reach)
    solution = least_squares(
        lambda x: triangle(x.tobytes())[:, -1],
        np.clip(theta, lower, upper),
        jac=lambda x: triangle(x.tobytes())[:, :-1],
        bounds=(lower, upper),
        x_scale="jac",
        max_nfev=_MOST_EVALUATIONS,
    )
    look = _look(windows, parametrisation, solution.x)
    return replace(look, converged=solution.status > 0)


def _triangle_of(misfit: Misfit) -> Array:
    """Return the triangle of one window: see `_triangle`."""
    columns = [*misfit.slopes.reshape(misfit.slopes.shape[0], -1), misfit.residual.reshape(-1)]
    return np.linalg.qr(np.stack(columns, axis=1), mode="r")


def _triangle(parts: Sequence[Array]) -> Array:
    """Return R of the QR decomposition of all slopes and residuals: (n_p + 1, n_p + 1).

    Its columns have the products of the long ones, so a Gauss-Newton search sees the same
    problem with n_p + 1 residuals instead of thousands.
    """
    return np.linalg.qr(np.concatenate(parts), mode="r")


def _starts_at_rest(found: _Found, index: int, *, noise: Array) -> bool:
    """Tell whether a window starts at rest: freeing its start gains no more than chance would.

    The gain is that of the whole fit, to first order, with all parameters following. Residuals
    beyond the `noise` (p,) are the chain's error, of which a record holds few independent values.
    """
    window = found.windows[index]
    resting = window.resting()
    chain, theta = found.chain, found.theta
    modes = find_modes(
        chain,
        free=window.free,
        parametrisation=found.parametrisation,
        slopes=found.parametrisation.slopes(theta),
    )
    misfit = compare(resting, modes)
    parts = [_triangle_of(m) for m in found.misfits]
    parts[index] = _triangle_of(misfit)
    R = _triangle(parts)
    gain = R[-1, -1] ** 2 - found.cost
    residual = found.misfits[index].residual
    structure = np.sum(residual**2) - residual.shape[1] * np.sum((noise / window.sigma) ** 2)
    chance = max(long_run_variance(residual), structure / _STRUCTURE_VALUES)
    freed = found.misfits[index].n_local - misfit.n_local
    return bool(gain <= chance * (freed + _REST_SIGMAS * np.sqrt(2 * freed)))


def _result(
    found: _Found,
    covariance: Array,
    *,
    stated: Sequence[Array],
    n_starts: int,
    records: Sequence[Record],
) -> ChainFit:
    """Collect the fit's outcome, with residuals counted in the stated errors."""
    parametrisation, chain = found.parametrisation, found.chain
    try:
        parameters = named_estimates(
            chain, names=parametrisation.names, covariance=covariance, source="time_fit"
        )
    except DataError:  # several carts and no wall: they have no gains to name
        parameters: dict[str, Estimate] = {}
    standardised = {
        f"{window.id} cart {cart}": residual
        for window, misfit in zip(found.windows, found.misfits, strict=True)
        for cart, residual in zip(window.carts, misfit.residual, strict=True)
    }
    chi_square = sum(
        np.sum((misfit.residual * (window.sigma / sigma)[:, None]) ** 2)
        for window, misfit, sigma in zip(found.windows, found.misfits, stated, strict=True)
    )
    return ChainFit(
        method="time_fit",
        chain=chain,
        names=parametrisation.names,
        covariance=covariance,
        parameters=parameters,
        chi_square_per_dof=float(chi_square / found.dof),
        dof=found.dof,
        n_points=sum(window.y.size for window in found.windows),
        n_starts=n_starts,
        converged=found.converged and found.lost < _LOST,
        message=_message(found, records),
        standardised=standardised,
    )


def _message(found: _Found, records: Sequence[Record]) -> str:
    """Say in a sentence or two how the fit went."""
    said = [f"{len(records)} time records, {100 * (1 - found.lost):.1f} % of the motion explained"]
    if not found.converged:
        said.append("the search did not settle")
    elif found.lost >= _LOST:
        said.append("no chain was found that follows the records")
    if found.parametrisation.zero:
        said.append(f"held at zero, their bound: {', '.join(found.parametrisation.zero)}")
    moving = [
        window.id
        for window, record in zip(found.windows, records, strict=True)
        if record.kind != "decay" and not window.at_rest
    ]
    if moving:
        said.append(f"not at rest at their start: {', '.join(moving)}")
    return "; ".join(said)
