"""What `inspect` shows of a file: form, columns, clock, kind, problems."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from pipeline.errors import SubmissionError
from pipeline.ingest.files import data_files_in
from pipeline.ingest.inspect import (
    Inspection,
    format_inspection,
    format_inspections,
    inspect_file,
)
from pipeline.ingest.text import CSV
from tests.helpers.recordings import facts

RATE = 200.0
T = np.arange(2000) / RATE
X = np.round(300 * np.exp(-0.5 * T) * np.cos(12 * T)) * 0.00227
STEP = np.where((T > 1) & (T < 6), 1.0, 0.0)


def inspect(folder: Path, **columns: np.ndarray) -> Inspection:
    """Write columns as CSV and inspect the file."""
    rows = zip(*columns.values(), strict=True)
    text = ",".join(columns) + "\n" + "".join(",".join(f"{v:.7g}" for v in r) + "\n" for r in rows)
    (folder / "a.csv").write_text(text)
    return inspect_file(folder / "a.csv")


def test_the_essentials_are_printed(tmp_path):
    """`inspect` shows format, samples, rate, duration, roles, ranges and the encoder step."""
    got = inspect(tmp_path, time=T, input=STEP, x1=X, remark=0 * T)
    assert got.format == CSV.title
    assert got.samples == 2000
    assert got.rate == pytest.approx(RATE)
    assert got.duration == pytest.approx(1999 / RATE)
    assert got.jitter == pytest.approx(0.0, abs=1e-9)
    assert [column.role for column in got.columns] == ["time", "input", "x1", None]
    assert got.columns[2].high == pytest.approx(0.681)
    assert got.columns[2].step == pytest.approx(0.00227, rel=1e-6)
    assert [(note.code, note.about) for note in facts(got.problems).values()] == [
        ("unused", "remark")
    ]
    assert got.positions.keys() == set(got.moving) == {1}
    assert got.unusable == ()


KINDS = {
    "decay": {"input": 0 * T},
    "step": {"input": STEP},
    "sine": {"input": 0.3 * np.sin(2 * np.pi * 4.0 * T)},
    "sweep": {"input": np.sin((1 + 3 * T) * T)},
    # In open loop an ECP also logs its effort as the target, in counts and between two samples.
    "sweep, logged twice": {
        "input": np.sin((1 + 3 * T) * T),
        "reference": np.rint(50 * np.sin((1 + 3 * (T - 0.6 / RATE)) * (T - 0.6 / RATE))),
    },
    "closed_loop": {"input": np.exp(-T) * np.sin(9 * T), "reference": STEP},
}


@pytest.mark.parametrize(("kind", "signals"), KINDS.items(), ids=KINDS.keys())
def test_the_kind_is_guessed(kind, signals, tmp_path):
    """The kind of experiment is guessed from the shape of the input and from a reference."""
    got = inspect(tmp_path, time=T, x1=X, **signals)
    assert got.kind == kind.split(",")[0]
    if kind == "sine":
        assert got.frequency == pytest.approx(4.0, rel=0.01)  # 10 s resolve 0.1 Hz
    else:
        assert got.frequency is None


@pytest.mark.parametrize(("counts", "moving"), [(2, ()), (3, (2,)), (9, (2,))])
def test_a_cart_that_moves_by_three_counts_is_free(counts, moving, tmp_path):
    """A cart moves if its position changes by more than two encoder steps."""
    x2 = np.round(counts * (0.5 - 0.5 * np.cos(12 * T)))
    got = inspect(tmp_path, time=T, input=STEP, x1=np.round(300 * np.sin(9 * T)), x2=x2)
    assert got.moving == (1, *moving)
    assert got.hardly_moving == moving


def test_a_sample_of_a_binary_file_is_counted_from_one(tmp_path):
    """If the time of a .mat file stands still, the message names the sample."""
    stamps = 0.1 * np.arange(40)
    stamps[12] = stamps[11]
    scipy.io.savemat(tmp_path / "a.mat", {"time": stamps, "x1": np.arange(40.0) ** 2})
    (said,) = inspect_file(tmp_path / "a.mat").unusable
    assert said.startswith("sample 13:")


def test_a_bode_table_is_recognised(tmp_path):
    """A file with a frequency column is read as a table of amplitude ratios."""
    got = inspect(tmp_path, frequency=np.arange(1.0, 9.0), x1=np.ones(8))
    assert got.kind == "bode"
    assert (got.rate, got.duration, got.problems) == (None, None, ())


def _frozen() -> np.ndarray:
    x = np.round(300 * np.sin(8 * T))
    x[500:540] = x[499]
    return x


uneven = np.cumsum(np.random.default_rng(1).uniform(0.003, 0.007, T.size))
CUT_SINE = np.round(np.clip(2 * np.sin((2 + T) * T), -1.5, 1.5), 6)
# The code of the note, its column, and its samples.
PROBLEMS = {
    "stuck": ({"time": T, "x1": _frozen()}, "stuck", "x1", (499, 539)),
    "dead": ({"time": T, "x1": X, "x2": 0 * T}, "never_changes", "x2", ()),
    "clipped": (
        {"time": T, "x1": X, "input": CUT_SINE},
        "clipped", "", tuple(np.flatnonzero(np.abs(CUT_SINE) == 1.5)),
    ),
    "gap": ({"time": T + (T > 5), "x1": X}, "gap", "", (1001,)),
    "rounding": ({"time": np.round(T * 1.013, 3), "x1": X}, "rounded", "time", ()),
    "uneven": ({"time": uneven, "x1": X}, "uneven", "time", ()),
    "milliseconds": ({"time": 1e3 * T, "x1": X}, "slow", "time", ()),
    "no time": ({"input": STEP, "x1": X}, "no_clock", "", ()),
    "no position": ({"time": T, "input": STEP}, "no_position", "", ()),
    "force": ({"time": T, "my_drive": STEP, "x1": X}, "perhaps_input", "my_drive", ()),
}  # fmt: skip


@pytest.mark.parametrize(("columns", "code", "about", "at"), PROBLEMS.values(), ids=PROBLEMS.keys())
def test_problems_are_named(columns, code, about, at, tmp_path):
    """`inspect` names problems that would spoil a report, and the column and the samples."""
    note = facts(inspect(tmp_path, **columns).problems)[code]
    assert (note.about, note.at) == (about, at)


UNUSABLE = {
    "pasted": ({"time": np.r_[T, T], "x1": np.r_[X, X]}, "line 2002:"),
    "still": ({"time": np.r_[T, T[-1]], "x1": np.r_[X, 0]}, "line 2002:"),
    "two of one": ({"time": T, "input": STEP, "u": STEP, "x1": X}, "'u'"),
    "one": ({"time": T[:1], "x1": X[:1]}, "found 1"),
    "few": ({"time": T[:7], "x1": X[:7]}, "found 7"),
}


@pytest.mark.parametrize(("columns", "where"), UNUSABLE.values(), ids=UNUSABLE.keys())
def test_what_would_stop_a_report_makes_a_file_unusable(columns, where, tmp_path):
    """A clock that goes back, two inputs or too few samples stop a report, with their place."""
    got = inspect(tmp_path, **columns)
    assert any(where in said for said in got.unusable), got.unusable
    assert set(got.unusable) <= set(got.problems)


def test_a_last_line_that_is_cut_is_skipped(tmp_path):
    """If the last line of a file is cut, `inspect` names the line, and the file can be used."""
    inspect(tmp_path, time=T, x1=X)
    text = (tmp_path / "a.csv").read_text().rstrip("\n")
    (tmp_path / "a.csv").write_text(text + "\n10.0")
    got = inspect_file(tmp_path / "a.csv")
    assert got.samples == 2000
    assert (got.unusable, got.cut_short) == ((), True)
    assert facts(got.problems)["cut_row"].at == (2002,)
    assert len(got.problems) == 1


def test_an_oscilloscope_that_names_its_units_beside_the_rows_is_no_decay(tmp_path):
    """Old Tektronix files have their settings beside the first rows: volts are not a position."""
    beside = ["Record Length,2000", "Source,CH1", "Vertical Units,V", "Horizontal Units,s"]
    beside += [","] * (T.size - len(beside))
    rows = (f"{said},,{t:.5f},{x:.5f},\n" for said, t, x in zip(beside, T, X, strict=True))
    (tmp_path / "F0000CH1.CSV").write_text("".join(rows))
    got = inspect_file(tmp_path / "F0000CH1.CSV")
    assert [column.name for column in got.columns] == ["TIME [s]", "CH1 [V]"]
    assert got.kind is None


@pytest.mark.parametrize(("unit", "refused"), [("V", False), ("furlong", True), ("cm", False)])
def test_a_position_in_a_unit_that_is_not_known_cannot_be_used(unit, refused, tmp_path):
    """A submission may state that a position is in V, but not what an unknown unit means."""
    got = inspect(tmp_path, **{"time": T, "input": STEP, f"x1 [{unit}]": X})
    assert any(unit in said for said in got.problems) == (unit != "cm")
    assert any(unit in said for said in got.unusable) == refused


def test_the_text_and_the_json_say_the_same(tmp_path):
    """Every problem and column is in the text and in the JSON, and the JSON has no NaN."""
    got = inspect(tmp_path, time=np.round(T * 1.013, 3), input=0.3 * np.sin(25 * T), x1=_frozen())
    text, plain = format_inspection(got), json.loads(json.dumps(got.to_dict(), allow_nan=False))
    assert plain["kind"] == "sine"
    assert plain["columns"][2]["role"] == "x1"
    assert got.frequency == pytest.approx(25 / (2 * np.pi) / 1.013, rel=0.01)
    assert f"{got.frequency:.4g}" in text
    assert all(problem in text for problem in plain["problems"])
    assert len(plain["problems"]) == 2


def test_columns_without_names_get_a_suggestion(tmp_path):
    """For a matrix in the order of an ECP export, `inspect` prints a `columns` line to use."""
    counts = np.round(300 * np.sin(8 * T))
    copy = np.round(0.5 * counts + 0.5 * np.r_[0.0, counts[:-1]])
    matrix = np.column_stack([np.arange(T.size), T, copy, counts, -counts, -0.5 * STEP])
    scipy.io.savemat(tmp_path / "a.mat", {"data": matrix})
    got = inspect_file(tmp_path / "a.mat")
    assert got.guessed == {"time": 2, "input": 6, "x1": 4, "x2": 5}
    line = ", ".join(f"{role} = {number}" for role, number in got.guessed.items())
    assert line in facts(got.problems)["no_names"]
    assert [column.name for column in got.columns] == ["1", "2", "3", "4", "5", "6"]
    assert "-0 " not in format_inspection(got)
    assert not format_inspection(got).endswith("-0")


def test_columns_without_a_clock_get_no_suggestion(tmp_path):
    """If no column is a clock, columns and rate must be stated, and the message names both."""
    scipy.io.savemat(tmp_path / "a.mat", {"data": np.column_stack([X, STEP, np.sin(9 * T)])})
    got = inspect_file(tmp_path / "a.mat")
    assert got.needs == ("columns", "sample_rate")
    (said,) = got.problems
    assert [*facts(got.problems)] == ["no_names"]
    assert all(key in said for key in got.needs)


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
def test_a_link_may_be_inspected(tmp_path):
    """A link to one's own file may be inspected."""
    inspect(tmp_path, time=T, x1=X)
    (tmp_path / "link").symlink_to(tmp_path / "a.csv")
    assert inspect_file(tmp_path / "link").samples == 2000


