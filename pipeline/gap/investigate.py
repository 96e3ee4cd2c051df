"""The gap workflow on the data of a submission."""

from collections.abc import Callable

import numpy as np

from pipeline.gap.explain import explain_gap
from pipeline.gap.types import Gap
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.chain import Chain
from pipeline.plant.effects import AugmentedChain
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
    _compile()
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


def _compile() -> None:
    """Run the simulator once, so that the wait for its compilation is announced."""
    chain = Chain(m=np.ones(1), c=np.ones(1), k=np.array([1.0, 0.0]))
    simulate_augmented(AugmentedChain(chain=chain), np.array([0.0, 0.01]), np.zeros(2))
