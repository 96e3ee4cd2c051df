"""In the demo's class, grading finds exactly the planted mistakes."""

from pathlib import Path

import pytest

from pipeline.grading.batch.grade_class import Options, grade_class
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.simulated.examples import PRESET, write_class


@pytest.mark.slow
@pytest.mark.sample
def test_only_the_slip_and_the_copy_are_flagged(tmp_path):
    """Team 1 has all points, team 2 is flagged for Hz, and teams 2 and 3 for a shared recording."""
    write_class(tmp_path / "class")
    assert [p.name for p in tmp_path.iterdir()] == ["class"]
    grade_class(
        [tmp_path / "class"],
        rubric_file=Path(PRESET),
        out=tmp_path / "grades",
        options=Options(figures=False),
    )
    with Gradebook(tmp_path / "grades") as book:
        grades = {line.submission: line.grade for line in book.entries()}
    flags = {name: {flag.code for flag in grade.flags} for name, grade in grades.items()}
    assert flags == {
        "team-1": set(),
        "team-2": {"hz_for_rad_s", "shared_data"},
        "team-3": {"shared_data"},
    }
    assert grades["team-1"].points == grades["team-1"].out_of
    assert grades["team-2"].points < grades["team-2"].out_of
