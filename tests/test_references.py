"""No number, code, verdict or point of a small sample moves without being accepted."""

import pytest

from tests.references.cases import gap_sample, sample
from tests.references.sample import ACCEPT, moved


def told(lines: list[str]) -> str:
    return (
        f"{len(lines)} facts moved, from the committed value → to the new one:\n"
        + "\n".join(lines)
        + f"\nIf each of these changes is meant: {ACCEPT}"
    )


@pytest.mark.slow
@pytest.mark.sample
def test_reports_solutions_and_grades_say_what_they_said():
    """Reports, a solution and a class with mistakes give the committed facts."""
    assert not (lines := moved(sample)), told(lines)


@pytest.mark.slow
@pytest.mark.sample
def test_a_gap_says_what_it_said():
    """The gap of a cart with an end stop gives the committed facts."""
    assert not (lines := moved(gap_sample)), told(lines)
