"""Search for the chain that follows a set of windows: Gauss-Newton from a regression's result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.chain.modal_response import find_modes
from pipeline.estimation.chain.parametrisation import Parametrisation
from pipeline.estimation.chain.time_start import WIDTHS, even_chains, regress_chain
from pipeline.estimation.chain.time_window import FitWindow, Misfit, compare
from pipeline.estimation.minimise import minimise
from pipeline.plant.chain import Chain
from pipeline.results import EXPLAINED

# Share of a record's power (about its mean) that a chain may leave unexplained. Carts with dry
# friction leave some 2 %, a wrong chain most of it.
FOLLOWED = 0.1
# Farthest that a logarithm may move from its start. The logarithm of a damping or spring that does
# not exist goes towards minus infinity. e^-15 of the start counts as zero, and no step overflows.
_LOG_REACH = 15.0
# Relative change of the cost at which a search ends. With n samples, 1/n is one standard error.
_SEARCH_TOLERANCE = 1e-6
_MOST_EVALUATIONS = 60
# Largest number of comparisons of a chain with a record, in all starts together, at about 1 ms
# each. With all carts measured, a search takes up to 200. With an unmeasured cart, it takes some
# 3000 to reach the noise. If dry friction or backlash prevents this, all starts together take 5000.
# Without this limit, records that no chain explains could take any number.
_MOST_COMPARISONS = 10_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Attempt:
    """One chain compared with all windows.

    Attributes
    ----------
    theta : the fit vector (n_p,) of `Parametrisation`.
    misfits : the misfit of each window.
    converged : whether the search that led to this chain converged.
    n_evaluations : number of chains that this search compared with the windows.
    """

    parametrisation: Parametrisation
    theta: Array
    windows: Sequence[FitWindow]
    misfits: Sequence[Misfit]
    converged: bool = False
    n_evaluations: int = 1

    @property
    def chain(self) -> Chain:
        """The chain of theta."""
        return self.parametrisation.unpack(self.theta)

    @cached_property
    def cost(self) -> float:
        """The sum of squared standardised residuals."""
        return float(sum(np.sum(misfit.residual**2) for misfit in self.misfits))

    @property
    def n_points(self) -> int:
        """The number of measured positions."""
        return sum(window.y.size for window in self.windows)

    @property
    def dof(self) -> int:
        """Degrees of freedom: positions minus all fitted and nuisance parameters."""
        return self.n_points - self.theta.size - sum(misfit.n_nuisance for misfit in self.misfits)

    @cached_property
    def lost(self) -> float:
        """The share of the motion's power (about its mean) that the chain does not explain."""
        power = sum(
            float(np.sum(((w.y - w.y.mean(axis=1, keepdims=True)) / w.sigma[:, None]) ** 2))
            for w in self.windows
        )
        return self.cost / power if power > 0 else 1.0

    @property
    def follows(self) -> bool:
        """Whether the chain explains the motion down to the noise, or nearly all of it."""
        return self.lost < FOLLOWED or self.cost < EXPLAINED * self.dof


def look(windows: Sequence[FitWindow], parametrisation: Parametrisation, theta: Array) -> Attempt:
    """Compare the chain of theta with all windows."""
    chain, dp_dtheta = parametrisation.unpack(theta), parametrisation.dp_dtheta(theta)
    modes = {
        free: find_modes(chain, free=free, parametrisation=parametrisation, dp_dtheta=dp_dtheta)
        for free in {window.free for window in windows}
    }
    misfits = [compare(window, modes[window.free]) for window in windows]
    return Attempt(parametrisation=parametrisation, theta=theta, windows=windows, misfits=misfits)


def descend(
    windows: Sequence[FitWindow],
    parametrisation: Parametrisation,
    theta: Array,
    *,
    tolerance: float = _SEARCH_TOLERANCE,
) -> Attempt:
    """Minimise the sum of squared residuals, starting from theta, to a relative `tolerance`."""
    reach = np.where(parametrisation.logarithmic, _LOG_REACH, np.inf)
    lower = np.maximum(parametrisation.bounds[0], theta - reach)
    upper = np.minimum(parametrisation.bounds[1], theta + reach)

    def residual_and_jacobian(x: Array) -> tuple[Array, Array]:
        triangle = condense(look(windows, parametrisation, x).misfits)
        return triangle[:, -1], triangle[:, :-1]

    solution = minimise(
        residual_and_jacobian,
        np.clip(theta, lower, upper),
        bounds=(lower, upper),
        scale="jac",
        tolerance=tolerance,
        max_evaluations=_MOST_EVALUATIONS,
    )
    return replace(
        look(windows, parametrisation, solution.x),
        converged=solution.status > 0,
        n_evaluations=solution.nfev,
    )


def condense(misfits: Sequence[Misfit]) -> Array:
    """Condense Jacobians and residuals to (n_p + 1, n_p + 1), the residuals in the last column.

    The result is the triangle of a QR decomposition, with the same products of columns as the full
    matrix. So least squares has the same solution with n_p + 1 rows instead of thousands.
    """
    triangles = np.concatenate([misfit.triangle for misfit in misfits])
    return np.asarray(np.linalg.qr(triangles, mode="r"))


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchOutcome:
    """The result of a search.

    Attributes
    ----------
    best : the attempt with the lowest cost on the whole windows.
    cut_short : whether some starts were not tried although no chain explained the records.
    """

    best: Attempt
    n_starts: int
    cut_short: bool


def search(
    windows: Sequence[FitWindow],
    parametrisation: Parametrisation,
    *,
    given: Chain | None,
    most_comparisons: int = _MOST_COMPARISONS,
) -> SearchOutcome:
    """Return the best chain from several starts; stop early if one explains the records.

    Parameters
    ----------
    given : a chain to start from, or None.
    most_comparisons : limit on the number of comparisons of a chain with a record.

    Raises
    ------
    DataError : the records suggest no start at all.
    """
    bench = parametrisation.bench
    regressed = [regress_chain(windows, bench=bench, width=width) for width in WIDTHS]
    # 700 samples per record are enough for the search to come close.
    full, windows = windows, [window.thinned(700) for window in windows]
    near = [parametrisation.pack(chain) for chain in (given, *regressed) if chain is not None]
    near.sort(key=lambda theta: look(windows, parametrisation, theta).cost)
    even = [parametrisation.pack(chain) for chain in even_chains(windows, bench=bench)]
    best: Attempt | None = None
    tried = comparisons = 0
    cut_short = False
    for theta in (*near, *even):
        if cut_short := comparisons >= most_comparisons:
            break
        found = descend(windows, parametrisation, theta)
        tried, comparisons = tried + 1, comparisons + found.n_evaluations * len(windows)
        best = found if best is None or found.cost < best.cost else best
        # Chains of equal carts are far from the true chain, so a search from them may end at a
        # wrong one. All of them are tried, unless one explains the records down to their noise.
        if best.follows if tried <= len(near) else best.cost < EXPLAINED * best.dof:
            break
    if best is None:
        raise DataError(
            "time fit: needs records that a chain with these springs can follow, found none: "
            "are the springs stated right?"
        )
    return SearchOutcome(
        best=look(full, parametrisation, best.theta), n_starts=tried, cut_short=cut_short
    )
