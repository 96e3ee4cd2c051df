"""The report of honest students: a slightly wrong model, with rounded numbers."""

import math
from collections.abc import Sequence

import numpy as np

from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.results import FeedbackDesign
from pipeline.submission.toml_file import Value
from pipeline.submission.toml_section import TypedNumber

# Typical errors of a fit to some twenty dwells, as relative standard deviations.
_FIT_ERROR_SPRING_OR_MASS = 0.005
# Typical error of initial estimates that are read from plots of steps and decays.
_HAND_ERROR = 0.007
_GUESSED_ZETA = TypedNumber(
    "0.10"
)  # the paper: "we usually use the initial estimate that both are approximately 0.1"


def believed_chain(chain: Chain, rng: np.random.Generator) -> Chain:
    """Return the chain that the students have identified."""

    def off(values: np.ndarray, spread: float) -> np.ndarray:
        return values * (1 + spread * np.clip(rng.standard_normal(values.size), -2, 2))

    return Chain(
        m=off(chain.m, _FIT_ERROR_SPRING_OR_MASS),
        c=off(chain.c, 0.04),
        k=off(chain.k, _FIT_ERROR_SPRING_OR_MASS),
    )


def initial_estimates(
    chain: Chain, *, dwells_hz: Sequence[float], rng: np.random.Generator
) -> dict[str, Value]:
    """Return the students' initial estimates of every named parameter.

    Gains come from the steps. The carts' own frequencies and dampings come from their decays.
    Resonances and nulls are at the nearest dwell, and their dampings are guessed.
    """
    typed: dict[str, Value] = {}
    for name, value in chain.parameters().items():
        read = read_name(name)
        error = float(np.clip(rng.standard_normal(), -2, 2))
        if read.is_by_eye and chain.n > 1:
            nearest = min((2 * math.pi * f for f in dwells_hz), key=lambda w: abs(w - value))
            typed[name] = _GUESSED_ZETA if read.is_ratio else _significant(nearest)
        else:
            spread = 0.08 if read.is_ratio else _HAND_ERROR
            typed[name] = _significant(value * (1 + spread * error))
    return typed


def final_estimates(believed: Chain) -> dict[str, Value]:
    """Return the students' fitted parameters, consistent because they come from one chain."""
    return {name: _significant(value) for name, value in believed.parameters().items()}


def state_space(believed: Chain) -> dict[str, Value]:
    """Return A (2n, 2n) and B (2n,) as the students report them."""
    A, B, _, _ = believed.state_space()
    return {
        "A": [[_significant(a, 4) for a in row] for row in A],
        "B": [_significant(b, 4) for b in B[:, 0]],
    }


def feedback(design: FeedbackDesign) -> dict[str, Value]:
    """Return the controller and its simulated results as the students report them."""
    typed: dict[str, Value] = {
        "gains": [_significant(gain, 4) for gain in design.gains],
        "prefilter": _significant(design.prefilter, 4),
        "overshoot_percent": TypedNumber(f"{design.overshoot_percent:.1f}"),
    }
    if design.settling_time is not None:
        typed["settling_time"] = TypedNumber(f"{design.settling_time:.2f}")
    return typed


def _significant(value: float, digits: int = 3) -> TypedNumber:
    """Return the number rounded to significant digits, with trailing zeros."""
    exact = value in (0.0, 1.0)  # entries of a state matrix that are exact
    return TypedNumber(f"{value:g}" if exact else f"{value:#.{digits}g}".removesuffix("."))
