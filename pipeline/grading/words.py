"""Texts of grading (`templates/words/grading.toml`), and points as text."""

from collections.abc import Mapping
from typing import Any

from pipeline.grading.grade import Grade
from pipeline.words.numbers import listing
from pipeline.words.phrases import phrases

WORDS = phrases("grading")


def on_one_line(reason: str) -> str:
    """Return several reasons, given one per line, as a single line."""
    return "; ".join(line.rstrip(".") for line in reason.split("\n"))


def waiting_text(grade: Grade) -> str:
    """Return why a submission is not graded yet, and that the next run grades it again."""
    then = WORDS.text("unsettled_then")
    return f"Could not be graded yet: {on_one_line(grade.reason)}. {then}"


def slip_of(evidence: Mapping[str, Any]) -> str:
    """Return the kind of mistake behind a flag, in words; "-" if it is unknown."""
    others = (WORDS.text(f"title_{code}") for code in evidence.get("together_with", ()))
    return evidence.get("slip") or " and ".join(others) or "-"


def points_text(points: float) -> str:
    """Return points with at most two decimals, without trailing zeros."""
    return f"{points:.2f}".rstrip("0").rstrip(".")


def signed_points(points: float) -> str:
    """Return an adjustment as text, with its sign: "+1.5", "−2"."""
    return f"{'+' if points > 0 else '−'}{points_text(abs(points))}"


def person_lines(grade: Grade) -> list[str]:
    """Return the adjustments of a total with their reasons, and what a person has yet to grade."""
    lines = [
        f"Total changed by hand, {signed_points(one.points)} points: {one.why}"
        for one in grade.adjustments
    ]
    if grade.open:
        titles = {criterion.id: criterion.title or criterion.id for criterion in grade.criteria}
        named = listing([titles[id_] for id_ in grade.open])
        lines.append(f"Not final: a person has yet to grade {named}.")
    return lines