def test_a_path_without_recordings_is_one_line(tmp_path):
    """A missing file, or a folder without recordings, gives one line of error."""
    typed = tmp_path / "none.csv"
    with pytest.raises(SubmissionError, match=r"'none\.csv'") as caught:
        inspect_file(typed)
    assert str(caught.value).startswith(f"{typed}: ")
    (tmp_path / "words.csv").write_text("no numbers here")
    with pytest.raises(SubmissionError) as caught:
        inspect_file(tmp_path / "words.csv")
    assert str(caught.value).startswith(f"{tmp_path / 'words.csv'} line 1: ")
    with pytest.raises(SubmissionError, match="folder"):
        inspect_file(tmp_path)


def test_a_folder_gives_one_line_per_file(tmp_path):
    """For a folder, `inspect` prints one line per file of `data/`, and then the problems."""
    (tmp_path / "data").mkdir()
    inspect(tmp_path / "data", time=T, input=STEP, x1=X)
    (tmp_path / "data" / "photo.jpg").write_bytes(b"no data")
    files = data_files_in(tmp_path)
    assert [file.name for file in files] == ["a.csv"]
    head, line, *problems = format_inspections([inspect_file(file) for file in files]).splitlines()
    assert head.split()[:2] == ["file", "format"]
    assert line.split()[-3:] == ["time", "input", "x1"]
    assert all(problem.startswith("! ") for problem in problems)


def test_a_problem_of_many_files_is_printed_once(tmp_path):
    """A problem that six files share is printed once, under their table."""
    (tmp_path / "data").mkdir()
    for number in range(6):
        inspect(tmp_path / "data", time=np.round(T, 2), input=STEP, x1=X)
        (tmp_path / "data" / "a.csv").rename(tmp_path / "data" / f"{number}.csv")
    files = data_files_in(tmp_path)
    looked = [inspect_file(file) for file in files]
    assert all(any("rounded" in problem for problem in one.problems) for one in looked)
    assert format_inspections(looked).count("rounded") == 1
