"""Criteria that a person grades, and changes of the total with a reason."""

import csv
import json
import re

import pytest

from pipeline.grading.grade import Criterion, Grade, read_grade
from pipeline.grading.gradebook.class_lines import GradeSummary
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import history_text
from pipeline.grading.gradebook.override import TOTAL, read_wishes
from pipeline.grading.gradebook.request_gradebook import points_lost
from pipeline.grading.gradebook.shared_gradebook import SharedGradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.judge.recompute import findings_text, read_findings, recompute_points
from pipeline.grading.publish.class_page import class_page
from pipeline.grading.publish.export import export
from pipeline.grading.publish.gradescope import results_text
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.rubric import Manual, Rubric
from pipeline.grading.rubric_file import InvalidRubric, parse_rubric
from pipeline.grading.rubric_text import rubric_text
from pipeline.grading.words import WORDS
from pipeline.resources import RUBRICS
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import failed_grade, make_grade, make_outcome, two_cart_rubric
from tests.helpers.grading_students import student

DISCUSSION = Manual(check="manual", id="discussion", title="discussion", points=4)


def with_manual(rubric: Rubric) -> Rubric:
    """Return the rubric with a criterion that a person grades."""
    return rubric.model_copy(update={"criteria": (*rubric.criteria, DISCUSSION)})


def put(book: Gradebook, grade, *, rubric: Rubric, version: str = "1") -> None:
    """Make a class list of one grade."""
    outcome = make_outcome(grade, key=f"{grade.submission} {version}")
    book.put(outcome)
    book.finish(Batch(keys=(outcome.key,), shared={}), rubric=rubric)


@pytest.fixture(scope="module")
def honest():
    """Return a correct submission's grade, with a criterion that a person grades."""
    one = student(1)
    rubric = with_manual(one.rubric)
    return rubric, type(one)(**{**vars(one), "rubric": rubric}).graded()


def test_a_manual_criterion_is_open_until_a_person_grades_it(honest, tmp_path):
    """It gives no points and is open; any points, also 0, close it, and a regrading keeps them."""
    rubric, graded = honest
    own = graded.grade.criteria[-1]
    assert (own.outcome, own.points, own.message) == ("skip", 0, "Graded by a person; not yet.")
    assert graded.grade.open == ("discussion",)
    assert graded.grade.points == rubric.out_of - 4
    grade = graded.grade.model_copy(update={"submission": "team-1"})
    with SharedGradebook(tmp_path, assignment="lab", create=True) as book:
        put(book, grade, rubric=rubric)
        seen = book.team("team-1").versions["discussion"]
        book.change("team-1", "discussion", 0.0, why="none handed in", by="Ada", version=seen)
        assert book.entry("team-1").grade.open == ()
        assert book.entry("team-1").grade.criteria[-1].outcome == "fail"
        book.override("team-1", "discussion", 3, why="no word on damping", by="Ada")
        put(book, grade, rubric=rubric, version="2")
        now = book.entry("team-1").grade
        assert now.points == rubric.out_of - 1
        assert (now.criteria[-1].outcome, now.criteria[-1].message) == (
            "partial",
            "no word on damping",
        )
        book.override("team-1", "discussion", None, why="too early", by="Ada")
        assert book.entry("team-1").grade.open == ("discussion",)


def test_another_rubric_leaves_a_manual_criterion_open(honest):
    """The preview of other points keeps the criterion open, and gives it no points."""
    rubric, graded = honest
    found = read_findings(findings_text(graded.judgements))
    again = recompute_points(graded.grade, found, rubric=rubric)
    assert (again.points, again.open) == (graded.grade.points, ("discussion",))


def with_open(grade: Grade) -> Grade:
    """Return the grade with a criterion that a person still has to grade."""
    own = Criterion(
        id="discussion", title="discussion", outcome="skip", points=0.0, out_of=4.0,
        message="Graded by a person; not yet.", expected={}, found={},
    )  # fmt: skip
    return grade.model_copy(update={"criteria": (*grade.criteria, own), "open": ("discussion",)})


