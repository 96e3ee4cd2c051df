"""The grading in words: `templates/words/grading.toml`, and how points are shown."""

from pipeline.words.phrases import phrases

WORDS = phrases("grading")


def on_one_line(reason: str) -> str:
    """Join reasons, one per line, into a single line."""
    return "; ".join(line.rstrip(".") for line in reason.split("\n"))


def points_text(points: float) -> str:
    """Return points with at most two decimals, without trailing zeros."""
    return f"{points:.2f}".rstrip("0").rstrip(".")
