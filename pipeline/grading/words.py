"""Texts of grading (`templates/words/grading.toml`), and points as text."""

from pipeline.words.phrases import phrases

WORDS = phrases("grading")


def on_one_line(reason: str) -> str:
    """Return several reasons, given one per line, as a single line."""
    return "; ".join(line.rstrip(".") for line in reason.split("\n"))


def points_text(points: float) -> str:
    """Return points with at most two decimals, without trailing zeros."""
    return f"{points:.2f}".rstrip("0").rstrip(".")
