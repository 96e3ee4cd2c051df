"""Simulate whole classes on one bench in memory; motion that all teams share is computed once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pipeline.estimation.state_feedback import design_feedback
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.sampled_loop import StateFeedback
from pipeline.results import Record
from pipeline.simulated import submission
from pipeline.simulated import submission as runs
from pipeline.simulated.bench import COUNT, BenchRun, SimulatedBench, TrueMotion
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import Design

USUAL_NOISE = 0.2  # counts, as in `cartlab simulate`

BENCHES = [
    (preset, effect.key)
    for preset, effect in product(("throne-1dof", "throne-2dof", "throne-3dof"), CATALOGUE)
]


@dataclass(frozen=True, kw_only=True, eq=False)
class Moved:
    """The motion of a class's carts: the runs of each team and their positions."""

    bench: SimulatedBench
    teams: Sequence[Sequence[tuple[BenchRun, TrueMotion]]]


def move_class(
    preset: str, hide: str = "", *, seeds: range, count: float = COUNT, dwells: int = 12
) -> Moved:
    """Return the motion of the carts on one bench, with one team for each seed."""
    bench = prepare_bench(preset=preset, hide=(hide,) if hide else ())
    bench = replace(bench, count=count)
    session = runs.SimulatedSession(bench=bench, repeats=2, n_dwells=dwells)
    programme = [
        *runs.plan_steps(session),
        *runs.plan_dwells(session),
        runs.plan_sweep(session),
    ]
    same = {run.u.tobytes(): bench.move(run) for run in programme}
    teams = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        controller = _controller(submission.believed_chain(bench.chain, rng), bench)
        own = [
            *runs.plan_decays(session, rng),  # since no two hands release a cart in the same way
            runs.plan_closed_loop(session, cart=min(2, bench.chain.n), controller=controller),
        ]
        moved = [(run, bench.move(run)) for run in own]
        teams.append([*moved, *((run, same[run.u.tobytes()]) for run in programme)])
    return Moved(bench=bench, teams=teams)


def read_class(
    moved: Moved, *, seed: int, count: float | None = None, noise: float = USUAL_NOISE
) -> list[tuple[Record, ...]]:
    """Return the readings of each team's encoders as in its files, with noise in counts."""
    count = moved.bench.count if count is None else count
    bench = replace(moved.bench, count=count, noise_counts=noise)
    decimals = max(0, math.ceil(-math.log10(count)) + 1)
    rng = np.random.default_rng(seed)
    return [
        tuple(
            Record(
                id=run.id,
                kind=run.kind,
                t=run.t,
                u=np.round(motion.u, runs.INPUT_DECIMALS),
                y=np.round(bench.read(motion, run=run, rng=rng), decimals),
                carts=tuple(range(1, bench.chain.n + 1)),
                free=run.free,
                reference=run.reference,
                omega=None if run.frequency is None else 2 * np.pi * run.frequency,
                resolution=np.full(bench.chain.n, count),
            )
            for run, motion in team
        )
        for team in moved.teams
    ]


def _controller(believed, bench: SimulatedBench) -> StateFeedback:
    design = design_feedback(
        believed,
        Design(
            cart=min(2, bench.chain.n),
            reference=bench.travel,
            overshoot_percent=10.0,
            settling_time=1.0,
            input_limit=bench.input_limit,
            sample_time=bench.sample_time,
            method="lqr",
        ),
    )
    return StateFeedback(
        gains=np.array([float(f"{gain:.4g}") for gain in design.gains]),
        prefilter=float(f"{design.prefilter:.4g}"),
        model=believed,
    )
