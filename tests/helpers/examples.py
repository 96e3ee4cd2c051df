"""The shipped examples, analysed once per process for tests that only read results."""

from functools import cache

from pipeline.resources import EXAMPLES
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.workflow import analyse


@cache
def analysed(name: str) -> Analysis:
    """Return the complete analysis of "one-cart", "two-cart" or "three-cart"."""
    return analyse(load_submission(EXAMPLES / name))
