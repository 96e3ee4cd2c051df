"""All records of a bench together decide the sign of its input."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.identify.recording_checks import check_signs
from pipeline.ingest.read import read_data
from pipeline.ingest.sign import find_signs, with_signs
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import simulate_linear
from pipeline.report.sections.questions import ask
from pipeline.results import Record
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import Submission, load_submission
from pipeline.submission.models import System
from pipeline.workflow import analyse

T = 0.0088542 * np.arange(900, dtype=np.float64)
LATE = ("input_delay:delay=0.014", "actuator_lag:time_constant=0.018")


def one(u: Array, x: Array) -> list[Record]:
    """Return a record of three free carts, of which only cart 1 is measured."""
    return [
        Record(
            id="a",
            kind="sweep",
            t=T,
            u=u,
            y=x[None],
            carts=(1,),
            free=(1, 2, 3),
            resolution=np.ones(1),
        )
    ]


def respond(preset: str, u: Array, sign: int) -> Array:
    """Return cart 1's noisy position in counts, for a logged input of the given sign."""
    rng = np.random.default_rng(7)
    y = simulate_linear(PRESETS[preset], T, sign * u)[0]
    y = y / np.ptp(y) + 0.001 * rng.standard_normal(y.size)
    return np.rint(440 * y)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_scale_of_an_input_has_the_sign_that_was_found(sign):
    """`with_signs` turns the input round, and the sign of its scale tells that it did."""
    u = np.where((T > 1) & (T < 4), 1.0, 0.0)
    submission = Submission(version=1, system=System(carts=3))
    (record,), _, _ = with_signs(one(u, respond("throne-3dof", u, sign)), submission)
    assert np.sign(record.input_scale) == sign
    assert record.u is not None
    assert np.array_equal(record.u, sign * u)


CASES = {
    "step on": np.where(T > 0.3, 1.0, 0.0),
    "step on and off": np.where((T > 0.3) & (T < 4.0), -1.0, 0.0),
    "dwell below": np.sin(2 * np.pi * 1.0 * T),
    "dwell near": np.sin(2 * np.pi * 2.0 * T),
    "sweep": np.sin(2 * np.pi * (0.3 + 0.3 * T) * T),
    "random": np.repeat(np.random.default_rng(5).standard_normal(90), 10),
}


@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof", "throne-3dof"])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_the_sign_of_a_single_record_is_found(case, sign, preset):
    """A single record of motion from rest shows the sign of the input."""
    assert find_signs(one(case, respond(preset, case, sign)), stated={}) == {"a": sign}


@pytest.mark.parametrize("frequency", np.geomspace(0.3, 20.0, 25))
def test_the_sign_is_never_wrong_on_a_late_log(frequency):
    """If a log is late by one sample, the sign is found or left open, but never wrong."""
    u = np.sin(2 * np.pi * frequency * T)
    for preset in PRESETS:
        for late in (0, 1):
            x = np.roll(respond(preset, u, 1), late)
            x[:late] = x[late]
            assert find_signs(one(u, x), stated={}).get("a", 0) in (0, 1)


def test_without_motion_or_input_there_is_no_sign():
    """From a decay or a held cart, or without records, no sign is found."""
    decay: Array = np.rint(440 * np.exp(-T) * np.cos(13 * T))
    assert find_signs(one(np.zeros_like(T), decay), stated={}) == {}
    assert find_signs(one(np.sin(T), np.full_like(T, 3.0)), stated={}) == {}
    assert find_signs([], stated={}) == {}


@pytest.mark.parametrize("size", [1e-320, 1e-160, 1e-9, 1e9, 1e160, 1e305])
def test_numbers_of_any_size_do_no_harm(size):
    """The sign is found in any units, but may stay open near the limits of floats."""
    u = CASES["sweep"]
    x = respond("throne-1dof", u, 1)
    for records in (one(size * u, x), one(u, size * x), one(size * u, size * x)):
        expected = (1,) if 1e-10 < size < 1e10 else (0, 1)
        assert find_signs(records, stated={}).get("a", 0) in expected


# ------------------------------------------------------------------- all records of a bench


