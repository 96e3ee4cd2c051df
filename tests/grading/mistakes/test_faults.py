"""A recording that is not what it claims to be is named and left out; honest ones stay."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.estimation.record_fit import find_correction, record_fits
from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric_file import load_rubric
from pipeline.identify.recording_checks import find_bad_recordings
from pipeline.plant.chain import PRESETS
from pipeline.results import Analysis
from pipeline.simulated.hidden import preset_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.spoilt import Columns, Spoil, change, files, spoil, times

PRESET = "throne-2dof"
TRUE = PRESETS[PRESET].parameters()


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """Write a whole session: two decays per cart, four steps, dwells, a sweep and a closed loop."""
    folder = tmp_path_factory.mktemp("bench")
    write_submission(folder, PRESET, seed=3, compact=True, reported=True)
    return folder


@pytest.fixture
def session(bench, tmp_path) -> Path:
    """Return a copy of the session for a test to spoil."""
    return shutil.copytree(bench, tmp_path / "session")


def analysed(folder: Path) -> Analysis:
    return analyse(load_submission(folder), design=False)


def graded(folder: Path) -> tuple[Analysis, Grade]:
    rubric = load_rubric(Path(PRESET))
    found = grade_submission(load_submission(folder), rubric=rubric, name="team")
    assert found.analysis is not None
    return found.analysis, found.grade


def left_out(analysis: Analysis, *, is_wrong: bool = True) -> dict[str, str]:
    """Return the reason of each recording that is left out, all of them wrong, or none."""
    assert {one.is_wrong for one in analysis.left_out} <= {is_wrong}
    return {one.experiment: one.reason for one in analysis.left_out}


def failed(analysis: Analysis) -> set[str]:
    return {check.id for check in analysis.checks if check.outcome == "fail"}


def assert_right(analysis: Analysis) -> None:
    """Check that no estimate uses a spoilt recording."""
    for row in analysis.rows:
        assert row.final is not None
        assert row.final.value == pytest.approx(TRUE[row.name], rel=0.02)
        if row.initial is not None and row.initial.source in ("step", "log_decrement"):
            assert row.initial.value == pytest.approx(TRUE[row.name], rel=0.02)


def exchanged(columns: Columns) -> Columns:
    return {**columns, "x1": columns["x2"], "x2": columns["x1"]}


def in_milliseconds(columns: Columns) -> Columns:
    return {**columns, "time": 1000 * columns["time"]}


def dead(name: str) -> Spoil:
    return lambda columns: {**columns, name: 0 * columns[name]}


def cut(columns: Columns) -> Columns:
    return {name: values[:60] for name, values in columns.items()}


def frozen(name: str) -> Spoil:
    """Freeze an encoder at the cart's first turning point after the input step."""

    def freeze(columns: Columns) -> Columns:
        x = columns[name].copy()
        on = np.flatnonzero(columns["input"])
        turning = on[0] + np.argmax(np.abs(x[on] - x[0]))
        x[turning:] = x[turning]
        return {**columns, name: x}

    return freeze


# name of the case: kind of recording, which of its files, the change, a word of the reason
SPOILT = {
    "a decay in milliseconds": ("decay-1", slice(1), in_milliseconds, "milliseconds"),
    "a decay in thousands of seconds": ("decay-1", slice(1), times(1e-3, "time"), "thousands"),
    "two of four steps exchanged": ("step", slice(2, 4), exchanged, "swapped"),
    "cart 2 dead in every step": ("step", slice(None), dead("x2"), "encoder of cart 2"),
    "cart 1 dead in a step": ("step", slice(1), dead("x1"), "encoder of cart 1"),
    "all dwells exchanged": ("sine", slice(None), exchanged, "swapped"),
    "four dwells exchanged": ("sine", slice(1, 22, 6), exchanged, "swapped"),
    "every second dwell exchanged": ("sine", slice(None, None, 2), exchanged, "swapped"),
    "a step exchanged": ("step", slice(1), exchanged, "swapped"),
    "the sweep exchanged": ("sweep", slice(None), exchanged, "swapped"),
    "a dwell ten times too far": ("sine", slice(3, 4), times(10, "x1", "x2"), "another unit"),
    "a step ten times too far": ("step", slice(1), times(10, "x1", "x2"), "another unit"),
    "cart 1 turned in four dwells": ("sine", slice(1, 22, 6), times(-1, "x1"), "sign of x1"),
    "cart 1 turned in the sweep": ("sweep", slice(None), times(-1, "x1"), "sign of x1"),
    "cart 1 frozen in a step": ("step", slice(1), frozen("x1"), "froze"),
    "cart 2 frozen in a step": ("step", slice(1, 2), frozen("x2"), "froze"),
    "all steps in millimetres": ("step", slice(None), times(10, "x1", "x2"), "another unit"),
    "all dwells in millimetres": ("sine", slice(None), times(10, "x1", "x2"), "another unit"),
    "a tenth of the input in every step": ("step", slice(None), times(0.1, "input"), "its input"),
    "a third of the input in every step": ("step", slice(None), times(1 / 3, "input"), "K_1 = "),
    "cart 1 turned in every step": ("step", slice(None), times(-1, "x1"), "sign of x1"),
    "all decays at half speed": ("decay", slice(None), times(2, "time"), "clock"),
}


