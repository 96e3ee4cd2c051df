"""Recordings may be in a wrong unit: counts stated as cm, or an input that is far too large."""

import csv
from pathlib import Path

import pytest

from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric_file import load_rubric
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse

COUNT = 0.00227  # cm


def scaled(folder: Path, column: str, factor: float, *, whole: bool = False) -> Path:
    """Write a submission and multiply one column of each recording."""
    write_submission(folder, "throne-1dof", seed=3, compact=True, reported=True)
    for path in (folder / "data").glob("*.csv"):
        with path.open(encoding="utf-8", newline="") as file:
            head, *rows = csv.reader(file)
        at = head.index(column)
        for row in rows:
            value = factor * float(row[at])
            row[at] = str(round(value)) if whole else f"{value:.10g}"
        with path.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([head, *rows])
    return folder


def grade(folder: Path, *, per_count: float | None = None) -> Grade:
    submission, rubric = load_submission(folder), load_rubric(Path("throne-1dof"))
    if per_count is not None:
        position = submission.system.position.model_copy(update={"per_count": per_count})
        system = submission.system.model_copy(update={"position": position})
        submission = submission.model_copy(update={"system": system})
    return grade_submission(submission, rubric=rubric, name="team").grade


@pytest.fixture(scope="module")
def in_counts(tmp_path_factory):
    return scaled(tmp_path_factory.mktemp("counts"), "x1", 1 / COUNT, whole=True)


def test_counts_stated_as_centimetres_fail_a_check(in_counts):
    """Recordings in counts that are stated as centimetres fail a check.

    The check of the closed loop fails too, since no stated gain fits positions in counts.
    """
    failed = [c.id.split(".")[0] for c in analyse(load_submission(in_counts)).checks
              if c.outcome == "fail"]  # fmt: skip
    assert failed == ["position_scale", "hardware"]  # no stated gain agrees with gains in counts


def test_no_gain_is_judged_if_recordings_are_in_counts(in_counts):
    """If the recordings are in counts, they are flagged, and no reported gain is judged."""
    graded = grade(in_counts)
    assert [flag.code for flag in graded.flags] == ["data_problem"]
    outcomes = {c.id: c.outcome for c in graded.criteria if c.outcome != "pass"}
    assert outcomes == {
        "data": "partial", "initial-gains": "skip", "final-gains": "skip", "hardware": "skip"
    }  # fmt: skip


def test_a_stated_length_of_a_count_makes_the_gain_known(in_counts):
    """If the rubric states the length of a count, gains are judged in units of length."""
    outcomes = {c.id: c.outcome for c in grade(in_counts, per_count=COUNT).criteria}
    assert outcomes["initial-gains"] == outcomes["final-gains"] == "pass"
    off = {c.id: c.outcome for c in grade(in_counts, per_count=2 * COUNT).criteria}
    # A factor of two in both tables is one mistake, which is charged once.
    assert (off["initial-gains"], off["final-gains"]) == ("pass", "fail")


def test_an_input_in_a_wrong_unit_is_flagged(tmp_path):
    """If the input is 10,000 times too large, it is flagged, and no gain is judged."""
    graded = grade(scaled(tmp_path / "team", "input", 1e4))
    assert [flag.code for flag in graded.flags] == ["data_problem"]
    assert {c.id: c.outcome for c in graded.criteria}["final-gains"] == "skip"


@pytest.mark.parametrize("units", [1e3, 1e6])
def test_a_time_in_milliseconds_costs_no_number_of_the_tables(tmp_path, units):
    """If the clock counts milliseconds, one flag names it, and right numbers are right."""
    graded = grade(scaled(tmp_path, "time", units))
    assert [flag.code for flag in graded.flags] == ["data_problem"]
    outcomes = {c.id: c.outcome for c in graded.criteria if c.outcome != "pass"}
    assert outcomes == {"data": "partial", "hardware": "skip"}


def test_a_unit_that_the_encoder_contradicts_is_noted(tmp_path):
    """If positions in centimetres are stated as millimetres, the grade has a note."""
    folder = scaled(tmp_path, "x1", 1.0)
    toml = folder / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace('unit = "cm"', 'unit = "mm"'), encoding="utf-8")
    (check,) = [c for c in analyse(load_submission(folder)).checks if c.kind == "position_unit"]
    assert check.message in grade(folder).notes
