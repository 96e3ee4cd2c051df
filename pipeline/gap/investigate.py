"""The gap workflow on the data of a submission."""

from collections.abc import Callable
from dataclasses import replace

from pipeline.gap.data.sides import drop_left_out
from pipeline.gap.explain import explain_gap
from pipeline.gap.follow.track import compile_follower
from pipeline.gap.types import Gap
from pipeline.plant.nonlinear.augmented import compile_simulator
from pipeline.results import Analysis


def investigate(
    analysis: Analysis, *, progress: Callable[[str], None], budget: float | None = None
) -> Gap:
    """Explain the gap of the time records of a submission, starting from the identified chain.

    Recordings that the identification left out neither train nor judge here, and no figure of the
    gap is about them. Past `budget` s, the compilation apart, the best answer so far is returned.

    Raises
    ------
    DataError : no usable record.
    """
    records, notes = drop_left_out(analysis.records, left_out=analysis.left_out)
    progress("preparing the simulator; once on each machine it is compiled, which takes a while")
    compile_simulator()
    compile_follower()
    gap = explain_gap(
        records,
        springs=analysis.springs,
        chain=analysis.chain,
        position_unit=analysis.position_unit,
        input_unit=analysis.input_unit,
        budget=budget,
        tell=progress,
    )
    return replace(gap, left_out=analysis.left_out, notes=(*notes, *gap.notes))
