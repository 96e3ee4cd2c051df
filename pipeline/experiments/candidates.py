"""The candidate experiments, each as large as the travel limit allows."""

from collections.abc import Collection, Iterator
from math import ceil

import numpy as np

from pipeline.errors import DataError
from pipeline.experiments.goal import Goal
from pipeline.experiments.information import Knowledge
from pipeline.experiments.multisine import optimal_tones
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.experiments.propose import FURTHEST, rounded, rounded_down
from pipeline.plant.simulate import SETTLED, SETTLED_DWELL, dwell_frequencies, settling_wait

_PERIODS = 2  # periods of a multisine in a record
_BAND = (0.4, 1.6)  # lowest and highest frequency, as multiples of the first and the last resonance
_DWELLS = 40  # number of frequencies for dwells


def propose_candidates(
    known: Knowledge, *, limits: PlanLimits, commands: Collection[str], goal: Goal
) -> list[Recording]:
    """Return the recordings that could come next, with all carts free.

    These are dwells if the carts are identified from dwells. Otherwise they are chirps, square
    waves and multisines, if the bench knows the `commands` for them.

    Raises
    ------
    DataError : the limits allow no candidate, or dwells would take too long to settle.
    """
    made = list(_dwells(known) if known.dwells else _broadband(known, limits, commands, goal))
    settle = rounded(settling_wait(known.chain, time_constants=SETTLED))
    carts = tuple(range(1, known.chain.n + 1))
    candidates = []
    for recording in made:
        whole = recording.model_copy(update={"carts": carts, "settle": settle})
        size = known.at_its_limits(whole, limits=limits, share=FURTHEST)
        if size > 0:
            candidates.append(whole.model_copy(update={"amplitude": rounded_down(size)}))
    if not candidates:
        raise DataError(
            "no next experiment: the limits of plan.toml allow none"
            if made
            else "no next experiment: dwells of these carts take too long to settle"
        )
    return candidates


def _dwells(known: Knowledge) -> Iterator[Recording]:
    """Yield dwells; each lasts twice as long as the carts need to reach the steady state.

    If the steady state takes too long to reach, no dwell is yielded. A transient would be mistaken
    for a steady state.
    """
    wait = settling_wait(known.chain, time_constants=SETTLED_DWELL)
    if wait * np.min(-known.chain.poles.real) < SETTLED:
        return
    for hertz in dwell_frequencies(known.chain, n=_DWELLS):
        cycles = ceil(2 * wait * hertz)
        yield _free("sine-01", "sine", frequency=hertz, cycles=cycles)


def _broadband(
    known: Knowledge, limits: PlanLimits, commands: Collection[str], goal: Goal
) -> Iterator[Recording]:
    resonances = np.sort(np.abs(known.chain.poles)) / (2 * np.pi)
    seconds = float(rounded(max(20.0, 20 / resonances[0])))  # 20 s, or 20 of the slowest periods
    for hertz in np.geomspace(0.1 * resonances[0], resonances[-1], 8):
        f = rounded(float(hertz))
        yield _free("square-1", "square", frequency=f, cycles=ceil(seconds * f))
    if "c" in commands:
        edges = [
            rounded(float(f))
            for f in np.geomspace(_BAND[0] * resonances[0], _BAND[1] * resonances[-1], 6)
        ]
        for low, high in ((a, b) for a in edges for b in edges if a < b):
            cycles = ceil(seconds * low)
            yield _free("sweep-1", "chirp", frequency=low, end=high, cycles=cycles)
    if "m" in commands:
        base = rounded(_PERIODS / seconds)
        travel = FURTHEST * limits.travel
        tones = optimal_tones(known, base=base, seconds=seconds, travel=travel, goal=goal)
        yield _free("multisine-1", "multisine", frequency=base, cycles=_PERIODS, tones=tones)


def _free(name, wave, *, frequency, cycles, end=None, tones=()) -> Recording:
    return Recording(
        id=name,
        kind="sine" if wave == "sine" else "sweep",
        carts=(1,),
        wave=wave,
        amplitude=1.0,
        frequency=frequency,
        frequency_end=end,
        cycles=cycles,
        tones=tones,
    )
