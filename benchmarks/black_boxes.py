"""Other tools that learn a nonlinear model of one cart from records.

Each tool tries the settings in its documentation. Of the models whose free-run error on the
held-out records is nearly the smallest, the one with the fewest terms is kept.
"""

import contextlib
import io
import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from pipeline.arrays import Array

_NEAR = 1.1  # a model within this factor of the least error is preferred if it has fewer terms
_FAR = 1e3  # times the largest motion; a run that gets so far has diverged


@dataclass(frozen=True, kw_only=True)
class Part:
    """One record of one cart at even times, with input and position, both of shape (n,).

    `source` is cartlab's run of the same record, for its own model.
    """

    dt: float
    u: Array
    y: Array
    held: bool = True  # true: the input is held between samples; false: it is band-limited
    first: int = 48  # first sample to judge; earlier samples start a model that has a memory
    source: Any = None


@dataclass(frozen=True, kw_only=True)
class Model:
    """A learnt model: its free run, with one value per `every` samples, and its equation."""

    run: Callable[[Part], Array]
    every: int
    words: str
    terms: tuple[str, ...] = ()


def error(model: Model, parts: Sequence[Part]) -> float:
    """Return the free-run error as a share of the motion; infinite if a run diverges."""
    off = size = 0.0
    for part in parts:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = model.run(part)
        judged = slice(-(-part.first // model.every), None)
        y = part.y[:: model.every][: found.size][judged]  # thinning may leave over a few
        if not np.all(np.abs(found) < _FAR * np.abs(part.y).max()):
            return np.inf
        off += float(np.sum((found[judged] - y) ** 2))
        size += float(np.sum(y**2))
    return float(np.sqrt(off / size))


def best(models: Iterator[Model], parts: Sequence[Part]) -> Model | None:
    """Return the model with the fewest terms among those with nearly the smallest error."""
    tried = [(error(model, parts), model) for model in models]
    least = min((off for off, _ in tried), default=np.inf)
    near = [
        (len(model.terms), off, i) for i, (off, model) in enumerate(tried) if off <= _NEAR * least
    ]
    return tried[min(near)[2]][1] if np.isfinite(least) else None


def _thinned(part: Part, every: int) -> tuple[Array, Array]:
    """Return one position per `every` samples, and the mean input from each to the next."""
    n = part.y.size // every * every
    u = part.u[:n].reshape(-1, every).mean(axis=1) if every > 1 else part.u
    return u, part.y[::every][: u.size]


# -------------------------------------------------------------------------- PySINDy

# Terms of position, velocity and input that an engineer would put into the library, by name.
FEATURES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "1": lambda x, v, u: 1.0 + 0 * x,
    "x": lambda x, v, u: x,
    "v": lambda x, v, u: v,
    "u": lambda x, v, u: u,
    "x²": lambda x, v, u: x**2,
    "x v": lambda x, v, u: x * v,
    "v²": lambda x, v, u: v**2,
    "x³": lambda x, v, u: x**3,
    "x² v": lambda x, v, u: x**2 * v,
    "x v²": lambda x, v, u: x * v**2,
    "v³": lambda x, v, u: v**3,
    "u²": lambda x, v, u: u**2,
    "u v": lambda x, v, u: u * v,
    "u³": lambda x, v, u: u**3,
    "sign v": lambda x, v, u: np.sign(v),
    "v |v|": lambda x, v, u: v * np.abs(v),
    "|u| sign v": lambda x, v, u: np.abs(u) * np.sign(v),
}
LINEAR = ("x", "v", "u")
_SUBSTEPS = 2
_ORDER, _SHARP = 4, 6  # of the finite differences, with and without smoothing
_THRESHOLDS = (0.003, 0.006, 0.01, 0.02, 0.035, 0.06)  # as a share of the acceleration


def sindy(parts: Sequence[Part], *, windows: Sequence[int] = (5, 7, 11, 15)) -> Iterator[Model]:
    """Fit sparse dynamics of position and velocity by PySINDy."""
    ps = import_module("pysindy")
    driven = any(np.any(part.u) for part in parts)
    names = [name for name in FEATURES if driven or "u" not in name]
    for window in windows:
        smooth = (
            ps.FiniteDifference(order=_SHARP)
            if window == 1
            else ps.SmoothedFiniteDifference(
                smoother_kws={"window_length": window, "polyorder": min(3, window - 2)},
                order=_ORDER,
            )
        )
        # The derivative belongs to a sample, so its input is the mean of those held before and
        # after it.
        u = [(part.u + np.roll(part.u, 1)) / 2 if part.held else part.u for part in parts]
        v = [np.asarray(smooth(part.y, part.dt)).ravel() for part in parts]
        states = [np.column_stack([part.y, slope]) for part, slope in zip(parts, v, strict=True)]
        accelerations = [
            np.asarray(smooth(slope, part.dt)).ravel() for part, slope in zip(parts, v, strict=True)
        ]
        size = np.linalg.norm(np.concatenate(accelerations))
        for share in _THRESHOLDS:
            model = ps.SINDy(
                optimizer=ps.STLSQ(threshold=share * size, alpha=1e-8, normalize_columns=True),
                feature_library=ps.CustomLibrary(
                    library_functions=[FEATURES[name] for name in names],
                    function_names=[lambda *_, name=name: name for name in names],
                ),
                differentiation_method=smooth,
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # ignores a threshold that removes all terms
                model.fit(
                    states, t=[part.dt * np.arange(part.y.size) for part in parts],
                    u=[held[:, None] for held in u],
                )  # fmt: skip
            acceleration = np.asarray(model.coefficients())[1]  # because dx/dt = v is known
            yield Model(
                run=_integrated(acceleration, names, smooth),
                every=1,
                words="dv/dt = " + _sum(acceleration, names),
                terms=tuple(name for name, c in zip(names, acceleration, strict=True) if c),
            )


def _integrated(coefficients: Array, names: Sequence[str], smooth: Any) -> Callable[[Part], Array]:
    terms = [(FEATURES[name], c) for name, c in zip(names, coefficients.tolist(), strict=True) if c]

    def slope(x: float, v: float, u: float) -> tuple[float, float]:
        return v, sum(c * of(x, v, u) for of, c in terms)

    def run(part: Part) -> Array:
        x, v = float(part.y[0]), float(np.asarray(smooth(part.y, part.dt)).ravel()[0])
        out, h, far = np.full(part.y.size, np.inf), part.dt / _SUBSTEPS, _FAR * np.abs(part.y).max()
        for k, inputs in enumerate(_between(part).tolist()):
            out[k] = x
            if not abs(x) < far:
                break
            for i in range(0, 2 * _SUBSTEPS, 2):
                now, middle, then = inputs[i : i + 3]
                a = slope(x, v, now)
                b = slope(x + h / 2 * a[0], v + h / 2 * a[1], middle)
                c = slope(x + h / 2 * b[0], v + h / 2 * b[1], middle)
                d = slope(x + h * c[0], v + h * c[1], then)
                x += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
                v += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
        return out

    return run


def _between(part: Part) -> Array:
    """Return the input (n, 2 substeps + 1) from each sample to the next, ends included."""
    shares = np.linspace(0, 1, 2 * _SUBSTEPS + 1)
    if part.held:
        return np.repeat(part.u[:, None], shares.size, axis=1)
    samples = np.arange(part.u.size)
    return CubicSpline(samples, part.u)(samples[:, None] + shares)


def _sum(coefficients: Sequence[float] | Array, names: Sequence[str]) -> str:
    terms = [
        f"{c:+.3g}" + f" {name}" * (name != "1")
        for c, name in zip(coefficients, names, strict=True)
        if c
    ]
    return " ".join(terms).replace(" +", " + ").removeprefix("+").replace(" -", " − ") or "0"


# ----------------------------------------------------------------------- SysIdentPy


def frols(
    parts: Sequence[Part],
    *,
    lags: Sequence[int] = (2, 4, 6),
    degrees: Sequence[int] = (1, 2, 3),
    thinnings: Sequence[int] = (2, 4, 8),
) -> Iterator[Model]:
    """Select the terms of a polynomial NARX with SysIdentPy's FROLS and the Akaike criterion."""
    selection = import_module("sysidentpy.model_structure_selection")
    basis = import_module("sysidentpy.basis_function")
    estimators = import_module("sysidentpy.parameter_estimation")
    display = import_module("sysidentpy.utils.display_results")
    driven = any(np.any(part.u) for part in parts)
    for every, lag, degree in itertools.product(thinnings, lags, degrees):
        thinned = [_thinned(part, every) for part in parts]
        u, y = (np.concatenate(some)[:, None] for some in zip(*thinned, strict=True))
        model = selection.FROLS(
            ylag=lag,
            xlag=lag,
            order_selection=True,
            info_criteria="aic",
            n_info_values=_MOST_TERMS,
            estimator=estimators.LeastSquares(),
            basis_function=basis.Polynomial(degree=degree),
            model_type="NARMAX" if driven else "NAR",
        )
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            try:
                model.fit(X=u if driven else None, y=y)
            except (ValueError, np.linalg.LinAlgError):
                continue  # there are fewer terms than requested

        def run(part: Part, model: Any = model, every: int = every) -> Array:
            u, y = _thinned(part, every)
            whole = model.predict(
                X=u[:, None] if driven else None,
                y=y[: model.max_lag, None],
                forecast_horizon=None if driven else y.size - model.max_lag,
            )
            return whole.ravel()[: y.size]

        terms = display.results(
            model.final_model, model.theta, model.err, model.n_terms,
            err_precision=3, dtype="sci",
        )  # fmt: skip
        yield Model(
            run=run,
            every=every,
            terms=tuple(row[0] for row in terms),
            words="y(k) = " + _sum([float(row[1]) for row in terms], [row[0] for row in terms]),
        )


_MOST_TERMS = 15  # the default


# ------------------------------------------------------------------ a neural network


def network(
    parts: Sequence[Part], *, lags: Sequence[int] = (2, 4, 6), thinnings: Sequence[int] = (1, 2, 4)
) -> Iterator[Model]:
    """Learn the next change of position from past positions and inputs, by scikit-learn's MLP."""
    neural = import_module("sklearn.neural_network")
    for every, lag in itertools.product(thinnings, lags):
        thinned = [_thinned(part, every) for part in parts]
        rows = [_regressors(u, y, lag) for u, y in thinned]
        X = np.concatenate(rows)
        Y = np.concatenate([np.diff(y)[lag - 1 :] for _, y in thinned])
        mean, std, scale = X.mean(axis=0), X.std(axis=0), Y.std()
        std[std == 0] = 1.0
        net = neural.MLPRegressor(
            hidden_layer_sizes=(_NEURONS, _NEURONS),
            activation="tanh",
            solver="lbfgs",
            max_iter=_EPOCHS,
            random_state=0,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ignores that the network has not converged
            net.fit((X - mean) / std, Y / scale)
        layers = list(zip(net.coefs_, net.intercepts_, strict=True))

        def run(
            part: Part,
            layers: Any = layers,
            lag: int = lag,
            every: int = every,
            scaling: tuple[Array, Array, float] = (mean, std, scale),
        ) -> Array:
            u, y = _thinned(part, every)
            mean, std, scale = scaling
            out = y.copy()
            far = _FAR * np.abs(y).max()
            for k in range(lag, y.size):
                z = np.concatenate([out[k - lag : k], u[k - lag : k]])
                z = (z - mean) / std
                for index, (W, b) in enumerate(layers):
                    z = z @ W + b
                    z = np.tanh(z) if index < len(layers) - 1 else z
                out[k] = out[k - 1] + scale * float(z[0])
                if not abs(out[k]) < far:
                    out[k:] = np.inf
                    break
            return out

        weights = sum(W.size + b.size for W, b in layers)
        yield Model(run=run, every=every, words=f"{weights} weights")


def _regressors(u: Array, y: Array, lag: int) -> Array:
    last = [signal[i : signal.size - lag + i] for signal in (y, u) for i in range(lag)]
    return np.column_stack(last)


_NEURONS, _EPOCHS = 8, 2000

# ------------------------------------------------------------------------ jax-sysid


def recurrent(
    parts: Sequence[Part],
    *,
    thinnings: Sequence[int] = (4,),
    lassos: Sequence[float] = (1e-4, 1e-3),
) -> Iterator[Model]:
    """Learn a recurrent network by jax-sysid: group lasso on its states, Adam, then L-BFGS."""
    jax, models = import_module("jax"), import_module("jax_sysid.models")
    jnp = jax.numpy

    def step(x: Any, u: Any, params: Any) -> Any:
        A, B, _, W1, W2, b, W3 = params
        return A @ x + B @ u + W3 @ jnp.tanh(W1 @ x + W2 @ u + b)

    def read(x: Any, u: Any, params: Any) -> Any:
        return params[2] @ x

    def by_state(params: Any, x0: Any) -> Any:
        """Return the group-lasso penalty: the sum of the norms of each state's weights."""
        A, B, C, W1, _, _, W3 = params
        own = jnp.concatenate([A, A.T, B, C.T, W1.T, W3], axis=1)
        return jnp.sum(jnp.sqrt(jnp.sum(own**2, axis=1) + 1e-12))

    for every, lasso in itertools.product(thinnings, lassos):
        thinned = [_thinned(part, every) for part in parts]
        u_size = float(np.std(np.concatenate([u for u, _ in thinned]))) or 1.0
        y_size = float(np.std(np.concatenate([y for _, y in thinned])))
        rng = np.random.default_rng(0)
        model = models.Model(STATES, 1, 1, state_fcn=step, output_fcn=read)
        model.init(
            params=[
                0.5 * np.eye(STATES),
                *(0.1 * rng.standard_normal(size) for size in ((STATES, 1), (1, STATES))),
                *(0.5 * rng.standard_normal((CELLS, width)) for width in (STATES, 1)),
                np.zeros(CELLS),
                0.1 * rng.standard_normal((STATES, CELLS)),
            ]
        )
        model.loss(rho_x0=1e-4, rho_th=1e-4, tau_g=lasso, group_lasso_fcn=by_state)
        model.optimization(adam_epochs=ADAM, lbfgs_epochs=LBFGS, iprint=-1)
        with contextlib.redirect_stdout(io.StringIO()):
            model.fit(
                [y[:, None] / y_size for _, y in thinned],
                [u[:, None] / u_size for u, _ in thinned],
            )
        weights = [np.asarray(array, dtype=float) for array in model.params]

        def run(
            part: Part,
            weights: Sequence[Array] = weights,
            every: int = every,
            scales: tuple[float, float] = (u_size, y_size),
        ) -> Array:
            u, y = _thinned(part, every)
            u, y, known = u / scales[0], y / scales[1], max(STATES, -(-part.first // every))
            near = [
                *weights[2].ravel(),
                1e-2,
            ]  # prefers a small state that explains the first readings

            def off(x0: Array) -> Array:
                return _recurrent(weights, x0, u[:known]) - y[:known]

            start = np.array(near[:-1]) * y[0] / float(np.sum(np.square(near)))
            x0 = least_squares(off, start, x_scale="jac", max_nfev=50).x
            return scales[1] * _recurrent(weights, x0, u)

        left = int(np.sum(np.abs(weights[2]).ravel() > _GONE))
        count = sum(array.size for array in weights)
        yield Model(run=run, every=every, words=f"{count} weights, {left} of {STATES} states read")


def _recurrent(weights: Sequence[Array], x0: Array, u: Array) -> Array:
    """Return the network's free run from a given state."""
    A, B, C, W1, W2, b, W3 = weights
    x, out = x0, np.zeros(u.size)
    drive, push = W2[:, 0], B[:, 0]
    for k, now in enumerate(u.tolist()):
        out[k] = C[0] @ x
        x = np.clip(
            A @ x + push * now + W3 @ np.tanh(W1 @ x + drive * now + b), -_SATURATED, _SATURATED
        )
    return out


STATES, CELLS = 4, 6
ADAM, LBFGS = 1000, 1000  # as in the tool's documentation
_GONE = 1e-3  # below this, the lasso has removed a weight
_SATURATED = 1000.0  # jax-sysid limits states to this size, also during learning
TOOLS: tuple[tuple[str, str, Callable[..., Iterator[Model]]], ...] = (
    ("PySINDy", "pysindy", sindy),
    ("SysIdentPy, FROLS", "sysidentpy", frols),
    ("scikit-learn, MLP NARX", "scikit-learn", network),
    ("jax-sysid, RNN", "jax-sysid", recurrent),
)
