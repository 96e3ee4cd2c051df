"""The grading in words: `templates/words/grading.toml`, and how points are shown."""

from pipeline.words.phrases import phrases

WORDS = phrases("grading")


def on_one_line(reason: str) -> str:
    """Return reasons, a line each, where there is room for one line alone."""
    return "; ".join(line.rstrip(".") for line in reason.split("\n"))


def points_text(points: float) -> str:
    """Return points to the hundredth, without zeros that say nothing."""
    return f"{points:.2f}".rstrip("0").rstrip(".")
