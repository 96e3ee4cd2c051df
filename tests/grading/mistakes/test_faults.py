"""A recording that is not what it claims to be is named and left out; honest ones stay."""

import csv
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.estimation.record_fit import find_correction, record_fits
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric_file import load_rubric
from pipeline.identify.recording_checks import find_bad_recordings
from pipeline.plant.chain import PRESETS
from pipeline.results import Analysis
from pipeline.simulated.hidden import preset_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse

PRESET = "throne-2dof"
TRUE = PRESETS[PRESET].parameters()

Columns = dict[str, Array]
Spoil = Callable[[Columns], Columns]


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Path:
    """Write a whole session: two decays per cart, four steps, dwells, a sweep and a closed loop."""
    folder = tmp_path_factory.mktemp("bench")
    write_submission(folder, PRESET, seed=3, compact=True, reported=True)
    return folder


def files(folder: Path, start: str) -> list[Path]:
    return sorted((folder / "data").glob(f"{start}*.csv"))


def spoil(path: Path, how: Spoil) -> None:
    """Change a data file and write it again."""
    with path.open(encoding="utf-8", newline="") as text:
        heading, *rows = csv.reader(text)
    values = how(dict(zip(heading, np.array(rows, dtype=np.float64).T, strict=True)))
    lines = [
        ",".join(heading),
        *(",".join(map(repr, r.tolist())) for r in np.array([*values.values()]).T),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def exchanged(columns: Columns) -> Columns:
    return {**columns, "x1": columns["x2"], "x2": columns["x1"]}


def in_milliseconds(columns: Columns) -> Columns:
    return {**columns, "time": 1000 * columns["time"]}


def dead(name: str) -> Spoil:
    return lambda columns: {**columns, name: 0 * columns[name]}


def times(factor: float, *names: str) -> Spoil:
    return lambda columns: {**columns, **{name: factor * columns[name] for name in names}}


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
def test_spoilt_recordings_are_named_left_out_and_flagged(case, sign, bench, tmp_path):
    """Only the spoilt recordings are named, left out of all estimates and flagged.

    The report and the grade give the reason.
    """
    kind, which, how, word = SPOILT[case]
    folder = shutil.copytree(bench, tmp_path / "spoilt")
    _change(folder, ", sign = 1", sign)
    paths = files(folder, kind)[which]
    for path in paths:
        spoil(path, how)
    graded = grade_submission(
        load_submission(folder), rubric=load_rubric(Path(PRESET)), name="team"
    )
    analysis = graded.analysis
    assert analysis is not None
    assert {one.experiment for one in analysis.left_out} == {path.stem for path in paths}
    assert all(one.is_wrong and word in one.reason for one in analysis.left_out)
    assert f"record.{paths[0].stem}" in _failed(analysis)
    (flag,) = graded.grade.flags
    assert flag.code == "data_problem"
    assert set(flag.parameters) == {path.stem for path in paths}
    _numbers_are_right(analysis)


def _change(folder: Path, old: str, new: str) -> None:
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def _failed(analysis: Analysis) -> set[str]:
    return {check.id for check in analysis.checks if check.outcome == "fail"}


def _numbers_are_right(analysis: Analysis) -> None:
    """Check that no estimate uses a spoilt recording."""
    for row in analysis.rows:
        assert row.final is not None
        assert row.final.value == pytest.approx(TRUE[row.name], rel=0.02)
        if row.initial is not None and row.initial.source in ("step", "log_decrement"):
            assert row.initial.value == pytest.approx(TRUE[row.name], rel=0.02)


def test_dwells_that_are_too_short_are_flagged(bench, tmp_path):
    """A dwell with less than 1.5 cycles is flagged as too short for a steady state."""
    folder = shutil.copytree(bench, tmp_path / "cut")
    for path in files(folder, "sine"):
        spoil(path, cut)
    graded = grade_submission(
        load_submission(folder), rubric=load_rubric(Path(PRESET)), name="team"
    )
    assert graded.analysis is not None
    (flag,) = graded.grade.flags
    frequency = {r.id: (r.omega or 0.0) / (2 * np.pi) for r in graded.analysis.records}
    assert len(flag.parameters) >= 8
    assert all(60 * 0.00884 * frequency[name] < 1.5 for name in flag.parameters)


@pytest.mark.parametrize(
    ("kind", "stated", "word"),
    [("step", "decay", "free decay"), ("sine", "step", "not a step"), ("step", "cut", "truncated")],
)
def test_a_cut_recording_or_one_of_another_kind_is_flagged(kind, stated, word, bench, tmp_path):
    """A recording that is cut off or of another kind is flagged, and a check of the report fails.

    No estimate uses the recording.
    """
    folder = shutil.copytree(bench, tmp_path / "kind")
    path = files(folder, kind)[1]
    if stated == "cut":
        spoil(path, lambda columns: {k: v[: v.size // 3] for k, v in columns.items()})
    else:
        table = f'id = "{path.stem}"\nkind = '
        _change(folder, f'{table}"{kind}"', f'{table}"{stated}"')
    graded = grade_submission(
        load_submission(folder), rubric=load_rubric(Path(PRESET)), name="team"
    )
    assert graded.analysis is not None
    (one,) = graded.analysis.left_out
    assert (one.experiment, one.is_wrong) == (path.stem, True)
    assert word in one.reason
    assert f"record.{path.stem}" in _failed(graded.analysis)
    assert path.stem in {name for flag in graded.grade.flags for name in flag.parameters}
    _numbers_are_right(graded.analysis)


@pytest.mark.parametrize("which", [slice(1), slice(None)])
def test_decays_in_millimetres_give_a_warning_and_are_used(which, bench, tmp_path):
    """If one or all decays are in millimetres, a warning names them, and no check fails."""
    folder = shutil.copytree(bench, tmp_path / "spoilt")
    paths = files(folder, "decay")[which]
    for path in paths:
        spoil(path, times(10, "x1", "x2"))
    analysis = analyse(load_submission(folder), design=False)
    assert not analysis.left_out
    assert not _failed(analysis)
    told = [text for text in analysis.warnings if "another unit" in text]
    assert paths[0].stem in told[0]


def test_frequencies_in_rad_per_s_stated_as_hz_are_named(bench, tmp_path):
    """If frequencies in rad/s were stated as Hz, the reason given for each file says so."""
    folder = shutil.copytree(bench, tmp_path / "spoilt")
    path = folder / "submission.toml"
    path.write_text(
        re.sub(
            r"frequency = ([\d.]+)",
            lambda found: f"frequency = {2 * np.pi * float(found[1]):.3f}",
            path.read_text(encoding="utf-8"),
        ),
        encoding="utf-8",
    )
    problems = find_bad_recordings(analyse(load_submission(folder), design=False))
    assert problems
    assert all("rad/s" in one.reason for one in problems.values())


def test_a_missing_list_of_free_carts_is_named_with_its_fix(bench, tmp_path):
    """If the key `carts` is missing although a cart was held, the message gives the line to add.

    Without this key, all carts count as free.
    """
    folder = shutil.copytree(bench, tmp_path / "spoilt")
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8").replace("carts = [1]\n", "", 1)
    path.write_text(text, encoding="utf-8")
    (one,) = analyse(load_submission(folder), design=False).left_out
    assert "write carts = [1]" in one.reason


def test_a_loop_that_is_left_out_is_not_compared(bench, tmp_path):
    """A closed loop with a clock in milliseconds is not compared with the model."""
    folder = shutil.copytree(bench, tmp_path / "loop")
    for path in files(folder, "control"):
        spoil(path, in_milliseconds)
    analysis = analyse(load_submission(folder))
    assert [one.experiment for one in analysis.left_out] == ["control"]
    assert analysis.hardware == ()
    (skip,) = [s for s in analysis.skipped if s.name == "hardware check, control"]
    assert "milliseconds" in skip.reason


def test_a_sound_repeat_is_kept_if_most_have_swapped_columns(bench, tmp_path):
    """If three of four steps have swapped columns, only these three are left out.

    The report does not advise another sign.
    """
    folder = shutil.copytree(bench, tmp_path / "most")
    steps = files(folder, "step")
    for path in steps[:3]:
        spoil(path, exchanged)
    analysis = analyse(load_submission(folder), design=False)
    assert {one.experiment for one in analysis.left_out} == {path.stem for path in steps[:3]}
    assert {gain.experiment for gain in analysis.step_gains} == {steps[3].stem}
    assert not any("sign = " in warning for warning in analysis.warnings)


def test_times_in_milliseconds_throughout_fail_a_check(bench, tmp_path):
    """If all times are in milliseconds, a check finds all dwell frequencies 1000 times off."""
    folder = shutil.copytree(bench, tmp_path / "slow")
    for path in files(folder, ""):
        spoil(path, in_milliseconds)
    graded = grade_submission(
        load_submission(folder), rubric=load_rubric(Path(PRESET)), name="team"
    )
    assert graded.grade.status == "graded"
    assert graded.analysis is not None
    (check,) = [c for c in graded.analysis.checks if c.id == "dwells.frequency"]
    assert check.outcome == "fail"
    assert check.value == pytest.approx(1000, rel=0.01)
    assert "milliseconds" in check.message


def test_one_recording_in_two_experiments_counts_once(bench, tmp_path):
    """If two repeats name the same file, the second is left out and flagged."""
    folder = shutil.copytree(bench, tmp_path / "copied")
    _change(folder, "data/step-2.csv", "data/step-1.csv")
    graded = grade_submission(
        load_submission(folder), rubric=load_rubric(Path(PRESET)), name="team"
    )
    assert graded.analysis is not None
    assert {one.experiment for one in graded.analysis.left_out} == {"step-2"}
    assert ["step-2"] in [list(f.parameters) for f in graded.grade.flags]


@pytest.mark.slow
@pytest.mark.sample
def test_columns_swapped_in_every_recording_are_named(bench, tmp_path):
    """If the columns of all driven recordings are swapped, the reason says so.

    Then no parameters are identified.
    """
    folder = shutil.copytree(bench, tmp_path / "exchanged")
    driven = [*files(folder, "step"), *files(folder, "sine"), *files(folder, "sweep")]
    for path in driven:
        spoil(path, exchanged)
    analysis = analyse(load_submission(folder), design=False)
    assert {one.experiment for one in analysis.left_out} == {path.stem for path in driven}
    assert {one.reason for one in analysis.left_out} == {analysis.left_out[0].reason}
    assert 'columns = { x1 = "x2", x2 = "x1" }' in analysis.left_out[0].reason
    assert "fit.identified" in _failed(analysis)


def test_contradicting_dwells_and_steps_identify_nothing(bench, tmp_path):
    """If the inputs of dwells and steps disagree by a factor of ten, nothing is identified.

    The report gives two possible explanations: wrong dwells or wrong steps.
    """
    folder = shutil.copytree(bench, tmp_path / "undecided")
    for path in files(folder, "sine"):
        spoil(path, times(10, "input"))
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8")
    runs = text.split("[[experiments]]")
    kept = [run for run in runs if 'kind = "sweep"' not in run]
    assert len(kept) == len(runs) - 1
    path.write_text("[[experiments]]".join(kept), encoding="utf-8")
    analysis = analyse(load_submission(folder), design=False)
    both = {path.stem for path in [*files(folder, "sine"), *files(folder, "step")]}
    assert {one.experiment for one in analysis.left_out} == both
    assert {one.code for one in analysis.left_out} == {"contradicting_kinds"}
    assert analysis.chain is None
    initial = {row.name for row in analysis.rows if row.initial is not None}
    assert initial == {"omega_1", "omega_2", "zeta_1", "zeta_2"}


def test_a_recording_of_no_linear_carts_is_left_out_but_not_called_wrong(bench, tmp_path):
    """A recording that linear carts cannot produce is left out, but not called wrong.

    In the test, something besides the input moves the cart.
    """
    folder = shutil.copytree(bench, tmp_path / "stray")
    path = files(folder, "sine")[4]

    def another(columns: Columns) -> Columns:
        x = 2 * np.sin(17 * columns["time"] + 5 * columns["time"] ** 2)
        return {**columns, "x1": x, "x2": x}

    spoil(path, another)
    analysis = analyse(load_submission(folder), design=False)
    assert [(one.experiment, one.is_wrong) for one in analysis.left_out] == [(path.stem, False)]
    _numbers_are_right(analysis)


def test_without_recordings_of_the_last_cart_nothing_is_identified(bench, tmp_path):
    """If the last cart has no recording, nothing is identified and the report fails."""
    folder = shutil.copytree(bench, tmp_path / "three")
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8").partition('[[experiments]]\nid = "control"')[0]
    text = text.replace("carts = 2", "carts = 3")
    text = text.replace("springs = [false, true, true]", "springs = [false, true, true, true]")
    path.write_text(text, encoding="utf-8")
    analysis = analyse(load_submission(folder))
    assert analysis.chain is None
    assert analysis.feedback is None
    assert "fit.identified" in _failed(analysis)
    assert any("cart 3 moves in no recording" in skip.reason for skip in analysis.skipped)


@pytest.mark.parametrize("kind", ["step-3", "sine-05"])
def test_a_coarse_encoder_that_freezes_for_half_a_second_is_found(kind, tmp_path):
    """A freeze of half a second is found even with a coarse encoder.

    In the test, the cart has moved far before the encoder counts again.
    """
    write_submission(tmp_path, replace(preset_bench(PRESET), count=0.03), seed=5, compact=True)
    (path,) = files(tmp_path, kind)

    def freeze(columns: Columns) -> Columns:
        x = columns["x1"].copy()
        first = int(np.argmax(np.abs(np.diff(x))))
        x[first : first + 60] = x[first]
        return {**columns, "x1": x}

    spoil(path, freeze)
    analysis = analyse(load_submission(tmp_path), design=False)
    (one,) = analysis.left_out
    assert (one.run, one.excludes) == (path.stem, "wrong")
    assert one.code.startswith("froze")


def test_files_with_fewer_decimals_are_not_in_another_unit(bench, tmp_path):
    folder = shutil.copytree(bench, tmp_path / "rounded")
    for kind, decimals in {"decay": 1, "step": 1, "sine": 2}.items():
        for path in files(folder, kind):
            spoil(path, lambda c, d=decimals: {**c, **{x: c[x].round(d) for x in ("x1", "x2")}})
    assert analyse(load_submission(folder), design=False).left_out == ()


def test_sticking_carts_are_not_in_another_unit_of_time(bench):
    """If carts stick and creep, the recording is not taken for one in another unit of time."""
    chain = PRESETS[PRESET]
    dwell = next(
        r for r in analyse(load_submission(bench), design=False).records if r.kind == "sine"
    )
    creep = 0.02 * dwell.t / dwell.t[-1]  # in cm; nine encoder steps in total
    stuck = replace(dwell, y=np.array([creep, 0.7 * creep]))
    assert find_correction(stuck, chain, record_fits([stuck], chain)[stuck.id]) is None


@pytest.mark.slow
@pytest.mark.sample
def test_a_cart_moving_too_far_blames_no_gain(bench, tmp_path):
    """If cart 2 seems to move farther than the cart that pulls it, no gain is called wrong.

    In the test, the column of cart 2 is in millimetres in every file. Only the data are flagged.
    """
    folder = shutil.copytree(bench, tmp_path / "millimetres")
    for path in files(folder, ""):
        head = path.read_text(encoding="utf-8").partition("\n")[0]
        if "x2" in head.split(","):
            spoil(path, times(10, "x2"))
    graded = grade_submission(
        load_submission(folder), rubric=load_rubric(Path(PRESET)), name="team"
    )
    assert graded.analysis is not None
    steps = [one for one in graded.analysis.left_out if one.experiment.startswith("step")]
    assert len(steps) == len(files(folder, "step"))
    assert all("cart 2" in one.reason for one in steps)
    assert [flag.code for flag in graded.grade.flags] == ["data_problem"]
