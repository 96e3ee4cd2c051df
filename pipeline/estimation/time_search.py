"""Search for the chain that follows a set of windows: Gauss-Newton from a regression's result.

For the start, each cart's equation of motion is multiplied by a bump φ and integrated by parts
(`modulating`). The result is

    m_i ∫ x_i φ'' - c_i ∫ x_i φ' + k_i ∫ (x_i - x_{i-1}) φ + k_{i+1} ∫ (x_i - x_{i+1}) φ = ∫ u φ.

Cart 1's equation gives its mass, damping and springs in input units. The equation of each further
cart gives them relative to the spring before it. An encoder zero acts as a constant force in its
record.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.minimise import minimise
from pipeline.estimation.modal_response import find_modes
from pipeline.estimation.modulating import bump, bump_integral
from pipeline.estimation.parametrisation import Parametrisation, even_chain, physical_start
from pipeline.estimation.time_window import FitWindow, Misfit, compare
from pipeline.plant.chain import Chain
from pipeline.results import EXPLAINED
from pipeline.setup import Setup

WIDTHS = (0.15, 0.3, 0.6, 1.2)  # s; a bump should last about one period of the carts
_HOP = 0.25  # distance of bumps over their width; they overlap, so closer bumps add little
_MOST_BUMPS = 400  # bumps in a record; more would only take time
_FEWEST_SAMPLES = 8  # samples in a bump; fewer do not integrate φ'' well
_FEWEST_PERIODS = 2  # periods of the slowest resonance to try, in the longest record
_FEWEST_PER_PERIOD = 8  # samples in a period of the fastest resonance to try
_FREQUENCY_STEP = 1.5  # frequency ratio of successive chains; the fit converges from a third away
_SWING_OVER_GAIN = 1.6  # range of a lightly damped cart after a step, over its static change
_SMALLEST_ZETA = 0.005  # least damping ratio, because noise may make a regressed damping negative


def regress_chain(windows: Sequence[FitWindow], *, bench: Setup, width: float) -> Chain | None:
    """Regress a chain from the windows, with bumps of `width` (s).

    The result is None if some cart's equation cannot be set up, because the cart or a free
    neighbour was not measured. It is also None if the equation gives an impossible value (a
    negative mass or coupling).
    """
    n = bench.n
    m, c, k = np.zeros(n), np.zeros(n), np.zeros(n + 1)
    moments = [_moments(window, n=n, width=width) for window in windows]
    for cart in range(1, n + 1):
        seen = [
            moment
            for window, moment in zip(windows, moments, strict=True)
            if moment is not None and _has_equation(window, cart, n)
        ]
        if not seen:
            return None
        rows, targets = zip(*(_equation(cart, bench, *moment) for moment in seen), strict=True)
        zeros = np.zeros((sum(map(len, rows)), len(rows)))  # a constant force in each record
        ends = np.cumsum([0, *map(len, rows)])
        for column, (first, last) in enumerate(pairwise(ends)):
            zeros[first:last, column] = 1.0
        columns = np.hstack([np.concatenate(rows), zeros])
        scale = np.linalg.norm(columns, axis=0)
        scale[scale == 0] = 1.0
        found = np.linalg.lstsq(columns / scale, np.concatenate(targets), rcond=None)[0] / scale
        unit = 1.0 if cart == 1 else k[cart - 1]
        m[cart - 1], c[cart - 1], k[cart] = unit * found[:3]
        if cart == 1:
            k[0] = found[3]
        if not m[cart - 1] > 0 or (cart < n and not k[cart] > 0):
            return None
    start = physical_start(Chain(m=m, c=c, k=k), bench=bench)
    omega = np.maximum(start.omega_carts, 1 / width)
    return Chain(m=start.m, c=np.maximum(c, 2 * _SMALLEST_ZETA * omega * start.m), k=start.k)


def _has_equation(window: FitWindow, cart: int, n: int) -> bool:
    """Return whether a cart's equation can be set up: it moves, and all forces on it are known."""
    near = {j for j in (cart - 1, cart, cart + 1) if 1 <= j <= n and j in window.free}
    driven = cart > 1 or window.drive_u is not None
    return driven and cart in window.free and near <= set(window.carts)


def _equation(cart: int, bench: Setup, x: Array, force: Array) -> tuple[Array, Array]:
    """Return the columns of m, c and the springs of a cart's equation, and its right side.

    The spring before the cart is a column only for cart 1; otherwise it is the right side. `x` (3,
    n + 2, n_b) holds the moments of walls and carts with φ, φ', φ''; `force` (n_b,) holds the
    moments of the input.
    """
    stretch = x[0, cart] - x[0, cart - 1], x[0, cart] - x[0, cart + 1]
    columns = [x[2, cart], -x[1, cart], stretch[1] * bench.stiff[cart]]
    if cart > 1:
        return np.stack(columns, axis=1), -stretch[0]
    columns.append(stretch[0] * bench.stiff[0])
    return np.stack(columns, axis=1), force


