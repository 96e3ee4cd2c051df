"""The carts' springs, where those of the rubric leave the recordings unexplained."""

from collections.abc import Callable

from pipeline.errors import PipelineError
from pipeline.grading.reference import is_explained
from pipeline.results import Analysis
from pipeline.submission import Submission
from pipeline.submission.load import spring_names
from pipeline.workflow import analyse

# Friction and the like remain whatever the springs: of χ², a missing spring leaves many times more.
_BETTER = 10.0


def with_all_springs(
    submission: Submission,
    analysis: Analysis,
    *,
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[Analysis, tuple[str, ...]]:
    """Return the analysis with all springs, and those that are added, where these recordings ask.

    A spring that is not there is fitted as none, so no other set of springs explains more. One
    cart has one stiffness, whatever it stands for.
    """
    fit, springs = analysis.fit, submission.system.springs
    if analysis.carts == 1 or all(springs) or (fit is not None and is_explained(analysis)):
        return analysis, ()
    system = submission.system.model_copy(update={"springs": (True,) * len(springs)})
    try:
        other = analyse(
            submission.model_copy(update={"system": system}), design=False, progress=progress
        )
    except PipelineError:
        return analysis, ()
    if other.fit is None or not (
        is_explained(other)
        or (
            fit is not None
            and fit.method == other.fit.method
            and fit.chi_square_per_dof > _BETTER * other.fit.chi_square_per_dof
        )
    ):
        return analysis, ()
    names = zip(spring_names(analysis.carts), springs, strict=True)
    return other, tuple(name for name, there in names if not there)
