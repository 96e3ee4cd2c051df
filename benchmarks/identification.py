"""Noisy dwells of the throne presets, the smallest possible error, and the error of the fit.

Dwells: 20, 25 and 30 frequencies, spaced logarithmically from 0.3 to 7 Hz. The input amplitude
moves the cart that moves most by 1 cm, but is at most 1 V. Errors: 1 % of the amplitude and
0.00115 cm (half an encoder count of 0.00227 cm), added in quadrature. A phase in rad has the same
error as the relative magnitude.

Starts: "paper" has the initial estimates of the paper's Tables 1-3. "Random" draws gains within
20 %, frequencies within 20 % (log-normal sigma 0.1) and dampings from 0.02 to 0.3. "Wide" draws
gains and frequencies from half to double.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.bode_fit import fit_bode
from pipeline.estimation.parametrisation import Parametrisation, named_estimates
from pipeline.plant.chain import Chain
from pipeline.results import ChainFit, FrequencyResponse
from pipeline.setup import Setup

RELATIVE_STD = 0.01
ABSOLUTE_STD = 0.00115  # cm
BAND_HZ = (0.3, 7.0)
POINTS = {1: 20, 2: 25, 3: 30}
LARGEST_MOTION = 1.0  # cm
LARGEST_INPUT = 1.0  # V
RIGHT = 0.02  # a fit is right if every resonance is within this share of its true frequency

PAPER_STARTS = {
    1: {"K": 30.6, "omega_n": 13.2, "zeta": 0.10},
    2: {
        "K_1": 25.6, "K_2": 17.2, "omega_a": 9.4, "omega_b": 37.7, "zeta_a": 0.10,
        "zeta_b": 0.10, "omega_1": 19.4, "omega_2": 32.1, "zeta_1": 0.03, "zeta_2": 0.02,
    },
    3: {
        "K_1": 36.0, "K_2": 28.5, "K_3": 14.0, "omega_a": 6.3, "omega_b": 23.8, "omega_c": 36.6,
        "zeta_a": 0.10, "zeta_b": 0.10, "zeta_c": 0.10, "omega_x": 15.6, "omega_y": 31.4,
        "zeta_x": 0.1, "zeta_y": 0.2, "omega_1": 19.3, "omega_2": 26.2, "omega_3": 25.6,
        "zeta_1": 0.03, "zeta_2": 0.01, "zeta_3": 0.02,
    },
}  # fmt: skip


def dwell_errors(chain: Chain, omega: Array, *, noise: float = 1.0) -> Array:
    """Return the standard error (n, n_w) of each magnitude; all are multiplied by `noise`."""
    size = np.abs(chain.frequency_response(omega))
    amplitude = np.minimum(LARGEST_MOTION / size.max(axis=0), LARGEST_INPUT)
    return noise * np.hypot(RELATIVE_STD * size, ABSOLUTE_STD / amplitude)


def measure(
    chain: Chain, *, rng: np.random.Generator, phases: bool = False, noise: float = 1.0
) -> tuple[FrequencyResponse, ...]:
    """Draw one set of dwells, with errors as in the module's docstring."""
    omega = 2 * np.pi * np.geomspace(*BAND_HZ, POINTS[chain.n])
    G, std = chain.frequency_response(omega), dwell_errors(chain, omega, noise=noise)
    noisy = np.abs(G) + std * rng.standard_normal(G.shape)
    phase = np.angle(G) + std / np.abs(G) * rng.standard_normal(G.shape)
    return tuple(
        FrequencyResponse(
            cart=i + 1,
            omega=omega,
            magnitude=np.maximum(noisy[i], 0.0),
            magnitude_std=std[i],
            phase=phase[i] if phases else None,
            phase_std=std[i] / np.abs(G[i]) if phases else None,
            source="dwells",
        )
        for i in range(chain.n)
    )


def least_possible_std(chain: Chain, *, phases: bool = False, noise: float = 1.0) -> Array:
    """Return the Cramér-Rao bound on each named parameter's error, with all springs free."""
    omega = 2 * np.pi * np.geomspace(*BAND_HZ, POINTS[chain.n])
    weight = 1 / dwell_errors(chain, omega, noise=noise)

    def log_response(of: Chain) -> Array:
        G = np.log(of.frequency_response(omega)).astype(
            np.complex128
        )  # its real part has the relative error, its imaginary part the phase error
        size = np.abs(chain.frequency_response(omega)) * weight
        return np.concatenate([G.real * size, G.imag * size] if phases else [G.real * size])

    return bound(chain, log_response)


