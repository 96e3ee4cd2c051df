"""Choose a few experiments of many: the exchange algorithm.

Reference: V. V. Fedorov, Theory of Optimal Experiments, 1972, chapter 3; A. C. Atkinson, A. N.
Donev, R. D. Tobias, Optimum Experimental Designs, with SAS, 2007, chapter 12.
"""

import numpy as np

from pipeline.arrays import Array
from pipeline.bench.design.goal import Goal

_GAIN = 1e-6  # relative; a smaller one is rounding
_ROUNDS = 20


def choose(candidates: Array, told: Array, *, n: int, goal: Goal) -> tuple[int, ...]:
    """Return which `n` of the candidates (m, 2, n_p, n_p) leave the smallest error, the best first.

    One may be taken several times. They are added one by one; then each in turn gives way to
    whichever serves better in its place, until none does.

    Parameters
    ----------
    told : (2, n_p, n_p) what is known already.
    """
    chosen: list[int] = []
    total = told
    for _ in range(n):
        chosen.append(int(np.argmin(goal.of(total + candidates))))
        total = total + candidates[chosen[-1]]
    for _ in range(_ROUNDS):
        before = float(goal.of(total))
        for place, one in enumerate(chosen):
            others = total - candidates[one]
            left = goal.of(others + candidates)
            best = int(np.argmin(left))
            if left[best] < (1 - _GAIN) * left[one]:
                chosen[place], total = best, others + candidates[best]
        if float(goal.of(total)) >= (1 - _GAIN) * before:
            break
    alone = goal.of(told + candidates)
    return tuple(sorted(chosen, key=lambda one: (alone[one], one)))
