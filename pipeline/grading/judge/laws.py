"""The laws that a final table obeys, judged over the box of its rounding.

Two carts have eight transfer-function parameters for seven physical ones, three carts fifteen for
ten: what is left over must agree. A law holds where some corner of the box lies on either side of
it, or on its right side. Everything is evaluated at all corners at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction

import numpy as np

from pipeline.grading.references.tolerance import rounding
from pipeline.grading.rubric import is_damping
from pipeline.names import parameter_names
from pipeline.plant.chain import Array
from pipeline.plant.laws import orders

MOST_WIDENING = 4  # tolerances; a law that then still fails is simply broken
_PER_TOLERANCE = 2  # steps in which the box is widened by one
_RECOMPUTED = {2: ("_1",), 3: ("_1", "_2")}  # carts whose own numbers follow from the others


@dataclass(frozen=True, kw_only=True)
class Law:
    """One law, and how far the box of the rounding must be widened until it holds.

    Attributes
    ----------
    widening : 0: it holds within the rounding; 1: within the tolerances; 2: within twice those.
    """

    name: str
    meaning: str
    widening: Fraction


def judge_laws(
    final: Mapping[str, Decimal], *, n: int, frequency_percent: float, damping_percent: float
) -> list[Law] | None:
    """Judge every law of a final table; None where the table is not complete."""
    names = parameter_names(n)
    if any(name not in final for name in names):
        return None
    half = {name: float(rounding(final[name])) for name in names}
    percent = {
        name: (damping_percent if is_damping(name) else frequency_percent) / 100 for name in names
    }

    def box(step: int) -> dict[str, float]:
        share = step / _PER_TOLERANCE
        return {x: max(half[x], share * percent[x] * abs(float(final[x]))) for x in names}

    results, last = _evaluate(final, box(0), n=n), MOST_WIDENING * _PER_TOLERANCE
    needed = {name: 0 if holds else last for name, (_, holds) in results.items()}
    failing = {name for name, step in needed.items() if step}
    for step in range(1, last) if failing else ():
        wider = _evaluate(final, box(step), n=n)
        met = {name for name in failing if wider[name][1]}
        needed |= dict.fromkeys(met, step)
        failing -= met
        if not failing:
            break
    return [
        Law(name=name, meaning=meaning, widening=Fraction(needed[name], _PER_TOLERANCE))
        for name, (meaning, _) in results.items()
    ]


def _evaluate(
    final: Mapping[str, Decimal], half: Mapping[str, float], *, n: int
) -> dict[str, tuple[str, bool]]:
    """Return (what it means, whether it holds) of every law, over the corners of a box."""
    results: dict[str, tuple[str, bool]] = {}
    value = {name: float(typed) for name, typed in final.items()}
    for name in parameter_names(n):
        results[f"positive.{name}"] = (f"{name} is positive", value[name] > 0)
    for lesser, greater, reason in orders(parameter_names(n)):
        holds = value[lesser] - half[lesser] <= value[greater] + half[greater]
        results[f"order.{lesser}.{greater}"] = (f"{lesser} ≤ {greater} ({reason})", holds)
    if n not in _RECOMPUTED:
        return results
    corner = _corners(value, half, n=n)
    with np.errstate(all="ignore"):
        equal, least, recomputed = (_two_carts if n == 2 else _three_carts)(corner)
        for name, difference in equal.items():
            holds = bool(difference.min() <= 0 <= difference.max())
            results[f"redundancy.{name}"] = ("two routes to one number agree", holds)
        for name, number in least.items():
            what = "the coupling of two carts" if name.startswith("kappa") else name
            results[f"sign.{name}"] = (f"{what} is not negative", bool(number.max() >= 0))
        for name, numbers in recomputed.items():
            real = numbers[np.isfinite(numbers)]  # none where a frequency squared is negative
            low, high = float(np.min(real, initial=np.inf)), float(np.max(real, initial=-np.inf))
            holds = low <= value[name] + half[name] and high >= value[name] - half[name]
            text = f"{name} follows from the transfer functions: {low:.4g} to {high:.4g}"
            results[f"recomputed.{name}"] = (text, holds)
    return results


def _corners(value: Mapping[str, float], half: Mapping[str, float], *, n: int) -> dict[str, Array]:
    """Return the independent parameters at every corner of the box, each (2^p,)."""
    names = [x for x in parameter_names(n) if x[1:] not in _suffixes(n) or x.startswith("K")]
    bits = np.arange(2 ** len(names)) >> np.arange(len(names))[:, None] & 1
    signs = 2.0 * bits - 1.0
    return {name: value[name] + half[name] * side for name, side in zip(names, signs, strict=True)}


def _suffixes(n: int) -> set[str]:
    return {symbol + suffix for symbol in ("mega", "eta") for suffix in _RECOMPUTED[n]}


def _quadratic(corner: Mapping[str, Array], suffix: str) -> tuple[Array, Array]:
    """Return 2 zeta omega and omega²."""
    omega = corner[f"omega_{suffix}"]
    return 2 * corner[f"zeta_{suffix}"] * omega, omega**2


def _multiply(a: list[Array], b: list[Array]) -> list[Array]:
    """Return the product of two polynomials, lowest power first."""
    product = [np.zeros_like(a[0]) for _ in range(len(a) + len(b) - 1)]
    for i, x in enumerate(a):
        for j, y in enumerate(b):
            product[i + j] = product[i + j] + x * y
    return product


_Laws = tuple[dict[str, Array], dict[str, Array], dict[str, Array]]


def _two_carts(p: Mapping[str, Array]) -> _Laws:
    """Return (differences that vanish, numbers that are not negative, recomputed numbers)."""
    one = np.ones_like(p["K_1"])
    (ga, wa), (gb, wb), (g2, w2) = (_quadratic(p, s) for s in ("a", "b", "2"))
    d0, d1, d2, d3, _ = _multiply([wa, ga, one], [wb, gb, one])
    g1 = d3 - g2
    w1 = d2 - w2 - g1 * g2
    kappa = w1 * w2 - d0
    m1 = w2 / (p["K_1"] * d0)
    k2_m2 = p["K_2"] / p["K_1"] * w2
    k2 = m1 * kappa / k2_m2
    m2 = k2 / k2_m2
    return (
        {"R1": g1 * w2 + g2 * w1 - d1},
        {"kappa": kappa, "k_1": m1 * w1 - k2, "k_3": m2 * w2 - k2},
        {"omega_1": np.sqrt(w1), "zeta_1": g1 / (2 * np.sqrt(w1))},
    )


def _three_carts(p: Mapping[str, Array]) -> _Laws:
    """Return (differences that vanish, numbers that are not negative, recomputed numbers)."""
    one = np.ones_like(p["K_1"])
    a, b, c, x, y = (_quadratic(p, s) for s in "abcxy")
    g3, w3 = _quadratic(p, "3")
    ab = _multiply([a[1], a[0], one], [b[1], b[0], one])
    d0, d1, d2, d3, d4, d5, _ = _multiply(ab, [c[1], c[0], one])
    n0, n1, n2, n3, _ = _multiply([x[1], x[0], one], [y[1], y[0], one])
    g2 = n3 - g3
    w2 = n2 - w3 - g2 * g3
    kappa3 = w2 * w3 - n0
    g1 = d5 - n3
    w1 = d4 - n2 - g1 * n3
    kappa2 = (w1 * n0 - d0) / w3
    m1 = n0 / (p["K_1"] * d0)
    k2_m2 = p["K_2"] / p["K_1"] * n0 / w3
    k3_m3 = p["K_3"] / p["K_2"] * w3
    k2 = m1 * kappa2 / k2_m2
    m2 = k2 / k2_m2
    k3 = m2 * kappa3 / k3_m3
    m3 = k3 / k3_m3
    return (
        {
            "R1": g2 * w3 + g3 * w2 - n1,
            "R2": n1 + g1 * n2 + w1 * n3 - d3,
            "R3": n0 + g1 * n1 + w1 * n2 - kappa2 - d2,
            "R4": g1 * n0 + w1 * n1 - kappa2 * g3 - d1,
            "R5": k2_m2 + kappa3 / k3_m3 - w2,
        },
        {"kappa_2": kappa2, "kappa_3": kappa3, "k_1": m1 * w1 - k2, "k_4": m3 * w3 - k3},
        {
            "omega_1": np.sqrt(w1),
            "zeta_1": g1 / (2 * np.sqrt(w1)),
            "omega_2": np.sqrt(w2),
            "zeta_2": g2 / (2 * np.sqrt(w2)),
        },
    )
