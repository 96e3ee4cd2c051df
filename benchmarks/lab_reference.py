"""Compute the numbers of the one-cart lab from a team's files, with code that a TA might write.

nbgrader and otter-grader get this file together with the assignment (`grading_notebooks.py`). It
uses numpy, scipy and textbook methods: the level of a step, the logarithms of a decay's peaks, a
sine fitted to the end of each dwell, and one cart fitted to the amplitude ratios.
"""

from collections.abc import Callable, Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit

Table = Mapping[str, float]
TOLERANCE = {"K": 0.08, "omega_n": 0.05, "zeta": 0.15}
_DATA = Path("data")
_SEEN = 0.05  # share of the largest amplitude; smaller peaks may come from the encoder


def check(table: str, name: str, reported: Mapping[str, Table], dwells: Table) -> None:
    """Check that a reported number is near the number from the team's recordings."""
    numbers = initial() if table == "initial" else final(tuple(sorted(dwells.items())))
    found, expected = reported[table][name], numbers[name]
    assert abs(found / expected - 1) < TOLERANCE[name], (
        f"{table} {name}: you have {found:.4g}, your recordings give {expected:.4g}"
    )


@cache
def initial() -> dict[str, float]:
    """Return K from the steps, and omega_n (rad/s) and zeta from the decays."""
    gains = [_gain(read(file)) for file in sorted(_DATA.glob("step-*.csv"))]
    swings = np.array([_decrement(read(file)) for file in sorted(_DATA.glob("decay-*.csv"))])
    omega_n, zeta = np.median(swings, axis=0)
    return {"K": float(np.median(gains)), "omega_n": float(omega_n), "zeta": float(zeta)}


@cache
def final(dwells: tuple[tuple[str, float], ...]) -> dict[str, float]:
    """Return the parameters fitted to the dwells, whose frequencies the team states in Hz."""
    omega = 2 * np.pi * np.array([frequency for _, frequency in dwells])
    ratios = [ratio(read(_DATA / file), w) for (file, _), w in zip(dwells, omega, strict=True)]
    start = initial()

    def decibel(omega: NDArray, K: float, omega_n: float, zeta: float) -> NDArray:
        r = omega / omega_n
        return 20 * np.log10(abs(K) / np.abs(1 - r**2 + 2j * zeta * r))

    law: Callable[..., NDArray] = decibel
    found, _ = curve_fit(law, omega, 20 * np.log10(ratios), p0=[*start.values()])
    return dict(zip(start, map(float, np.abs(found)), strict=True))


def read(file: Path) -> NDArray:
    """Return the columns of a recording by their names."""
    return np.genfromtxt(file, delimiter=",", names=True)


def _gain(data: NDArray) -> float:
    on = np.flatnonzero(data["input"] == data["input"][np.argmax(np.abs(data["input"]))])
    before = data["x1"][: on[0]] if on[0] else data["x1"][-1:]
    settled = data["x1"][on[len(on) * 3 // 4] : on[-1]]
    return float((settled.mean() - before.mean()) / data["input"][on[0]])


def _decrement(data: NDArray) -> tuple[float, float]:
    y = data["x1"] - data["x1"][-len(data) // 10 :].mean()
    crossings = np.flatnonzero(np.diff(np.sign(y)) != 0)
    halves = pairwise(crossings)  # before this sample, the hand moves the cart
    peaks = [int(a + np.argmax(np.abs(y[a : b + 1]))) for a, b in halves]
    large = [peak for peak in peaks if abs(y[peak]) > _SEEN * np.abs(y).max()]
    first, last, cycles = large[0], large[-1], (len(large) - 1) / 2
    delta = np.log(abs(y[first] / y[last])) / cycles
    zeta = delta / np.hypot(2 * np.pi, delta)
    omega_d = 2 * np.pi * cycles / (data["time"][last] - data["time"][first])
    return omega_d / np.sqrt(1 - zeta**2), zeta


def ratio(data: NDArray, omega: float) -> float:
    """Return the amplitude of the cart divided by that of the input, at omega in rad/s."""
    half = data[len(data) // 2 :]
    t = half["time"]
    X = np.column_stack([np.sin(omega * t), np.cos(omega * t), np.ones_like(t)])
    fits = [np.linalg.lstsq(X, half[name], rcond=None)[0] for name in ("x1", "input")]
    return float(np.hypot(*fits[0][:2]) / np.hypot(*fits[1][:2]))
