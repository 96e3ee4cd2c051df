"""Add springs if those of the rubric cannot explain the recordings."""

import numpy as np

from pipeline.errors import PipelineError
from pipeline.grading.references.reference import is_explained, is_followed
from pipeline.results import Analysis, ChainFit
from pipeline.submission import Submission
from pipeline.submission.load import spring_names
from pipeline.words.progress import Progress, silent
from pipeline.workflow import analyse


def with_all_springs(
    submission: Submission,
    analysis: Analysis,
    *,
    progress: Progress = silent,
) -> tuple[Analysis, tuple[str, ...]]:
    """Return the analysis with all springs, and the names of added springs, if the data need them.

    Otherwise, the analysis is returned unchanged. All springs are tried at once, because a spring
    that does not exist is fitted with zero stiffness. So no other set of springs can explain more.
    On a single cart, nothing is tried, because only the sum of the springs matters.
    """
    fit, springs = analysis.fit, submission.system.springs
    if analysis.bench.n == 1 or all(springs) or (fit is not None and is_explained(analysis)):
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
            # Friction and similar effects increase χ² with any springs. Only a missing spring makes
            # it many times larger.
            fit is not None
            and fit.method == other.fit.method
            and fit.chi_square_per_dof > 10 * other.fit.chi_square_per_dof
            and is_followed(other)
        )
    ):
        return analysis, ()
    names = zip(spring_names(analysis.bench.n), springs, _certain(other.fit), strict=True)
    return other, tuple(name for name, asked, there in names if there and not asked)


def _certain(fit: ChainFit) -> list[bool]:
    """Return for each spring whether it certainly exists, even if the fit is not perfect."""
    wider = max(1.0, fit.chi_square_per_dof) ** 0.5
    std = dict(zip(fit.names, wider * np.sqrt(np.diag(fit.covariance)), strict=True))
    k = fit.chain.k
    # A spring fitted at zero has no standard error. The limits are high (ten standard errors, and a
    # share of the stiffest spring), because a delay or friction looks like a weak spring.
    least = [max(10 * std.get(f"k_{j + 1}", np.inf), 0.02 * k.max()) for j in range(k.size)]
    return [bool(stiffness > limit) for stiffness, limit in zip(k, least, strict=True)]