# the slowest cases, and cases that give the same reason as a faster one
SEARCHED = (
    "cart 1 turned in every step",
    "all dwells exchanged",
    "cart 1 turned in the sweep",
    "a tenth of the input in every step",
    "a third of the input in every step",
    "every second dwell exchanged",
    "four dwells exchanged",
    "two of four steps exchanged",
    "all dwells in millimetres",
    "a step ten times too far",
    "cart 2 frozen in a step",
    "cart 1 dead in a step",
    "cart 1 turned in four dwells",
)
LONG = [pytest.mark.slow, pytest.mark.sample]


def _cases() -> Iterator[Any]:
    """Yield each case without a stated sign; cases like a wrong sign come again with one."""
    for case in SPOILT:
        yield pytest.param(case, "", marks=LONG if case in SEARCHED else ())
        if "turned" in case or "exchanged" in case:
            short = case in ("cart 1 turned in four dwells", "a step exchanged")
            marks = LONG if case == "a step exchanged" else ()
            yield pytest.param(case, ", sign = 1", marks=marks if short else pytest.mark.slow)


@pytest.mark.parametrize(("case", "sign"), [*_cases()])
def test_spoilt_recordings_are_named_left_out_and_flagged(case, sign, session):
    """Only the spoilt recordings are named, left out of all estimates and flagged.

    The report and the grade give the reason.
    """
    kind, which, how, word = SPOILT[case]
    change(session, ", sign = 1", sign)
    names = spoil(files(session, kind)[which], how)
    analysis, grade = graded(session)
    assert left_out(analysis).keys() == names
    assert all(word in reason for reason in left_out(analysis).values())
    assert f"record.{min(names)}" in failed(analysis)
    assert [(flag.code, set(flag.parameters)) for flag in grade.flags] == [("data_problem", names)]
    assert_right(analysis)


def test_dwells_that_are_too_short_are_flagged(session):
    """A dwell with less than 1.5 cycles is flagged as too short for a steady state."""
    spoil(files(session, "sine"), cut)
    analysis, grade = graded(session)
    (flag,) = grade.flags
    frequency = {r.id: (r.omega or 0.0) / (2 * np.pi) for r in analysis.records}
    assert len(flag.parameters) >= 8
    assert all(60 * 0.00884 * frequency[name] < 1.5 for name in flag.parameters)