def _moments(window: FitWindow, *, n: int, width: float) -> tuple[Array, Array] | None:
    """Return the moments (3, n + 2, n_b) of the positions with φ, φ', φ'', and (n_b,) of the input.

    φ = (τ (1 - τ))⁴, with τ from 0 to 1 over the bump. Walls, held and unmeasured carts are at
    zero. The result is None if the record is shorter than two bumps, or if a bump holds too few
    samples.
    """
    t, duration = window.t, window.t[-1]
    if duration < 2 * width or t.size * width / duration < _FEWEST_SAMPLES:
        return None
    count = min(int((duration - width) / (_HOP * width)) + 1, _MOST_BUMPS)
    starts = np.linspace(0.0, duration - width, count)
    around = _around(t, starts, width)
    tau = np.clip((t[around] - starts[:, None]) / width, 0.0, 1.0)
    bumps = np.stack(bump(tau, span=width))
    bumps *= np.gradient(t)[around]  # trapezoidal rule, accurate because bumps end smoothly
    x = np.zeros((3, n + 2, count))
    for cart, y in zip(window.carts, window.y, strict=True):
        x[:, cart] = np.einsum("dbi,bi->db", bumps, y[around])
    force = np.zeros(count)
    if window.drive_u is not None:
        around = _around(window.drive_t, starts, width)
        tau = np.clip((window.drive_t[around] - starts[:, None]) / width, 0.0, 1.0)
        # ∫ φ between samples. The input is held between samples, so its moment is exact.
        area = width * bump_integral(tau)
        force = np.sum(window.drive_u[around][:, :-1] * np.diff(area, axis=1), axis=1)
    return x, force


def _around(t: Array, starts: Array, width: float) -> np.ndarray:
    """Return indices (n_b, n_k) of the samples in each bump, and of one sample on either side."""
    first = np.searchsorted(t, starts, side="right") - 1
    last = np.searchsorted(t, starts + width, side="left")
    return np.minimum(first[:, None] + np.arange(np.max(last - first) + 1), t.size - 1)


def even_chains(windows: Sequence[FitWindow], *, bench: Setup) -> list[Chain]:
    """Return chains of equal carts, from slow to fast, with about the static gain of the records.

    They serve for records that a regression cannot use, such as one with an unmeasured cart. Their
    frequencies cover all that the records can show.
    """
    driven = [window for window in windows if window.drive_u is not None]
    # The input may be on from the first sample, so its range includes zero.
    ranges = [np.ptp(np.append(0.0, w.drive_u)) for w in driven if w.drive_u is not None]
    swing = np.median([np.ptp(w.y[0]) / u for w, u in zip(driven, ranges, strict=True)])
    slowest = 2 * np.pi * _FEWEST_PERIODS / max(w.t[-1] for w in driven)
    fastest = 2 * np.pi / (_FEWEST_PER_PERIOD * min(float(np.median(np.diff(w.t))) for w in driven))
    if not swing > 0 or fastest <= slowest or not bench.tied:
        return []  # without a spring to a wall there is no static gain
    ratio = fastest / slowest
    count = int(np.log(ratio) / np.log(_FREQUENCY_STEP)) + 1
    chains = []
    for omega in slowest * ratio ** (np.arange(count + 1) / count):
        values = {"K_1": swing / _SWING_OVER_GAIN, "omega_a": omega}
        chains.append(even_chain(values, bench=bench))
    return chains


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
    def unexplained_share(self) -> float:
        """The share of the motion's power (about its mean) that the chain does not explain."""
        power = sum(
            float(np.sum(((w.y - w.y.mean(axis=1, keepdims=True)) / w.sigma[:, None]) ** 2))
            for w in self.windows
        )
        return self.cost / power if power > 0 else 1.0

    @property
    def follows(self) -> bool:
        """Whether the chain explains the motion down to the noise, or nearly all of it."""
        return self.unexplained_share < FOLLOWED or self.cost < EXPLAINED * self.dof


def evaluate_chain(
    windows: Sequence[FitWindow], parametrisation: Parametrisation, theta: Array
) -> Attempt:
    """Compare the chain of theta with all windows."""
    chain, dp_dtheta = parametrisation.unpack(theta), parametrisation.dp_dtheta(theta)
    modes = {
        free: find_modes(chain, free=free, parametrisation=parametrisation, dp_dtheta=dp_dtheta)
        for free in {window.free for window in windows}
    }
    misfits = [compare(window, modes[window.free]) for window in windows]
    return Attempt(parametrisation=parametrisation, theta=theta, windows=windows, misfits=misfits)


def minimise_from(
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
        triangle = stacked_triangle(evaluate_chain(windows, parametrisation, x).misfits)
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
        evaluate_chain(windows, parametrisation, solution.x),
        converged=solution.status > 0,
        n_evaluations=solution.nfev,
    )


def stacked_triangle(misfits: Sequence[Misfit]) -> Array:
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
    near.sort(key=lambda theta: evaluate_chain(windows, parametrisation, theta).cost)
    even = [parametrisation.pack(chain) for chain in even_chains(windows, bench=bench)]
    best: Attempt | None = None
    tried = comparisons = 0
    cut_short = False
    for theta in (*near, *even):
        if cut_short := comparisons >= most_comparisons:
            break
        found = minimise_from(windows, parametrisation, theta)
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
        best=evaluate_chain(full, parametrisation, best.theta), n_starts=tried, cut_short=cut_short
    )
