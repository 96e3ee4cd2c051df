"""Numbers as a report writes them."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.words.numbers import significant, with_error

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻−", "0123456789--")


def read(text: str) -> tuple[float, float]:
    """Return value and standard error as a reader takes them from the text."""
    plain = text.translate(_SUPERSCRIPTS)
    match = re.fullmatch(r"\(?(-?[\d.]+) ± ([\d.]+)\)?(?: × 10(-?\d+))?", plain)
    assert match, text
    scale = 10.0 ** int(match[3] or 0)
    return float(match[1]) * scale, float(match[2]) * scale


@pytest.mark.parametrize(
    ("value", "std", "expected"),
    [
        (24.3041, 0.1234, "24.30 ± 0.12"),
        (24.3041, 0.0996, "24.30 ± 0.10"),  # the error rounds up into the next decade
        (12345.6, 456.0, "12350 ± 460"),
        (3.12812e-4, 1.2e-6, "(3.128 ± 0.012) × 10⁻⁴"),
        (-0.5, 0.25, "−0.50 ± 0.25"),
        (0.0, 1.3e-6, "(0.0 ± 1.3) × 10⁻⁶"),
        (0.001, 2.0, "0.0 ± 2.0"),
        (-0.001, 2.0, "0.0 ± 2.0"),  # no minus zero
        (31.27, None, "31.27"),
        (31.27, 0.0, "31.27"),
        (31.27, math.inf, "31.27"),
        (1 / 3, None, "0.3333"),
        (12.5, 1e-12, "12.500"),  # exact data: the error says nothing
        (0.0338071, 0.0000083, "0.033807 ± 0.000008"),
        (0.0327502, 0.0000020, "0.032750 ± < 0.01 %"),
        (-3.2e-7, 1e-12, "−3.2000 × 10⁻⁷ ± < 0.01 %"),
        (5e6, 1e3, "(5.000 ± 0.001) × 10⁶"),
    ],
)
def test_value_and_error_are_rounded_together(value, std, expected):
    """A value and its error both end at the decimal place of the error's second digit."""
    assert with_error(value, std) == expected


@given(
    st.floats(-1e9, 1e9, allow_nan=False).filter(lambda v: v == 0 or abs(v) > 1e-9),
    st.floats(1e-3, 1e7),
)
def test_rounding_is_small_beside_the_error(value, ratio):
    """Rounding changes a value by at most a twentieth of its error."""
    std = ratio * abs(value) or ratio

    got, got_std = read(with_error(value, std))

    # The error has two digits: its rounding is at most 5 % (0.5 in 10), and the value is rounded at
    # the same place. The 1e-4 is for the rounding of floats.
    assert abs(got - value) <= 0.0501 * std
    assert abs(got_std - std) <= 0.0501 * std


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, "–"),
        (math.nan, "–"),
        (0.0, "0"),
        (9999.6, "10000"),
        (123456.0, "1.235 × 10⁵"),
        (-1.5e-7, "−1.500 × 10⁻⁷"),
        (1.0, "1.000"),
    ],
)
def test_significant_digits(value, expected):
    """A number has four digits, a power of ten if it is very long, a dash if it is missing."""
    assert significant(value) == expected