@pytest.mark.parametrize(
    ("kind", "stated", "word"),
    [("step", "decay", "free decay"), ("sine", "step", "not a step"), ("step", "cut", "truncated")],
)
def test_a_cut_recording_or_one_of_another_kind_is_flagged(kind, stated, word, session):
    """A recording that is cut off or of another kind is left out, flagged, and fails a check."""
    path = files(session, kind)[1]
    if stated == "cut":
        spoil([path], lambda columns: {k: v[: v.size // 3] for k, v in columns.items()})
    else:
        table = f'id = "{path.stem}"\nkind = '
        change(session, f'{table}"{kind}"', f'{table}"{stated}"')
    analysis, grade = graded(session)
    ((name, reason),) = left_out(analysis).items()
    assert name == path.stem
    assert word in reason
    assert f"record.{name}" in failed(analysis)
    assert name in {name for flag in grade.flags for name in flag.parameters}
    assert_right(analysis)


@pytest.mark.parametrize("which", [slice(1), slice(None)])
def test_decays_in_millimetres_give_a_warning_and_are_used(which, session):
    """If one or all decays are in millimetres, a warning names them, and no check fails."""
    names = spoil(files(session, "decay")[which], times(10, "x1", "x2"))
    analysis = analysed(session)
    assert not analysis.left_out
    assert not failed(analysis)
    assert any(min(names) in text and "another unit" in text for text in analysis.warnings)


def test_frequencies_in_rad_per_s_stated_as_hz_are_named(session):
    """If frequencies in rad/s were stated as Hz, the reason given for each file says so."""
    path = session / "submission.toml"
    text = re.sub(
        r"frequency = ([\d.]+)",
        lambda found: f"frequency = {2 * np.pi * float(found[1]):.3f}",
        path.read_text(encoding="utf-8"),
    )
    path.write_text(text, encoding="utf-8")
    problems = find_bad_recordings(analysed(session))
    assert problems
    assert all("rad/s" in one.reason for one in problems.values())


def test_a_missing_list_of_free_carts_is_named_with_its_fix(session):
    """If the key `carts` is missing although a cart was held, the message gives the line to add."""
    change(session, "carts = [1]\n", "", 1)  # without this key, all carts count as free
    (reason,) = left_out(analysed(session)).values()
    assert "carts = [1]" in reason


def test_a_loop_that_is_left_out_is_not_compared(session):
    """A closed loop with a clock in milliseconds is not compared with the model."""
    names = spoil(files(session, "control"), in_milliseconds)
    analysis = analyse(load_submission(session))
    assert left_out(analysis).keys() == names == {"control"}
    assert analysis.hardware == ()
    (skip,) = [s for s in analysis.skipped if s.name.endswith(", control")]
    assert "milliseconds" in skip.reason


def test_a_sound_repeat_is_kept_if_most_have_swapped_columns(session):
    """If three of four steps have swapped columns, only they are left out; no sign is advised."""
    steps = files(session, "step")
    names = spoil(steps[:3], exchanged)
    analysis = analysed(session)
    assert left_out(analysis).keys() == names
    assert {gain.experiment for gain in analysis.step_gains} == {steps[3].stem}
    assert not any("sign" in warning for warning in analysis.warnings)


def test_times_in_milliseconds_throughout_fail_a_check(session):
    """If all times are in milliseconds, a check finds all dwell frequencies 1000 times off."""
    spoil(files(session, ""), in_milliseconds)
    analysis, grade = graded(session)
    assert grade.status == "graded"
    (check,) = [c for c in analysis.checks if c.id == "dwells.frequency"]
    assert check.outcome == "fail"
    assert check.value == pytest.approx(1000, rel=0.01)


def test_one_recording_in_two_experiments_counts_once(session):
    """If two repeats name the same file, the second is left out and flagged."""
    change(session, "data/step-2.csv", "data/step-1.csv")
    analysis, grade = graded(session)
    assert [one.experiment for one in analysis.left_out] == ["step-2"]
    assert ("step-2",) in [flag.parameters for flag in grade.flags]


@pytest.mark.slow
@pytest.mark.sample
def test_columns_swapped_in_every_recording_are_named(session):
    """If the columns of all driven recordings are swapped, one reason says so for all of them.

    Then no parameters are identified.
    """
    names = spoil(
        [p for kind in ("step", "sine", "sweep") for p in files(session, kind)], exchanged
    )
    analysis = analysed(session)
    assert left_out(analysis).keys() == names
    (reason,) = set(left_out(analysis).values())
    assert '{ x1 = "x2", x2 = "x1" }' in reason
    assert "fit.identified" in failed(analysis)


def test_contradicting_dwells_and_steps_identify_nothing(session):
    """If the inputs of dwells and steps disagree by a factor of ten, nothing is identified."""
    names = spoil(files(session, "sine"), times(10, "input"))
    path = session / "submission.toml"
    runs = path.read_text(encoding="utf-8").split("[[experiments]]")
    kept = [run for run in runs if 'kind = "sweep"' not in run]
    assert len(kept) == len(runs) - 1
    path.write_text("[[experiments]]".join(kept), encoding="utf-8")
    analysis = analysed(session)
    assert {one.experiment for one in analysis.left_out} == names | {
        path.stem for path in files(session, "step")
    }
    assert {one.code for one in analysis.left_out} == {"contradicting_kinds"}
    assert analysis.chain is None
    initial = {row.name for row in analysis.rows if row.initial is not None}
    assert initial == {"omega_1", "omega_2", "zeta_1", "zeta_2"}


@pytest.mark.slow
@pytest.mark.sample
def test_a_recording_of_no_linear_carts_is_left_out_but_not_called_wrong(session):
    """A recording that linear carts cannot produce is left out, but not called wrong."""

    def another(columns: Columns) -> Columns:
        """Return what something besides the input moved."""
        x = 2 * np.sin(17 * columns["time"] + 5 * columns["time"] ** 2)
        return {**columns, "x1": x, "x2": x}

    names = spoil(files(session, "sine")[4:5], another)
    analysis = analysed(session)
    assert left_out(analysis, is_wrong=False).keys() == names
    assert_right(analysis)


def test_without_recordings_of_the_last_cart_nothing_is_identified(session):
    """If the last cart has no recording, nothing is identified and the report fails."""
    path = session / "submission.toml"
    text = path.read_text(encoding="utf-8").partition('[[experiments]]\nid = "control"')[0]
    path.write_text(text, encoding="utf-8")
    change(session, "carts = 2", "carts = 3")
    change(session, "springs = [false, true, true]", "springs = [false, true, true, true]")
    analysis = analyse(load_submission(session))
    assert (analysis.chain, analysis.feedback) == (None, None)
    assert "fit.identified" in failed(analysis)
    assert any("cart 3" in skip.reason for skip in analysis.skipped)


@pytest.mark.parametrize("kind", ["step-3", "sine-05"])
def test_a_coarse_encoder_that_freezes_for_half_a_second_is_found(kind, tmp_path):
    """A freeze of half a second is found, if the cart moves far before the encoder counts again."""
    write_submission(tmp_path, replace(preset_bench(PRESET), count=0.03), seed=5, compact=True)

    def freeze(columns: Columns) -> Columns:
        x = columns["x1"].copy()
        first = int(np.argmax(np.abs(np.diff(x))))
        x[first : first + 60] = x[first]
        return {**columns, "x1": x}

    (name,) = spoil(files(tmp_path, kind), freeze)
    (one,) = analysed(tmp_path).left_out
    assert (one.run, one.excludes) == (name, "wrong")
    assert one.code.startswith("froze")


def test_files_with_fewer_decimals_are_not_in_another_unit(session):
    """Rounded recordings are honest."""
    for kind, decimals in {"decay": 1, "step": 1, "sine": 2}.items():
        rounded = lambda c, d=decimals: {**c, **{x: c[x].round(d) for x in ("x1", "x2")}}  # noqa: E731
        spoil(files(session, kind), rounded)
    assert analysed(session).left_out == ()


def test_sticking_carts_are_not_in_another_unit_of_time(bench):
    """If carts stick and creep, the recording is not taken for one in another unit of time."""
    chain = PRESETS[PRESET]
    dwell = next(r for r in analysed(bench).records if r.kind == "sine")
    creep = 0.02 * dwell.t / dwell.t[-1]  # in cm; nine encoder steps in total
    stuck = replace(dwell, y=np.array([creep, 0.7 * creep]))
    assert find_correction(stuck, chain, record_fits([stuck], chain)[stuck.id]) is None


@pytest.mark.slow
@pytest.mark.sample
def test_a_cart_moving_too_far_blames_no_gain(session):
    """If cart 2 seems to move farther than the cart that pulls it, only the data are flagged.

    In the test, the column of cart 2 is in millimetres in every file.
    """
    spoil([p for p in files(session, "") if "x2" in p.read_text("utf-8")[:99]], times(10, "x2"))
    analysis, grade = graded(session)
    found = {one.experiment: one.reason for one in analysis.left_out}
    steps = [path.stem for path in files(session, "step")]
    assert all("cart 2" in found[name] for name in steps)
    assert [flag.code for flag in grade.flags] == ["data_problem"]
