"""The laws that the parameters of a final table must satisfy, as far as rounding can tell.

Two carts have eight transfer-function parameters but seven physical ones, three carts fifteen but
ten. So the extra parameters must agree with the others.

Because of rounding, each number stands for an interval, and the whole table for a box. An
inequality holds if it is true at one corner of the box. An equation holds if its left side is at
least the right side at one corner, and at most the right side at another. All corners are evaluated
at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from pipeline.arrays import Array
from pipeline.grading.mistakes.undo import Number
from pipeline.names import parameter_names, read_name
from pipeline.plant.identities import parameter_orders, recover_from_parameters

MOST_WIDENING = 4  # tolerances; a law that needs this much widening earns no points
_PER_TOLERANCE = 2  # steps of widening per tolerance
_REDUNDANT = (2, 3)  # numbers of carts whose parameters are redundant


@dataclass(frozen=True, kw_only=True)
class ParameterLaw:
    """One law, and how much the box of rounding must be widened for the law to hold.

    Attributes
    ----------
    broken : a sentence that says what disagrees if the law does not hold.
    widening : the least widening for which the law holds, in tolerances; 0 if rounding is enough.
    """

    name: str
    broken: str
    widening: Fraction


def judge_laws(
    final: Mapping[str, Number], *, n: int, frequency_percent: float, damping_percent: float
) -> list[ParameterLaw] | None:
    """Judge every law of a final table; return None if the table is incomplete.

    Parameters
    ----------
    frequency_percent, damping_percent : tolerances that widen the box; the first also applies to
        gains.
    """
    names = parameter_names(n)
    if any(name not in final for name in names):
        return None
    half = {name: float(final[name].rounding) for name in names}
    value = {name: float(final[name].value) for name in names}
    percent = {
        name: (damping_percent if read_name(name).is_damping else frequency_percent) / 100
        for name in names
    }

    def box(step: int) -> dict[str, float]:
        share = step / _PER_TOLERANCE
        return {x: max(half[x], share * percent[x] * abs(value[x])) for x in names}

    results, last = _evaluate(value, box(0), n=n), MOST_WIDENING * _PER_TOLERANCE
    needed = {name: 0 if holds else last for name, (_, holds) in results.items()}
    failing = {name for name, step in needed.items() if step}
    for step in range(1, last) if failing else ():
        wider = _evaluate(value, box(step), n=n)
        met = {name for name in failing if wider[name][1]}
        needed |= dict.fromkeys(met, step)
        failing -= met
        if not failing:
            break
    return [
        ParameterLaw(name=name, broken=broken, widening=Fraction(needed[name], _PER_TOLERANCE))
        for name, (broken, _) in results.items()
    ]


def _evaluate(
    value: Mapping[str, float], half: Mapping[str, float], *, n: int
) -> dict[str, tuple[str, bool]]:
    """Return, for each law, what disagrees if it is broken, and whether it holds in a box.

    Parameters
    ----------
    half : half the width of the box for each parameter.
    """
    results: dict[str, tuple[str, bool]] = {}
    for name in parameter_names(n):
        results[f"positive.{name}"] = (f"{name} is not positive", value[name] > 0)
    for lesser, greater, reason in parameter_orders(parameter_names(n)):
        holds = value[lesser] - half[lesser] <= value[greater] + half[greater]
        said = (
            f"{lesser} = {value[lesser]:.4g} is above {greater} = {value[greater]:.4g} ({reason})"
        )
        results[f"order.{lesser}.{greater}"] = (said, holds)
    if n not in _REDUNDANT:
        return results
    with np.errstate(all="ignore"):
        found = recover_from_parameters(_corners(value, half, n=n))
        for name, (one, other) in found.routes.items():
            holds = bool((one - other).min() <= 0 <= (one - other).max())
            said = (
                "two ways through the transfer functions to one number give "
                f"{_range(one)} and {_range(other)}"
            )
            results[f"redundancy.{name}"] = (said, holds)
        kappas = {"kappa" if n == 2 else f"kappa_{i}": x for i, x in enumerate(found.couplings, 2)}
        for name, number in {**kappas, "k_1": found.k[0], f"k_{n + 1}": found.k[n]}.items():
            what = "the coupling of two carts" if name in kappas else name
            said = f"the table gives a negative value for {what}"
            results[f"sign.{name}"] = (said, bool(number.max() >= 0))
        for cart in range(1, n):
            omega = np.sqrt(found.stiffness_terms[cart - 1])
            zeta = found.damping_terms[cart - 1] / (2 * omega)
            for name, numbers in ((f"omega_{cart}", omega), (f"zeta_{cart}", zeta)):
                real = numbers[np.isfinite(numbers)]  # omega² may be negative at some corners
                low = float(np.min(real, initial=np.inf))
                high = float(np.max(real, initial=-np.inf))
                holds = low <= value[name] + half[name] and high >= value[name] - half[name]
                text = (
                    f"{name} is {value[name]:.4g}, but the other numbers of this table give "
                    f"{low:.4g} to {high:.4g}"
                )
                results[f"recomputed.{name}"] = (text, holds)
    return results


def _range(numbers: Array) -> str:
    low, high = f"{np.min(numbers):.4g}", f"{np.max(numbers):.4g}"
    return low if low == high else f"{low} to {high}"


def _corners(value: Mapping[str, float], half: Mapping[str, float], *, n: int) -> dict[str, Array]:
    """Return the p independent parameters at every corner of the box, each with shape (2^p,)."""
    own = [f"{symbol}_{cart}" for symbol in ("omega", "zeta") for cart in range(1, n)]
    names = [name for name in parameter_names(n) if name not in own]
    bits = np.arange(2 ** len(names)) >> np.arange(len(names))[:, None] & 1
    signs = 2.0 * bits - 1.0
    return {name: value[name] + half[name] * side for name, side in zip(names, signs, strict=True)}
