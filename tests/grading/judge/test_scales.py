"""Recordings may be in a wrong unit: counts stated as cm, or an input that is far too large."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric_file import load_rubric
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.spoilt import Columns, change, files, spoil

COUNT = 0.00227  # cm


def scaled(folder: Path, column: str, factor: float, *, whole: bool = False) -> Path:
    """Write a submission and multiply one column of each recording."""

    def scale(columns: Columns) -> Columns:
        values = factor * columns[column]
        return {**columns, column: np.round(values) if whole else values}

    write_submission(folder, "throne-1dof", seed=3, compact=True, reported=True)
    spoil(files(folder), scale)
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


@pytest.mark.parametrize(
    ("column", "factor", "skipped"),
    [
        ("input", 1e4, {"initial-gains", "final-gains", "hardware"}),
        ("time", 1e3, {"hardware"}),
        ("time", 1e6, {"hardware"}),
    ],
)
def test_a_column_in_a_wrong_unit_costs_no_number_of_the_tables(tmp_path, column, factor, skipped):
    """One flag names the recordings; no gain is judged by a wrong input, all else is right."""
    graded = grade(scaled(tmp_path, column, factor))
    assert [flag.code for flag in graded.flags] == ["data_problem"]
    outcomes = {c.id: c.outcome for c in graded.criteria if c.outcome != "pass"}
    assert outcomes == {"data": "partial"} | dict.fromkeys(skipped, "skip")


def test_a_unit_that_the_encoder_contradicts_is_noted(tmp_path):
    """If positions in centimetres are stated as millimetres, the grade has a note."""
    folder = scaled(tmp_path, "x1", 1.0)
    change(folder, 'unit = "cm"', 'unit = "mm"')
    (check,) = [c for c in analyse(load_submission(folder)).checks if c.kind == "position_unit"]
    assert check.message in grade(folder).notes
