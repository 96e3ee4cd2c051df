"""The shipped examples, analysed once per process for tests that only read results."""

from functools import cache

from pipeline.resources import EXAMPLES
from pipeline.results import Analysis
from pipeline.submission import Submission, load_submission
from pipeline.workflow import analyse


def recorded(name: str, *kinds: str) -> Submission:
    """Return an example with only some kinds of its recordings."""
    submission = load_submission(EXAMPLES / name)
    kept = tuple(e for e in submission.experiments if e.kind in kinds)
    return submission.model_copy(update={"experiments": kept})


@cache
def analysed(name: str) -> Analysis:
    """Return the complete analysis of "one-cart", "two-cart" or "three-cart"."""
    return analyse(load_submission(EXAMPLES / name))
