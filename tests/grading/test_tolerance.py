"""Rounding is subtracted before an error is judged, and the limits of a tolerance are exact."""

from decimal import Decimal
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.grading.reference import Reference
from pipeline.grading.tolerance import (
    as_typed,
    credit,
    half_digit,
    percent_off,
    rounding,
)

percents = st.decimals("0", "500", places=2).map(float)


def at(value: float, *, std: float = 0.0) -> Reference:
    return Reference(value=value, low=value, high=value, std=std, source="test")


@pytest.mark.parametrize(
    ("typed", "half"),
    [("0.10", "0.005"), ("29", "0.5"), ("2.90e1", "0.05"), ("-3.5", "0.05"), ("0", "0.5")],
)
def test_rounding_is_half_of_the_last_digit(typed, half):
    """The rounding error of a typed number is half its last digit: 0.005 for 0.10, 0.5 for 29."""
    assert half_digit(Decimal(typed)) == Fraction(half)


@given(full=percents, width=percents)
def test_the_limits_of_a_tolerance_are_exact(full, width):
    """An error of exactly `full` earns all points, and one of exactly `none` earns no points.

    If both limits are equal, an error at the limit earns all points.
    """
    none = float(Decimal(str(full)) + Decimal(str(width)))
    assert credit(Fraction(str(full)), full=full, none=none) == 1
    assert credit(Fraction(str(none)), full=full, none=none) == (0 if none > full else 1)
    just_above = Fraction(str(full)) + Fraction(1, 10**30)
    assert credit(just_above, full=full, none=none) < 1


@given(first=st.fractions(0, 500), second=st.fractions(0, 500), full=percents, width=percents)
def test_credit_never_rises_with_the_error(first, second, full, width):
    """A larger error never earns more than a smaller one, and any credit is between 0 and 1."""
    none = full + width
    small, large = sorted((first, second))
    assert 1 >= credit(small, full=full, none=none) >= credit(large, full=full, none=none) >= 0


@given(
    value=st.floats(1e-3, 1e3),
    steps=st.tuples(st.integers(0, 400), st.integers(0, 400)),
    sign=st.sampled_from([-1, 1]),
)
def test_the_error_grows_with_the_distance(value, steps, sign):
    """On one side of the reference, a number further from it never has a smaller error."""
    near, far = sorted(steps)
    typed = [Decimal(round(value, 4)).quantize(Decimal("0.0001")) for _ in range(2)]
    errors = [
        percent_off(number + sign * Decimal(step) * Decimal("0.001"), at(value), sigmas=0.0)
        for number, step in zip(typed, (near, far), strict=True)
    ]
    assert errors[0] <= errors[1]


@pytest.mark.parametrize(
    ("typed", "value", "std", "error"),
    [
        ("105", 100.0, 0.0, Fraction(9, 2)),  # rounding is subtracted
        ("105", 100.0, 1.0, 100 * (Fraction(209, 2) / 103 - 1)),  # then three standard errors
        ("3e1", 35.0, 0.0, 100 * (Fraction(70, 63) - 1)),  # stands for 28.5 to 31.5
    ],
)
def test_rounding_and_standard_errors_are_subtracted_first(typed, value, std, error):
    """Rounding and then the standard errors are subtracted from the difference.

    A number typed with one digit gets the rounding allowance of one with two digits.
    """
    assert percent_off(Decimal(typed), at(value, std=std), sigmas=3.0) == error


def test_the_sign_of_an_error_does_not_matter_but_that_of_the_number_does():
    """Too small or too large by some factor is the same error; a wrong sign earns nothing."""
    high = percent_off(Decimal("120.0000"), at(100.0), sigmas=0.0)
    low = percent_off(Decimal("83.33333"), at(100.0), sigmas=0.0)
    # The numbers have different digits, which changes the errors by up to 1e-4 percent.
    assert abs(high - low) < Fraction(2, 10**4)
    wrong = percent_off(Decimal("-24.3"), at(24.3), sigmas=3.0)
    assert credit(wrong, full=1000.0, none=1000.0) == 0


@pytest.mark.parametrize("vague", ["0e2", "0", "0.0", "-0.0"])
def test_a_typed_zero_earns_nothing(vague):
    """A typed zero earns nothing, since rounding may excuse only a share of the number."""
    assert rounding(Decimal(vague)) == 0
    assert credit(percent_off(Decimal(vague), at(0.1), sigmas=0.0), full=50.0, none=200.0) == 0


@pytest.mark.parametrize("typed", ["0e2", "25.60", "1e-7", "3e5"])
def test_numbers_are_shown_as_typed(typed):
    """Numbers are shown as the student typed them."""
    assert as_typed(Decimal(typed)) == typed
