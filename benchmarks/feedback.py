"""How good the designed controllers are, also on a plant that differs slightly from the model."""

from typing import Literal

import numpy as np

from benchmarks.page import Table, significant
from pipeline.estimation.state_feedback import design_feedback
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.sampled_loop import StateFeedback, loop_matrix, simulate_loop
from pipeline.plant.simulate import overshoot_percent, settling_time
from pipeline.results import FeedbackDesign
from pipeline.submission import Design

TITLE = "State feedback"
WORDS = """
**Do the designs keep their promise on a bench that differs from its model?** Each design must
follow a 1 cm step with at most 10 % overshoot and settle within 1 s.
"""
TOOLS = ()
N_PLANTS = 60


def off_by(chain: Chain, rng: np.random.Generator) -> Chain:
    return Chain(
        m=chain.m * (1 + 0.03 * rng.uniform(-1, 1, chain.n)),
        c=chain.c * (1 + 0.30 * rng.uniform(-1, 1, chain.n)),
        k=chain.k * (1 + 0.03 * rng.uniform(-1, 1, chain.n + 1)),
    )


def design(chain: Chain, cart: int, method: Literal["poles", "lqr"]) -> FeedbackDesign:
    return design_feedback(
        chain,
        Design(cart=cart, reference=1.0, overshoot_percent=10.0, settling_time=1.0, method=method),
    )


def on_other_plants(
    chain: Chain, result: FeedbackDesign, *, plants: int
) -> tuple[int, list[float]]:
    """Return how many loops are unstable, and the worst overshoot, settling and level error."""
    rng = np.random.default_rng(1)
    controller = StateFeedback(gains=result.gains, prefilter=result.prefilter, model=chain)
    T = result.sample_time
    t = T * np.arange(round(5.0 / T), dtype=np.float64)
    unstable, worst = 0, np.zeros(3)
    for _ in range(plants):
        plant = off_by(chain, rng)
        matrix = loop_matrix(plant, controller, sample_time=T)
        if np.abs(np.linalg.eigvals(matrix)).max() >= 1:
            unstable += 1
            continue
        y = simulate_loop(plant, controller, t=t, reference=1.0).x[result.cart - 1]
        level = y[-20:].mean()
        judged = (
            float(overshoot_percent(y, before=0.0, level=level)),
            float(settling_time(t, y, before=0.0, level=level)),
            100 * abs(level - 1.0),
        )
        worst = np.fmax(worst, judged)
    return unstable, worst.tolist()


def tables(*, quick: bool) -> list[Table]:
    plants = 4 if quick else N_PLANTS
    methods: tuple[Literal["poles", "lqr"], ...] = ("lqr", "poles")
    rows = []
    for name, chain in list(PRESETS.items())[: 1 if quick else None]:
        for cart in range(1, chain.n + 1):
            for method in methods:
                result = design(chain, cart, method)
                unstable, worst = on_other_plants(chain, result, plants=plants)
                nominal = (
                    result.overshoot_percent,
                    result.settling_time or np.nan,
                    result.peak_input,
                )
                rows.append(
                    [name, str(cart), method]
                    + [significant(value) for value in nominal]
                    + [f"{unstable} of {plants}", *(significant(value) for value in worst)]
                )
    head = ["plant", "cart", "method", "overshoot %", "settling s", "peak V"]
    head += ["unstable", "worst: overshoot %", "settling s", "level %"]
    title = "On the modelled plant, and the worst of other plants"
    return [Table(title=title, head=head, rows=rows, note=_NOTE.format(plants=plants))]


_NOTE = """
The other {plants} plants have masses and springs up to 3 % off and dampings up to 30 % off; the
controller and its observer keep the model. "Level" is the error of the final position.
"""
