"""The shipped examples, analysed once a process for all tests that only look at the results."""

from functools import cache

from pipeline.resources import EXAMPLES
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.workflow import analyse


@cache
def analysed(name: str) -> Analysis:
    """Return what all stages make of "one-cart", "two-cart" or "three-cart"."""
    return analyse(load_submission(EXAMPLES / name))