@pytest.fixture(scope="module", params=[(1, LATE[0]), (2, LATE[0]), (2, LATE[1]), (3, LATE[1])])
def bench(request, tmp_path_factory) -> Path:
    """Return a bench whose input reaches the carts late; its submission states no sign."""
    carts, late = request.param
    hidden = prepare_bench(preset=f"throne-{carts}dof", hide=(late,))
    folder = tmp_path_factory.mktemp("late") / "bench"
    write_submission(folder, hidden, seed=5, compact=True)
    toml = folder / "submission.toml"
    text = toml.read_text("utf-8")
    toml.write_text(text.replace(", sign = 1", ""), "utf-8")
    assert toml.read_text("utf-8") != text
    return folder


def driven(folder: Path) -> list[Record]:
    return [
        r for r in read_data(load_submission(folder)).records if r.u is not None and np.any(r.u)
    ]


def reversed_in(records: Sequence[Record], names: Collection[str]) -> list[Record]:
    return [replace(r, u=-r.u) if r.u is not None and r.id in names else r for r in records]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("sign", [1, -1])
def test_a_late_input_does_not_turn_the_sign_of_dwells(bench, sign):
    """With a late input a fast dwell may seem reversed, but every record gets the right sign."""
    records = driven(bench)
    names = {record.id for record in records}
    found = find_signs(reversed_in(records, names if sign < 0 else ()), stated={})
    assert found == dict.fromkeys(names, sign)


@pytest.mark.parametrize(("sign", "said"), [(1, False), (-1, True)])
def test_a_stated_sign_is_not_doubted_because_the_input_is_late(bench, sign, said):
    """If the input is late, a right stated sign raises no doubt, and a wrong one does."""
    submission = load_submission(bench)
    drive = submission.system.input.model_copy(update={"sign": sign})
    system = submission.system.model_copy(update={"input": drive})
    signs = read_data(submission.model_copy(update={"system": system})).signs
    doubts = check_signs(signs, without=())
    assert bool(doubts) == said
    assert not check_signs(signs, without=set(signs.found))
    assert not said or "sign = 1" in doubts[0].message
    few = {name: -sign if i < 2 else told for i, (name, told) in enumerate(signs.found.items())}
    assert bool(check_signs(replace(signs, found=few), without=())) == said


def test_a_record_that_counts_the_other_way_is_found(bench):
    """Records logged with the other sign are found: one record, all dwells, or every second record.

    Only dwells so fast that a delay could explain their sign may stay open.
    """
    records = driven(bench)
    names = [record.id for record in records]
    sines = {record.id for record in records if record.kind == "sine"}
    last = max((r for r in records if r.kind == "sine"), key=lambda r: r.omega or 0.0)
    for contrary in ({name} for name in names[::2]):
        found = find_signs(reversed_in(records, contrary), stated={})
        wrong = {n for n in names if found[n] == (1 if n in contrary else -1)}
        assert not wrong
        open_ = {n for n in names if found[n] == 0}
        frequencies = [r.omega for r in records if r.id in open_]
        assert all(w is not None and w > 0.7 * (last.omega or 0.0) for w in frequencies)
    for contrary in (sines, set(names[::2])):
        found = find_signs(reversed_in(records, contrary), stated={})
        majority = {n: found[n] * (-1 if n in contrary else 1) for n in names}
        assert set(majority.values()) <= {0, 1}
        assert sum(majority.values()) > 0.8 * len(names)


def test_the_report_asks_why_a_record_was_inverted(tmp_path):
    """If a step was logged with the other sign, the report asks why cartlab inverted it."""
    folder = tmp_path / "bench"
    write_submission(folder, "throne-1dof", seed=5, compact=True)
    toml, step = folder / "submission.toml", folder / "data" / "step-1.csv"
    toml.write_text(toml.read_text("utf-8").replace(", sign = 1", ""), "utf-8")
    head, *rows = step.read_text("utf-8").splitlines()
    column = head.split(",").index("input")
    cells = [row.split(",") for row in rows]
    turned = [",".join([*c[:column], f"{-float(c[column]):g}", *c[column + 1 :]]) for c in cells]
    step.write_text("\n".join([head, *turned]) + "\n", "utf-8")

    analysis = analyse(load_submission(folder))

    assert [record.id for record in analysis.records if record.sign_reversed] == ["step-1"]
    (question, *_) = ask(analysis)
    assert (question.id, question.section) == ("sign", "steps")
    assert "step-1" in question.text
    assert all(row.consistent for row in analysis.rows)
