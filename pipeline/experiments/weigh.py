"""The benefit of a proposed experiment, compared with cartlab's own choice."""

from dataclasses import dataclass

from pipeline.experiments.goal import find_goal
from pipeline.experiments.information import Knowledge
from pipeline.experiments.next_recordings import choose_next, why_useless
from pipeline.experiments.plan import Plan, Recording
from pipeline.results import Analysis

# The fit treats the error of each sample as independent, but for a cart that hardly moves the
# rounding error is the same in many samples.
_WHY_WORSE = (
    "the fit would be worse: the rounding errors of encoders do not average out while carts rest, "
    "or move by few counts; try a larger motion, or a shorter run"
)


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """Relative errors: now, after only the proposed recording, and after only the best recording.

    Attributes
    ----------
    words : the error to reduce, such as "the error of zeta_2".
    why : why the proposed recording does not help, or even does harm; empty if it helps.
    """

    words: str
    now: float
    proposed: float
    why: str
    chosen: Recording
    best: float


def weigh(
    analysis: Analysis, proposed: Recording, plan: Plan, *, goal: str, commands: frozenset[str]
) -> Weighed:
    """Compare a recording with the best recording for a goal that the plan's limits allow.

    Raises
    ------
    DataError, ConfigError : see `choose_next`.
    """
    nothing_open = plan.model_copy(update={"recordings": ()})
    found = choose_next(analysis, nothing_open, n=1, goal=goal, commands=commands)
    known = Knowledge.of(analysis)
    error = find_goal(goal, known, feedback=analysis.feedback).of
    why = why_useless(proposed, known, limits=plan.limits)
    after = found.now if why else float(error(known.information + known.of_recording(proposed)))
    if after > 1.01 * found.now:  # 1 % is visible in two digits
        why = _WHY_WORSE
    return Weighed(
        words=found.words,
        now=found.now,
        proposed=after,
        why=why,
        chosen=found.recordings[0],
        best=found.errors[-1],
    )
