"""How good and how forgiving the designed controllers are, and what processor time they take.

For every cart of the presets and both methods, a 1 cm step to be followed with at most 10 %
overshoot and within 1 s: the nominal step, then the worst of 60 plants whose masses and springs
are up to 3 % and whose dampings up to 30 % off, with the controller's observer none the wiser.

Run: python -m benchmarks.feedback
"""

import time

import numpy as np

from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.linear.step_response import overshoot_percent, settling_time
from pipeline.plant.loop.sampled_loop import StateFeedback, loop_matrix, simulate_loop
from pipeline.results import FeedbackDesign
from pipeline.stages.state_feedback import Method, design_feedback

N_PLANTS = 60
N_TIMED = 20
HEADING = (
    "plant          cart method   ms | overshoot % settling s    peak V | "
    "unstable  worst: overshoot % settling s level %"
)


def off_by(chain: Chain, rng: np.random.Generator) -> Chain:
    return Chain(
        m=chain.m * (1 + 0.03 * rng.uniform(-1, 1, chain.n)),
        c=chain.c * (1 + 0.30 * rng.uniform(-1, 1, chain.n)),
        k=chain.k * (1 + 0.03 * rng.uniform(-1, 1, chain.n + 1)),
    )


def design(chain: Chain, cart: int, method: Method) -> FeedbackDesign:
    return design_feedback(
        chain,
        cart=cart,
        reference=1.0,
        overshoot_percent=10.0,
        settling_time=1.0,
        method=method,
    )


def on_other_plants(chain: Chain, result: FeedbackDesign) -> tuple[int, list[float]]:
    """Return the unstable loops and the worst overshoot, settling time and level error."""
    rng = np.random.default_rng(1)
    controller = StateFeedback(gains=result.gains, prefilter=result.prefilter, model=chain)
    T = result.sample_time
    t = T * np.arange(round(5.0 / T), dtype=np.float64)
    unstable, worst = 0, np.zeros(3)
    for _ in range(N_PLANTS):
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


def main() -> None:
    print(HEADING)
    methods: tuple[Method, ...] = ("lqr", "poles")
    for name, chain in PRESETS.items():
        for cart in range(1, chain.n + 1):
            for method in methods:
                times, result = [], design(chain, cart, method)
                for _ in range(N_TIMED):
                    start = time.process_time()
                    design(chain, cart, method)
                    times.append(time.process_time() - start)
                unstable, (overshoot, settling, level) = on_other_plants(chain, result)
                print(
                    f"{name:14s} {cart:4d} {method:6s} {1e3 * np.median(times):5.0f} | "
                    f"{result.overshoot_percent:11.2f} {result.settling_time or np.nan:10.2f} "
                    f"{result.peak_input:9.3f} | {unstable:5d}/{N_PLANTS} {overshoot:18.2f} "
                    f"{settling:10.2f} {level:7.1f}"
                )


if __name__ == "__main__":
    main()
