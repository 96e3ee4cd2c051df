"""What an experiment that somebody proposes would bring, beside the one that would be chosen."""

from dataclasses import dataclass

from pipeline.experiments.goal import find_goal
from pipeline.experiments.information import Knowledge
from pipeline.experiments.next_recordings import choose_next, tells_nothing
from pipeline.experiments.plan import Plan, Recording
from pipeline.results import Analysis

# The fit takes each sample to err by itself; what an encoder rounds away while a cart hardly moves
# is the same error in many samples.
_WHY_WORSE = (
    "the fit would know it worse, for where carts rest, or move by few counts, what their encoders "
    "round off does not average out; try a larger motion, or a shorter run"
)


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """Errors, relative: now, after the one proposed alone, after the one chosen alone.

    Attributes
    ----------
    words : what they are of, "zeta_2".
    why : the one proposed brings nothing, or harm; "": it does bring something.
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
    """Weigh a recording against the one that serves a goal best within the limits of the plan.

    Raises
    ------
    DataError, ConfigError : see `choose_next`.
    """
    nothing_open = plan.model_copy(update={"recordings": ()})
    found = choose_next(analysis, nothing_open, n=1, goal=goal, commands=commands)
    known = Knowledge.of(analysis)
    error = find_goal(goal, known, feedback=analysis.feedback).of
    why = tells_nothing(proposed, known, limits=plan.limits)
    after = found.now if why else float(error(known.told + known.of_recording(proposed)))
    if after > 1.01 * found.now:  # times the error of now: a difference that shows in two digits
        why = _WHY_WORSE
    return Weighed(
        words=found.words,
        now=found.now,
        proposed=after,
        why=why,
        chosen=found.recordings[0],
        best=found.errors[-1],
    )