def test_an_open_criterion_is_said_everywhere(tmp_path):
    """Class page, feedback, export and Gradescope say that the grade is not final."""
    rubric, grade = with_manual(two_cart_rubric()), with_open(make_grade("team-1"))
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        put(book, grade, rubric=rubric)
        write_outputs(book, tmp_path)
        done = export(book, "moodle", tmp_path)
    assert "1 submission not final" in (tmp_path / "class.html").read_text(encoding="utf-8")
    feedback = (tmp_path / "feedback" / "team-1" / "feedback.html").read_text(encoding="utf-8")
    assert "Not final: a person has yet to grade discussion." in feedback
    summary = feedback.split('id="criteria"')[0]
    assert (WORDS.text("lost") in summary, WORDS.text("earned_all") in summary) == (False, False)
    table = (tmp_path / "moodle.csv").read_text(encoding="utf-8")
    assert ("Not final" in table, "discussion: 0 of" in table) == (True, False)
    assert ["not final" in one.text for one in done.remarks].count(True) == 1
    result = json.loads(results_text(grade, rubric=rubric))
    assert "status" not in result["tests"][-1]
    assert "Not final" in result["output"]


def test_an_open_criterion_has_no_points_yet(tmp_path):
    """Tables leave its points empty, also 0; means and lost points do not count it."""
    rubric = with_manual(two_cart_rubric())
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        outcomes = [make_outcome(with_open(make_grade(name))) for name in ("a", "b", "c")]
        for outcome in outcomes:
            book.put(outcome)
        book.finish(Batch(keys=tuple(one.key for one in outcomes), shared={}), rubric=rubric)
        page = class_page([GradeSummary.of(one.grade) for one in book.entries()], rubric=rubric)
        assert "lowest: discussion" not in page
        book.override("a", "discussion", 3, why="no word on damping", by="Ada")
        book.override("b", "discussion", 0, why="none handed in", by="Ada")
        write_outputs(book, tmp_path)
        frame = book.to_frame()
        grades = [entry.grade for entry in book.entries()]
    with (tmp_path / "grades.csv").open(encoding="utf-8", newline="") as file:
        assert [row["discussion"] for row in csv.DictReader(file)] == ["3", "0", ""]
    own = frame.loc[frame["criterion"] == "discussion"]
    assert own["outcome"].to_list() == ["partial", "fail", ""]
    assert own["points"].isna().to_list() == [False, False, True]
    # (3 + 0) of twice 4 points: the mean over the two teams that were graded
    assert re.search(r"discussion</td>.*?38\s%", (tmp_path / "class.html").read_text("utf-8"), re.S)
    lost = [points_lost(grade, rubric) for grade in grades]
    assert lost == [{"discussion"}, {"discussion"}, set()]


def test_adjustments_add_up_and_survive_regrading(place):
    """Every adjustment counts; the total never falls below 0, and a bonus may exceed the points."""
    rubric = two_cart_rubric()
    with SharedGradebook(place, assignment="lab", create=True) as book:
        put(book, make_grade("team-1"), rubric=rubric)
        book.adjust("team-1", 1.5, why="a fine plot", by="Ada")
        assert book.entry("team-1").grade.points == 21.5
        book.adjust("team-1", -100, why="copied from another team", by="Bob")
        put(book, make_grade("team-1", share=0.5), rubric=rubric, version="2")
        entry = book.entry("team-1")
        assert entry.grade.points == 0
        assert [(a.points, a.why) for a in entry.grade.adjustments] == [
            (1.5, "a fine plot"),
            (-100, "copied from another team"),
        ]
        assert book.class_now().rows[0].line.points == 0
        text = history_text(*book.history("team-1"))
        assert "adjusted  total -100 points, by Bob: copied from another team" in text
        book.adjust("team-1", 100, why="it was not", by="Bob")
        assert book.entry("team-1").grade.points == 11.5
        assert read_grade(entry.grade.model_dump_json(by_alias=True)) == entry.grade


def test_a_total_is_adjusted_after_lateness(tmp_path):
    """Lateness is deducted from the points earned, not from an adjustment; a failed grade has 0."""
    rubric = two_cart_rubric()  # 10 % a day
    late = make_grade("late", days_late=1.0)
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        for grade in (late, failed_grade("broken", "no data")):
            book.put(make_outcome(grade))
        book.finish(Batch(keys=("key of late", "key of broken"), shared={}), rubric=rubric)
        for name, points in (("late", -3), ("broken", 5)):
            book.adjust(name, points, why="agreed", by="Ada")
        assert book.entry("late").grade.points == 20 - 2 - 3
        assert book.entry("broken").grade.points == 5
        export(book, "moodle", tmp_path)
    assert ",5," in (tmp_path / "moodle.csv").read_text(encoding="utf-8").replace('"', "")


