"""A channel that is logged late is reported; carts with friction are not."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric_file import load_rubric
from pipeline.identify.recording_checks import (
    check_channels,
    find_bad_recordings,
    find_late_channels,
)
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import propagate, simulate_linear
from pipeline.resources import RUBRICS
from pipeline.results import ExperimentKind, Record
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.ucsd import write_two_cart_submission

LONG = [pytest.mark.slow, pytest.mark.sample]
SAMPLE, COUNT = 0.00884, 0.00227  # s, cm
LATE = 5  # samples


def hand_in(folder: Path, *, hide: tuple[str, ...] = (), late: int = 0) -> Path:
    """Write an honest submission of two carts in which cart 2 is read `late` samples late."""
    bench = prepare_bench(preset="throne-2dof", hide=hide)
    write_submission(folder, bench, seed=3, compact=True, reported=True)
    for path in (folder / "data").glob("*.csv") if late else ():
        head, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        at = head.index("x2")
        positions = [row[at] for row in rows]
        for row, position in zip(rows, [positions[0]] * late + positions, strict=False):
            row[at] = position
        text = "\n".join(",".join(row) for row in (head, *rows)) + "\n"
        path.write_text(text, encoding="utf-8")
    return folder


@pytest.mark.slow
@pytest.mark.sample
def test_a_late_channel_is_reported_with_its_delay(tmp_path):
    """A late channel fails a check that gives its delay, and the recordings get a flag."""
    submission = load_submission(hand_in(tmp_path / "team", late=LATE))
    graded = grade_submission(
        submission, rubric=load_rubric(RUBRICS / "throne-2dof.toml"), name="team"
    )
    assert graded.analysis is not None
    (check,) = [c for c in graded.analysis.checks if c.kind == "late_channel"]
    assert check.outcome == "fail"
    assert check.value is not None
    assert check.id == "late_channel.cart-2"
    np.testing.assert_allclose(check.value, LATE * SAMPLE, atol=0.2 * SAMPLE)
    (flag,) = [flag for flag in graded.grade.flags if flag.code == "data_problem"]
    both = {r.id for r in graded.analysis.records if set(r.free) == {1, 2}} - {"control"}
    assert set(flag.parameters) == set(find_bad_recordings(graded.analysis)) == both


@pytest.mark.parametrize("kinds", [("step",), ("sweep",), ("decay",)])
@pytest.mark.parametrize("cart", [1, 2, 3])
def test_a_late_channel_is_found_without_dwells(kinds, cart):
    """Steps, a sweep or a decay show a late channel and its delay to within half a sample."""
    late = find_late_channels(motions(kinds, late=cart), carts=3)
    told = {one.cart: (one.value or 0.0) / SAMPLE for one in late}
    assert told == pytest.approx(
        {2: -LATE, 3: -LATE} if cart == 1 else {cart: LATE},
        abs=0.5,
    )
    assert {one.details["kind"] for one in late} == set(kinds)
    assert {one.details["when"] for one in late} == {"earlier" if cart == 1 else "later"}


def test_a_channel_late_only_in_the_sweep_is_reported_only_for_it():
    """If a channel is late only in the sweep, only the sweep is reported."""
    sound, late = motions(("step", "sweep")), motions(("sweep",), late=2)
    records = [record for record in sound if record.kind != "sweep"] + late
    (one,) = find_late_channels(records, carts=3)
    assert (one.run, one.cart, one.details["than"], one.code) == ("sweep", 2, 1, "late_channel")
    (check,) = check_channels([one])
    assert (check.id, check.code) == ("late_channel.cart-2", "late_channel_in")
    assert "sweeps" in check.message


@pytest.mark.parametrize(("late", "told"), [(0, []), (LATE, [2])])
def test_the_channels_of_a_real_bench_are_not_late(late, told, real_data, tmp_path):
    """Real steps with much dry friction pass, unless the channel of cart 2 is delayed."""
    folder = write_two_cart_submission(tmp_path / "real", real_data, steps=(1, 2, 3, 4, 5))
    records = [
        replace(record, y=np.array([record.y[0], delayed(record.y[1], late)]))
        if set(record.carts) == {1, 2}
        else record
        for record in read_data(load_submission(folder)).records
    ]
    found = find_late_channels(records, carts=2)
    assert {(one.cart, one.details["kind"]) for one in found} == {(cart, "step") for cart in told}


def delayed(x: Array, samples: int) -> Array:
    """Return a channel that is read this number of samples later."""
    return np.concatenate([np.repeat(x[:1], samples), x[: x.size - samples]])


def motions(kinds: tuple[ExperimentKind, ...], *, late: int = 0) -> list[Record]:
    """Return recordings of three carts; the channel of cart `late` is read late."""
    chain, rng = PRESETS["throne-3dof"], np.random.default_rng(5)
    t = np.linspace(0.0, 1399 * SAMPLE, 1400)
    hold = 1.0 / float(np.max(chain.static_gains()))
    inputs = {
        "step": [size * hold * ((t > 0.5) & (t < 6.0)) for size in (0.5, 0.9)],
        "sweep": [hold * np.sin(2 * np.pi * (0.3 * t + 0.3 * t**2))],
        "decay": [0 * t],
    }
    records = []
    for kind in kinds:
        for number, u in enumerate(inputs[kind], start=1):
            if kind == "decay":
                A, B, C, _ = chain.state_space()
                start = np.array([1.0, 0.0, 0.2, 0.0, 0.1, 0.0])
                y = C @ propagate(A, B[:, :1], t, u, x0=start)
            else:
                y = simulate_linear(chain, t, u)
            y = COUNT * np.round((y + 0.2 * COUNT * rng.standard_normal(y.shape)) / COUNT)
            if late:
                y[late - 1] = delayed(y[late - 1], LATE)
            records.append(
                Record(
                    id=kind if len(inputs[kind]) == 1 else f"{kind}-{number}",
                    kind=kind,
                    t=t,
                    u=None if kind == "decay" else u,
                    y=y,
                    carts=(1, 2, 3),
                    free=(1, 2, 3),
                    resolution=np.full(3, COUNT),
                )
            )
    return records


@pytest.mark.parametrize(
    "hide",
    [
        (),
        pytest.param(("coulomb_friction:cart=2,force=0.03",), marks=LONG),
        pytest.param(("input_delay:delay=0.03",), marks=LONG),
    ],
)
def test_friction_and_a_late_input_are_not_a_late_channel(tmp_path, hide):
    """Neither friction nor a delay of the motor is reported as a late channel."""
    analysis = analyse(load_submission(hand_in(tmp_path / "team", hide=hide)), design=False)
    assert not [c for c in analysis.checks if c.kind == "late_channel"]
