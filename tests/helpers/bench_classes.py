"""Whole classes on one bench, in memory: what every team's run has in common is simulated once."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pipeline.plant.loop.sampled_loop import StateFeedback
from pipeline.plant.nonlinear.effects import CATALOGUE
from pipeline.results import Record
from pipeline.stages.state_feedback import design_feedback
from pipeline.synthesis import COUNT, SAMPLE_TIME, claims, runs
from pipeline.synthesis.hidden import prepare_bench
from pipeline.synthesis.rig import Motion, Rig, Run

USUAL_NOISE = 0.2  # counts, as `cartlab simulate` has it
_ZERO_ERROR = 2.0  # counts

BENCHES = [
    (preset, effect.key)
    for preset, effect in product(("throne-1dof", "throne-2dof", "throne-3dof"), CATALOGUE)
]


@dataclass(frozen=True, kw_only=True, eq=False)
class Moved:
    """What the carts of a class did: for each team its runs and their motions."""

    rig: Rig
    teams: Sequence[Sequence[tuple[Run, Motion]]]


def move_class(
    preset: str, hide: str = "", *, seeds: range, count: float = COUNT, dwells: int = 12
) -> Moved:
    """Return how the carts moved for as many teams as there are seeds, all on one bench."""
    bench = prepare_bench(preset=preset, hide=(hide,) if hide else ())
    chain = bench.chain
    rig = Rig(
        chain=chain,
        sample_time=SAMPLE_TIME,
        count=count,
        noise=USUAL_NOISE * count,
        zero_error=_ZERO_ERROR * count,
        effects=bench.effects,
    )
    session = runs.Session(
        sample_time=SAMPLE_TIME,
        travel=bench.travel,
        input_limit=bench.input_limit,
        repeats=2,
        n_dwells=dwells,
        transients=True,
        sweep_time=20.0,
    )
    programme = [
        *runs.steps(chain, session),
        *runs.dwells(chain, session),
        runs.sweep(chain, session),
    ]
    same = {run.u.tobytes(): rig.move(run) for run in programme}
    teams = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        controller = _controller(claims.believed_chain(chain, rng), rig=rig, session=session)
        own = [
            *runs.decays(chain, session, rng),  # no two hands let go alike
            runs.closed_loop(
                chain,
                session,
                cart=min(2, chain.n),
                reference=session.travel,
                controller=controller,
            ),
        ]
        moved = [(run, rig.move(run)) for run in own]
        teams.append([*moved, *((run, same[run.u.tobytes()]) for run in programme)])
    return Moved(rig=rig, teams=teams)


def read_class(
    moved: Moved, *, seed: int, count: float | None = None, noise: float = USUAL_NOISE
) -> list[tuple[Record, ...]]:
    """Return what each team's encoders say of it, with noise in counts, as its files have it."""
    count = moved.rig.count if count is None else count
    rig = replace(moved.rig, count=count, noise=noise * count, zero_error=_ZERO_ERROR * count)
    decimals = max(0, math.ceil(-math.log10(count)) + 1)
    rng = np.random.default_rng(seed)
    return [
        tuple(
            Record(
                id=run.id,
                kind=run.kind,
                t=run.t,
                u=np.round(motion.u, runs.INPUT_DECIMALS),
                y=np.round(rig.read(motion, run=run, rng=rng), decimals),
                carts=tuple(range(1, rig.chain.n + 1)),
                free=run.free,
                reference=run.reference,
                omega=None if run.frequency is None else 2 * np.pi * run.frequency,
                resolution=np.full(rig.chain.n, count),
            )
            for run, motion in team
        )
        for team in moved.teams
    ]


def _controller(believed, *, rig: Rig, session: runs.Session) -> StateFeedback:
    design = design_feedback(
        believed,
        cart=min(2, rig.chain.n),
        reference=session.travel,
        overshoot_percent=10.0,
        settling_time=1.0,
        input_limit=session.input_limit,
        sample_time=SAMPLE_TIME,
        method="lqr",
    )
    return StateFeedback(
        gains=np.array([float(f"{gain:.4g}") for gain in design.gains]),
        prefilter=float(f"{design.prefilter:.4g}"),
        model=believed,
    )