@pytest.mark.parametrize("points", [0.0, float("nan"), float("inf")])
def test_an_adjustment_is_a_number_other_than_0(tmp_path, points):
    """Anything else is refused, and so is an adjustment without a reason."""
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        put(book, make_grade("team-1"), rubric=two_cart_rubric())
        with pytest.raises(Exception, match="expected points to add or deduct"):
            book.adjust("team-1", points, why="x", by="Ada")
        with pytest.raises(Exception, match="needs a reason"):
            book.adjust("team-1", 1.0, why=" ", by="Ada")


def test_the_desk_refuses_an_adjustment_sent_twice(tmp_path):
    """A form is valid once, so that a double click does not deduct twice."""
    with SharedGradebook(tmp_path, assignment="lab", create=True) as book:
        put(book, make_grade("team-1"), rubric=two_cart_rubric())
        seen = book.team("team-1").versions[TOTAL]
        book.change("team-1", TOTAL, -2.0, why="late notes", by="Ada", version=seen)
        with pytest.raises(Exception, match="was changed"):
            book.change("team-1", TOTAL, -2.0, why="late notes", by="Ada", version=seen)
        assert book.entry("team-1").grade.points == 18


def test_points_come_from_a_table(tmp_path):
    """The commands read one change, a table with a column per criterion, and an adjustment."""
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        put(book, make_grade("team-1"), rubric=with_manual(two_cart_rubric()))
    table = tmp_path / "points.csv"
    table.write_text("submission;discussion;pieces\nteam-1;2,5;\n", encoding="utf-8")
    by = ("--by", "Ada")
    done = cartlab_here("override", tmp_path, "--from", table, *by, "--why", "as we discussed")
    assert (done.returncode, done.stderr.count("1 change of 1 cell")) == (0, 1)
    done = cartlab_here("adjust", tmp_path, "team-1", "-2", "--why", "copied plots", *by)
    assert done.returncode == 0, done.stderr
    assert "20.5 of 24 points" in done.stderr
    grade = read_grade((tmp_path / "feedback" / "team-1" / "grade.json").read_text())
    assert (grade.points, grade.adjustments[0].points) == (20.5, -2)
    assert "−2 points: copied plots" in (tmp_path / "feedback/team-1/feedback.html").read_text()
    assert "total −2 (copied plots)" in (tmp_path / "class.html").read_text(encoding="utf-8")
    done = cartlab_here("override", tmp_path, "team-1", "pieces", "-1", "--why", "more", *by)
    assert done.returncode == 2
    assert "pieces: expected 0 to 1 points, found -1; to deduct from the total" in done.stderr
    table.write_text("submission,discussion\nteam-1,9\n", encoding="utf-8")
    done = cartlab_here("override", tmp_path, "--from", table, *by, "--why", "more")
    assert done.returncode == 2
    assert "line 2: discussion: expected 0 to 4 points, found 9" in done.stderr
    table.write_text("submission,discussion\nnobody,1\n", encoding="utf-8")
    done = cartlab_here("override", tmp_path, "--from", table, *by, "--why", "more")
    assert "points.csv line 2: nobody: no such submission" in done.stderr


def test_a_table_says_the_line_and_column_of_a_wrong_cell(tmp_path):
    """A cell that is no number is refused at its place."""
    table = tmp_path / "points.csv"
    table.write_text("submission,discussion,why\nteam-1,good,well done\n", encoding="utf-8")
    with pytest.raises(Exception, match=r"points\.csv line 2, column discussion: good: expected"):
        read_wishes(table)


def test_check_rubric_shows_a_manual_criterion():
    """A rubric with a manual criterion is valid; nothing may wait for it."""
    text = (RUBRICS / "throne-2dof.toml").read_text(encoding="utf-8")
    manual = '\n[[criteria]]\nid = "discussion"\ncheck = "manual"\npoints = 4\n'
    rubric = parse_rubric(text + manual, where="r.toml")
    assert "discussion: a person reads and grades this (a person gives the points)" in rubric_text(
        rubric
    )
    after = manual.replace("discussion", "b") + 'requires = ["discussion"]\n'
    with pytest.raises(InvalidRubric, match="'discussion' is graded by a person"):
        parse_rubric(text + manual + after.replace("manual", "data"), where="r.toml")
    with pytest.raises(InvalidRubric, match="has no effect"):
        parse_rubric(text + manual + 'requires = ["pieces"]\n', where="r.toml")