def bound(chain: Chain, measured: Callable[[Chain], Array]) -> Array:
    """Return each named parameter's Cramér-Rao bound for measured values with standard error 1."""
    P = Parametrisation(bench=Setup(springs=(True,) * (chain.n + 1)))
    p = P.physical(chain)
    steps = 1e-6 * np.where(p > 0, p, np.max(chain.k))
    columns = []
    for i, step in enumerate(steps):
        e = np.zeros(p.size)
        e[i] = step
        ends = [measured(P.chain(p + sign * e)) for sign in (1, -1)]
        columns.append(((ends[0] - ends[1]) / 2).ravel())
    J = np.stack(columns, axis=1)
    covariance = np.linalg.inv(J.T @ J) * np.outer(steps, steps)
    found = named_estimates(chain, names=P.names, covariance=covariance, source="bound")
    return np.array([estimate.std for estimate in found.values()])


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Coverage and efficiency of each named parameter, and time in ms and chi² of each seed."""

    names: tuple[str, ...]
    coverage: Array
    efficiency: Array
    milliseconds: Array
    chi_square: Array


def quality(chain: Chain, *, seeds: int, phases: bool = False, first_seed: int = 0) -> Quality:
    """Fit many noisy data sets from the paper's start; compare with true values and the bound."""
    truth = np.array(list(chain.parameters().values()))
    values, stds, times, chi = [], [], [], []
    for seed in range(first_seed, first_seed + seeds):
        responses = measure(chain, rng=np.random.default_rng(seed), phases=phases)
        begun = time.perf_counter()
        fit = fit_from(responses, start=PAPER_STARTS[chain.n], n=chain.n)
        times.append(1e3 * (time.perf_counter() - begun))
        values.append([estimate.value for estimate in fit.parameters.values()])
        stds.append([estimate.std for estimate in fit.parameters.values()])
        chi.append(fit.chi_square_per_dof)
    error = np.array(values) - truth
    return Quality(
        names=tuple(chain.parameters()),
        coverage=np.mean(np.abs(error) <= 1.959964 * np.array(stds), axis=0),
        efficiency=least_possible_std(chain, phases=phases) ** 2 / np.mean(error**2, axis=0),
        milliseconds=np.array(times),
        chi_square=np.array(chi),
    )


def fit_from(
    responses: Sequence[FrequencyResponse], *, start: dict[str, float], n: int
) -> ChainFit:
    """Fit with all springs free, as for an unknown bench."""
    return fit_bode(responses, bench=Setup(springs=(True,) * (n + 1)), initial=start)


def drawn_start(chain: Chain, *, rng: np.random.Generator, wide: bool) -> dict[str, float]:
    """Draw a start around the true values, as the module's docstring says."""
    start = {}
    for name, value in chain.parameters().items():
        if name.startswith("zeta"):
            start[name] = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
        elif wide:
            start[name] = value * float(np.exp(rng.uniform(-np.log(2), np.log(2))))
        elif name.startswith("omega"):
            start[name] = value * float(np.exp(0.1 * rng.standard_normal()))
        else:
            start[name] = value * float(rng.uniform(0.8, 1.2))
    return start


def converged_share(chain: Chain, *, kind: str, seeds: int) -> float:
    """Return the share of fits that find all resonances, from starts of one kind."""
    right = 0
    for seed in range(seeds):
        rng = np.random.default_rng(10_000 + seed)
        responses = measure(chain, rng=rng)
        start = PAPER_STARTS[chain.n]
        if kind != "paper":
            start = drawn_start(chain, rng=rng, wide=kind == "wide")
        try:
            right += is_right(fit_from(responses, start=start, n=chain.n), chain)
        except DataError:
            pass
    return right / seeds


def is_right(fit: ChainFit, chain: Chain) -> bool:
    """Return whether every frequency of the fit is within 2 % of its true value."""
    return all(
        abs(fit.parameters[name].value / value - 1) < RIGHT
        for name, value in chain.parameters().items()
        if name in ("omega_n", "omega_a", "omega_b", "omega_c")
    )
