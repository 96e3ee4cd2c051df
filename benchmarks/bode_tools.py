"""Find the resonances of a chain with other tools, each used as its documentation shows.

`DWELL_TOOLS` use dwells. Some of them fit the paper's rational functions: a common denominator,
K_i, and the zeros of cart i, as factors 1 + 2 ζ s/ω + (s/ω)². `RECORD_TOOLS` use time records.
"""

import contextlib
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

import numpy as np
from scipy.optimize import curve_fit, minimize

from benchmarks.identification import PAPER_STARTS
from pipeline.arrays import Array, ComplexArray
from pipeline.results import FrequencyResponse, Record

_TINY = 1e-9  # keeps a logarithm finite


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Resonances in ascending order, and static gains by cart; a modal analysis gives no gains."""

    omega: Array
    zeta: Array
    gains: Array | None


def modes_of(poles: ComplexArray, *, n: int, gains: Array | None) -> Modes:
    """Return the n oscillating modes of lowest frequency among these poles.

    Raises
    ------
    ArithmeticError : if fewer than n modes oscillate.
    """
    upper = poles[np.imag(poles) > 0]
    if upper.size < n:
        raise ArithmeticError(f"{n} modes needed, {upper.size} poles oscillate")
    upper = upper[np.argsort(np.abs(upper))][:n]
    return Modes(omega=np.abs(upper), zeta=-upper.real / np.abs(upper), gains=gains)


# ------------------------------------------------------- rational functions to dwells


def factors(n: int) -> list[tuple[str, ...]]:
    """Return the names of the factors, first of the denominator, then of each numerator."""
    of_carts = {1: ("",), 2: ("2", ""), 3: ("xy", "3", "")}[n]
    return [("n",) if n == 1 else tuple("abc"[:n]), *(tuple(cart) for cart in of_carts)]


def start_of(n: int) -> Array:
    """Return the paper's initial values as a vector: gains, then ω and ζ of each factor."""
    named = {**PAPER_STARTS[n], **({"zeta_n": PAPER_STARTS[n]["zeta"]} if n == 1 else {})}
    gains = [named["K"]] if n == 1 else [named[f"K_{i + 1}"] for i in range(n)]
    pairs = [
        named[f"{kind}_{key}"] for keys in factors(n) for key in keys for kind in ("omega", "zeta")
    ]
    return np.array([*gains, *pairs])


def rational(p: Array, omega: Array, *, n: int) -> ComplexArray:
    """Return the responses (n, n_w) for a vector of parameters."""
    s, at = 1j * omega, n
    products = []
    for keys in factors(n):
        product = np.ones(omega.size, dtype=np.complex128)
        for _ in keys:
            product = product * (1 + 2 * p[at + 1] * s / p[at] + (s / p[at]) ** 2)
            at += 2
        products.append(product)
    return p[:n, None] * np.array(products[1:]) / products[0]


def _modes_of_vector(p: Array, *, n: int, phases: bool) -> Modes:
    omega, zeta = np.abs(p[n : 3 * n : 2]), p[n + 1 : 3 * n : 2] * np.sign(p[n : 3 * n : 2])
    order = np.argsort(omega)
    # Magnitudes do not show the sign of a damping, but users know that dampings are positive.
    return Modes(omega=omega[order], zeta=(zeta if phases else np.abs(zeta))[order], gains=p[:n])


@dataclass(frozen=True, kw_only=True)
class Dwells:
    """Measured responses (n, n_w) and the standard error of each."""

    omega: Array
    G: ComplexArray
    std: Array
    phases: bool

    @classmethod
    def of(cls, responses: Sequence[FrequencyResponse]) -> "Dwells":
        """Return the responses that cartlab fits, in this form."""
        turns = [np.exp(1j * (0.0 if r.phase is None else r.phase)) for r in responses]
        return cls(
            omega=responses[0].omega,
            G=np.array(
                [r.magnitude * turn for r, turn in zip(responses, turns, strict=True)],
                dtype=complex,
            ),
            std=np.array([r.magnitude_std for r in responses]),
            phases=responses[0].phase is not None,
        )

    def parts(self, G: ComplexArray, *, log: bool = False) -> Array:
        """Return the numbers to fit: magnitudes, or real and imaginary parts; `log` takes logs."""
        if log:
            G = np.array(np.log(np.abs(G) + _TINY) + 1j * np.angle(G), dtype=complex)
        elif not self.phases:
            G = np.abs(G) + 0j
        return np.concatenate([G.real, G.imag]) if self.phases else G.real


