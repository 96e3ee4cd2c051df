"""The preview of a class under another rubric gives the same points as a new grading."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.grading.batch.runner import grade_batch
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Setup
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.publish.rubric_preview import preview_rubric
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import load_rubric
from tests.helpers.grades import fill_book, in_this_process
from tests.helpers.grading_students import write_team

RUBRIC = load_rubric(Path("throne-1dof"))
LATE = {"team-1": 1.3}


@pytest.fixture(scope="module")
def school(tmp_path_factory) -> Path:
    """Write four teams: honest, late with numbers in Hz, with a wrong gain, and unreadable."""
    folder = tmp_path_factory.mktemp("class")
    for number in range(3):
        own = write_team(folder / f"team-{number}", number)
        file = own / "submission.toml"
        text = file.read_text(encoding="utf-8")
        if number == 1:
            text = re.sub(r"omega_n = (\S+)", lambda m: f"omega_n = {float(m[1]) / 6.28:.3g}", text)
        if number == 2:
            text = re.sub(r"\bK = (\S+)", lambda m: f"K = {1.1 * float(m[1]):.3g}", text)
        file.write_text(text, encoding="utf-8")
    (folder / "team-3").mkdir()
    (folder / "team-3" / "submission.toml").write_text("version = 1\n", encoding="utf-8")
    return folder


def _grade(school: Path, out: Path, rubric: Rubric) -> Gradebook:
    book = Gradebook(out, create=True, assignment="lab")
    hand_ins = find_hand_ins([school], scratch=out)
    batch = grade_batch(
        [replace(one, days_late=LATE.get(one.id, 0.0)) for one in hand_ins],
        setup=Setup(rubric=rubric, scratch=out),
        book=book,
        execute=in_this_process,
    )
    book.finish(batch, rubric=rubric)
    return book


@pytest.mark.slow
@pytest.mark.sample
def test_the_preview_gives_the_points_of_a_new_grading(school, tmp_path):
    """The preview of a changed rubric gives the same points as a new grading.

    Points given by hand stay in both.
    """
    plain = RUBRIC.model_dump(mode="json")
    plain["late"]["percent_per_day"] = 40.0
    plain["flags"]["hz_for_rad_s"] = 0.75
    own = {criterion["id"]: criterion for criterion in plain["criteria"]}
    own["final-gains"] |= {"points": 4.5, "full_percent": 2.0, "none_percent": 12.0}
    own["pieces"]["points"] = 0.5
    now = Rubric.model_validate(plain)
    with _grade(school, tmp_path, RUBRIC) as book:
        book.override("team-2", "final-dampings", 1.25, why="a slip", by="Ada")
        before = {entry.submission: entry.grade.points for entry in book.entries()}

        shown = preview_rubric(book, now)

    with _grade(school, tmp_path, now) as book:
        again = {entry.submission: entry.grade for entry in book.entries()}
    assert {t.submission: (t.before, t.after, t.late_after) for t in shown.teams} == {
        name: (before[name], grade.points, grade.deducted)
        for name, grade in again.items()
        if grade.status == "graded"
    }
    for team in shown.teams:
        points = {criterion.id: criterion.points for criterion in again[team.submission].criteria}
        assert {c.id: c.after for c in team.criteria}.items() <= points.items()
    assert (shown.failed, shown.unknown, shown.needs) == (1, (), ())
    assert (shown.out_of_before, shown.out_of_after) == (20.0, now.out_of)
    by_hand = next(team for team in shown.teams if team.submission == "team-2")
    assert by_hand.by_hand == ("final-dampings",)
    assert "final-dampings" not in {criterion.id for criterion in by_hand.criteria}
    gains = [abs(team.gain) for team in shown.teams]
    assert gains == sorted(gains, reverse=True)
    assert len({team.gain for team in shown.teams}) == 3
    assert sum(shown.bars_before) == sum(shown.bars_after) == 3


def test_a_team_without_stored_findings_is_named(tmp_path):
    """If a grade has no stored findings, the preview names the team and shows no points."""
    fill_book(tmp_path)
    with Gradebook(tmp_path) as book:
        graded = [e.submission for e in book.entries() if e.grade.status == "graded"]
        shown = preview_rubric(book, book.rubric)
    assert sorted(shown.unknown) == sorted(graded)


@pytest.mark.slow
@pytest.mark.sample
def test_a_team_graded_by_another_rubric_is_named(school, tmp_path):
    """If a team was graded by another rubric, the preview names the team and shows no points."""
    plain = RUBRIC.model_dump(mode="json")
    plain["required"]["final"] = []
    other = Rubric.model_validate(plain)
    _grade(school, tmp_path, RUBRIC).close()
    with _grade(school / "team-0", tmp_path, other) as book:
        shown = preview_rubric(book, RUBRIC)
    assert shown.unknown == ("team-1", "team-2")
    assert [team.submission for team in shown.teams] == ["team-0"]
    assert shown.needs == ("required",)
