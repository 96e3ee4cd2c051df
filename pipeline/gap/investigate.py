"""The gap workflow on the data of a submission."""

from collections.abc import Callable

from pipeline.gap.explain import explain_gap
from pipeline.gap.follow.track import compile_follower
from pipeline.gap.types import Gap
from pipeline.plant.nonlinear.augmented import compile_simulator
from pipeline.results import Analysis


def investigate(
    analysis: Analysis, *, progress: Callable[[str], None], budget: float | None = None
) -> Gap:
    """Explain the gap of the time records of a submission, starting from the identified chain.

    A record that does not hold what happened is no gap of the model. Past `budget` s, the
    compilation apart, the best answer so far is returned.

    Raises
    ------
    DataError : no usable record.
    """
    progress("preparing the simulator; once on each machine it is compiled, which takes a while")
    compile_simulator()
    compile_follower()
    wrong = {one.experiment for one in analysis.left_out if one.is_wrong}
    return explain_gap(
        [record for record in analysis.records if record.id not in wrong],
        springs=analysis.springs,
        chain=analysis.chain,
        position_unit=analysis.position_unit,
        input_unit=analysis.input_unit,
        budget=budget,
        tell=progress,
    )