def nelder_mead(dwells: Dwells, *, log: bool) -> Modes:
    """Minimise the sum of squares as the paper's students do with `fminsearch`."""
    n, measured = len(dwells.G), dwells.parts(dwells.G, log=log)

    def misfit(p: Array) -> float:
        off = dwells.parts(rational(p, dwells.omega, n=n), log=log) - measured
        if log and dwells.phases:
            off[n:] = np.angle(np.exp(1j * off[n:]))
        return float(np.sum(off**2))

    # These options are the defaults of both programs: xatol, fatol, 200 evaluations per parameter,
    # and a simplex of 5 %.
    return _modes_of_vector(
        minimize(misfit, start_of(n), method="Nelder-Mead").x, n=n, phases=dwells.phases
    )


def curve_fitted(dwells: Dwells) -> Modes:
    """Minimise weighted squares by `scipy.optimize.curve_fit`."""
    n = len(dwells.G)
    std = np.concatenate([dwells.std] * (2 if dwells.phases else 1)).ravel()

    def model(omega: Array, *p: float) -> Array:
        return dwells.parts(rational(np.array(p), omega, n=n)).ravel()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ignores that the covariance could not be estimated
        p, _ = curve_fit(
            model,
            dwells.omega,
            dwells.parts(dwells.G).ravel(),
            p0=start_of(n),
            sigma=std,
            absolute_sigma=True,
        )
    return _modes_of_vector(p, n=n, phases=dwells.phases)


def vector_fitted(dwells: Dwells) -> Modes:
    """Fit common poles by scikit-rf, which takes the responses as parameters of a network."""
    skrf = import_module("skrf")
    fitting = import_module("skrf.vectorFitting")
    n, ports = len(dwells.G), 1 if len(dwells.G) == 1 else 2
    scale = np.abs(dwells.G).max()
    S = np.zeros((dwells.omega.size, ports, ports), dtype=np.complex128)
    cells = [divmod(i, ports) for i in range(n)]
    for (row, column), G in zip(cells, dwells.G, strict=True):
        S[:, row, column] = G / scale
    hertz = dwells.omega / (2 * np.pi)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # ignores passivity, which does not matter here
        fit = fitting.VectorFitting(skrf.Network(f=hertz, f_unit="hz", s=S, z0=50))
        fit.vector_fit(
            n_poles_real=0,
            n_poles_cmplx=n,
            init_pole_spacing="log",
            fit_constant=False,
            fit_proportional=False,
            enforce_dc=False,
        )
        at_rest = [fit.get_model_response(i, j, freqs=np.array([0.0]))[0].real for i, j in cells]
    return modes_of(np.asarray(fit.poles), n=n, gains=scale * np.array(at_rest))


CURVE_FIT = "scipy curve_fit"
DWELL_TOOLS: tuple[tuple[str, str, bool, Callable[[Dwells], Modes]], ...] = (
    # name, distribution, whether it needs phases, function
    ("Nelder–Mead, linear", "scipy", False, lambda d: nelder_mead(d, log=False)),
    ("Nelder–Mead, logarithms", "scipy", False, lambda d: nelder_mead(d, log=True)),
    (CURVE_FIT, "scipy", False, curve_fitted),
    ("scikit-rf vector fitting", "scikit-rf", True, vector_fitted),
)


# ------------------------------------------------------------------ fits to time records


