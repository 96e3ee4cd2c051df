"""Steps and sweeps of set-ups that contradict each other are found, grouped and named."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import SubmissionError
from pipeline.identify.findings import say
from pipeline.identify.groups import (
    check_groups,
    find_setups,
    leave_out_lines,
    name_groups,
    steps_disagree,
)
from pipeline.plant.chain import PRESETS, Chain
from pipeline.results import Record, RecordingGroup
from pipeline.setup import Setup
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.submission import SimulatedSession, plan_steps, plan_sweep
from pipeline.submission.toml import parse_toml
from tests.helpers.honest_benches import draw_effect

DAYS = ("14-Feb-2025", "21-Feb-2025")


def days(first: SimulatedBench, second: SimulatedBench, *, seed: int) -> tuple[list[Record], Setup]:
    """Return the steps and sweeps of two days, with the same inputs on both."""
    session = SimulatedSession(bench=first, repeats=2, sweep_time=8.0)
    plan = [*plan_steps(session), plan_sweep(session)]
    records = []
    for day, bench in zip(DAYS, (first, second), strict=True):
        rng = np.random.default_rng([seed, len(records)])
        for run in plan:
            y = bench.read(bench.move(run), run=run, rng=rng)
            name = f"{day}-{run.id}"
            records.append(
                Record(
                    id=name,
                    kind=run.kind,
                    t=run.t,
                    u=run.u,
                    y=y,
                    carts=run.free,
                    free=run.free,
                    resolution=np.full(len(run.free), bench.count),
                    source=f"data/{name}.csv",
                )
            )
    return records, Setup(springs=tuple(bool(k > 0) for k in first.chain.k))


def assert_days_apart(records: Sequence[Record], bench: Setup) -> None:
    """Assert that the two days are two groups, named by their day."""
    groups = name_groups(find_setups(records, bench=bench), records)
    assert sorted(group.label for group in groups) == sorted(DAYS)
    for group in groups:
        assert set(group.experiments) == {r.id for r in records if group.label in r.id}
    assert [(check.code, check.outcome) for check in check_groups(groups)] == [("groups", "fail")]
    left_out = {
        number: parse_toml(line, where="", error=SubmissionError)["leave_out"]
        for number, line in leave_out_lines(groups).items()
    }
    assert left_out == {1: (f"*{groups[1].label}*",), 2: (f"*{groups[0].label}*",)}


def scaled(chain: Chain, factor: float) -> Chain:
    """Return a chain that moves less by a factor, as with another amplifier."""
    return replace(chain, m=factor * chain.m, c=factor * chain.c, k=factor * chain.k)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof", "throne-3dof"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_day_with_another_amplifier_is_a_group(preset, seed):
    """With half the gain on one day, friction or not, each day is a group with its own gain."""
    chain = PRESETS[preset]
    effects = (draw_effect(chain, seed),) if seed == 1 else ()
    first = SimulatedBench(chain=chain, effects=effects)
    records, bench = days(first, replace(first, chain=scaled(chain, 2.0)), seed=seed)
    assert steps_disagree(records)
    assert_days_apart(records, bench)
    gains = sorted(one for g in find_setups(records, bench=bench) for one in g.values.values())
    assert gains[1] / gains[0] == pytest.approx(2.0, rel=0.2)


@pytest.mark.parametrize("preset", ["throne-2dof", "throne-3dof"])
def test_a_day_with_a_held_cart_is_a_group(preset):
    """If the last cart, stated as free, was held on one day, that day's group says so."""
    chain = PRESETS[preset]
    first = SimulatedBench(chain=chain)
    records, bench = days(first, first, seed=4)
    short = Chain(m=chain.m[:-1], c=chain.c[:-1], k=chain.k[:-1])
    alone, _ = days(SimulatedBench(chain=short), SimulatedBench(chain=short), seed=5)
    n = bench.n
    held = [
        replace(
            one,
            y=np.vstack([one.y, 0.01 * one.y[:1]]),
            carts=tuple(range(1, n + 1)),
            free=tuple(range(1, n + 1)),
            resolution=np.append(one.resolution, one.resolution[:1]),
        )
        for one in alone
        if DAYS[1] in one.id
    ]
    records = [*(one for one in records if DAYS[0] in one.id), *held]
    assert_days_apart(records, bench)
    assert steps_disagree(records)
    remarks = {g.remark for g in name_groups(find_setups(records, bench=bench), records)}
    assert remarks == {"", say("group_held", cart=n, free=list(range(1, n)))}


@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof", "throne-3dof"])
@pytest.mark.parametrize(
    "seed", [6, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(7, 27))]
)
def test_two_days_of_one_bench_are_one_group(preset, seed):
    """Two days of one bench, with one hidden effect or none, do not contradict each other."""
    chain = PRESETS[preset]
    effects = (draw_effect(chain, seed),) if seed % 3 else ()
    bench = SimulatedBench(chain=chain, effects=effects)
    records, setup = days(bench, bench, seed=seed)
    assert not find_setups(records, bench=setup)


def test_a_day_that_is_part_of_another_is_no_pattern():
    """The pattern *7-Feb* would also leave out the recordings of 17-Feb, so ids are listed."""
    groups = [
        RecordingGroup(experiments=("17-Feb-a", "17-Feb-b"), values={}, std={}, label="17-Feb"),
        RecordingGroup(experiments=("7-Feb-a",), values={}, std={}, label="7-Feb"),
    ]
    lines = {1: 'leave_out = ["7-Feb-a"]', 2: 'leave_out = ["*17-Feb*"]'}
    assert leave_out_lines(groups) == lines


def test_each_group_can_be_kept_the_largest_first():
    """There is a line for each group, remark or not, but none for recordings of no group."""
    groups = [
        RecordingGroup(experiments=names, values={}, std={}, remark=remark, is_rest=is_rest)
        for names, remark, is_rest in (
            (("a", "b"), "", False),
            (("c", "d", "e"), "state something", False),
            (("f", "g", "h", "i"), "", True),
        )
    ]
    lines = leave_out_lines(groups)
    assert [*lines] == [2, 1]
    assert lines[2] == 'leave_out = ["a", "b", "f", "g", "h", "i"]'