def subspace(record: Record) -> Modes:
    """Identify a state model of the true order by SIPPY's N4SID, with signals scaled to one."""
    with contextlib.redirect_stdout(io.StringIO()):
        sippy = import_module("sippy_unipi")
        assert record.u is not None
        u_std, y_std = record.u.std(), record.y.std(axis=1, keepdims=True)
        found = sippy.system_identification(
            record.y / y_std,
            record.u[None] / u_std,
            "N4SID",
            SS_fixed_order=2 * len(record.y),
            SS_f=_HORIZON,
            SS_p=_HORIZON,
            tsample=record.sample_time,
        )
    return _of_state_model(found, record, scale=(y_std / u_std).ravel())


def realised(record: Record) -> Modes:
    """Estimate Markov parameters and realise them (ERA), both by python-control."""
    control = import_module("control")
    assert record.u is not None
    markov = control.markov(record.y, record.u[None], _MARKOV, dt=record.sample_time)
    order = 2 * len(record.y)
    model, _ = control.eigensys_realization(markov, order, dt=record.sample_time)
    return _of_state_model(model, record, scale=np.ones(len(record.y)))


def _of_state_model(model: object, record: Record, *, scale: Array) -> Modes:
    A, B, C, D = (np.asarray(getattr(model, name)) for name in "ABCD")
    discrete = np.linalg.eigvals(A).astype(np.complex128)
    poles = np.array(np.log(discrete), dtype=np.complex128)
    gains = (C @ np.linalg.solve(np.eye(len(A)) - A, B) + D).ravel() * scale
    return modes_of(poles / record.sample_time, n=len(record.y), gains=gains)


def modal(record: Record, *, method: str) -> Modes:
    """Analyse the frequency responses of a periodic record by sdypy-EMA.

    Frequencies are multiplied by 100, because the windows in which the tool gathers poles suit
    structures of hundreds of Hz.
    """
    ema = import_module("sdypy.EMA")
    n = len(record.y)
    hertz, G = responses_of(record)
    start = start_of(n)[n : 3 * n : 2] / (2 * np.pi)
    with contextlib.redirect_stderr(io.StringIO()):
        found = ema.Model(
            frf=G,
            freq=_HUNDREDFOLD * hertz,
            lower=_HUNDREDFOLD * MODAL_BAND[0],
            upper=_HUNDREDFOLD * MODAL_BAND[1],
            pol_order_high=_ORDERS[method],
            frf_form="receptance",
        )
        found.get_poles(method=method, show_progress=False)
        found.select_closest_poles(list(_HUNDREDFOLD * start))
    omega = 2 * np.pi * np.asarray(found.nat_freq) / _HUNDREDFOLD
    order = np.argsort(omega)
    return Modes(omega=omega[order], zeta=np.asarray(found.nat_xi)[order], gains=None)


def responses_of(record: Record) -> tuple[Array, ComplexArray]:
    """Return frequencies (Hz) and X_i/U (n, n_w).

    The first period is left out, and the effect of the hold is divided out.
    """
    period = round(PERIOD / record.sample_time)
    assert record.u is not None
    U, Y = (
        np.fft.rfft(v[..., period:].reshape(*v.shape[:-1], -1, period)).sum(axis=-2)
        for v in (record.u, record.y)
    )
    hertz = np.fft.rfftfreq(period, record.sample_time).astype(np.float64)
    hold = np.sinc(hertz * record.sample_time) * np.exp(-1j * np.pi * hertz * record.sample_time)
    G = np.zeros(Y.shape, dtype=np.complex128)
    G[:, 1:-1] = Y[:, 1:-1] / U[1:-1] / hold[1:-1]  # without mean and Nyquist
    return hertz, G


PERIOD = 10.0  # period of the multisine in s
MODAL_BAND = (0.3, 8.0)  # Hz
_HORIZON, _MARKOV = 40, 400
_ORDERS = {"lscf": 40, "rfp": 20}
_HUNDREDFOLD = 100.0
RECORD_TOOLS: tuple[tuple[str, str, Callable[[Record], Modes]], ...] = (
    ("SIPPY, N4SID", "sippy_unipi", subspace),
    ("python-control, Markov and ERA", "control", realised),
    ("sdypy-EMA, LSCF", "sdypy-EMA", lambda r: modal(r, method="lscf")),
    ("sdypy-EMA, rational fractions", "sdypy-EMA", lambda r: modal(r, method="rfp")),
)
