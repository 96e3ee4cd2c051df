"""Criteria that a person grades, and changes of the total with a reason."""

import csv
import json
import re
from dataclasses import replace

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.grade import Criterion, Grade, read_grade
from pipeline.grading.gradebook.decisions import Conflict, points_lost, read_wishes
from pipeline.grading.gradebook.events import TOTAL
from pipeline.grading.gradebook.history import history_text
from pipeline.grading.gradescope import results_text
from pipeline.grading.judge.award import findings_text, read_findings, recompute_points
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.class_page import class_page
from pipeline.grading.publish.export import export
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.publish.view import new_view
from pipeline.grading.rubric import Manual, Rubric
from pipeline.grading.rubric_file import InvalidRubric, parse_rubric
from pipeline.grading.rubric_text import rubric_text
from pipeline.grading.words import WORDS
from pipeline.resources import RUBRICS
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import book_of, failed_grade, finish, make_grade, two_cart_rubric
from tests.helpers.grading_students import student

DISCUSSION = Manual(check="manual", id="discussion", title="discussion", points=4)


def with_manual(rubric: Rubric) -> Rubric:
    """Return the rubric with a criterion that a person grades."""
    return rubric.model_copy(update={"criteria": (*rubric.criteria, DISCUSSION)})


def with_open(grade: Grade) -> Grade:
    """Return the grade with a criterion that a person still has to grade."""
    own = Criterion(
        id="discussion", title="discussion", outcome="skip", points=0.0, out_of=4.0,
        message="Graded by a person; not yet.", expected={}, found={},
    )  # fmt: skip
    return grade.model_copy(update={"criteria": (*grade.criteria, own), "open": ("discussion",)})


@pytest.fixture(scope="module")
def honest():
    """Return a correct submission's grade, with a criterion that a person grades."""
    one = student(1)
    rubric = with_manual(one.rubric)
    return rubric, replace(one, rubric=rubric).graded()


def test_a_manual_criterion_is_open_until_a_person_grades_it(honest, tmp_path):
    """It gives no points and is open; any points, also 0, close it, and a regrading keeps them."""
    rubric, graded = honest
    own = graded.grade.criteria[-1]
    assert (own.outcome, own.points, graded.grade.open) == ("skip", 0, ("discussion",))
    assert graded.grade.points == rubric.out_of - 4
    grade = graded.grade.model_copy(update={"submission": "team-1"})
    with book_of(tmp_path, grade, rubric=rubric) as book:
        seen = book.entry("team-1").version("discussion")
        book.change("team-1", "discussion", 0.0, why="none handed in", by="Ada", version=seen)
        assert book.entry("team-1").grade.open == ()
        assert book.entry("team-1").grade.criteria[-1].outcome == "fail"
        book.override("team-1", "discussion", 3, why="damping", by="Ada")
        finish(book, grade, rubric=rubric, key="again")
        now = book.entry("team-1").grade
        own = now.criteria[-1]
        assert now.points == rubric.out_of - 1
        assert (own.outcome, own.message) == ("partial", "damping")
        book.override("team-1", "discussion", None, why="too early", by="Ada")
        assert book.entry("team-1").grade.open == ("discussion",)


def test_another_rubric_leaves_a_manual_criterion_open(honest):
    """The preview of other points keeps the criterion open, and gives it no points."""
    rubric, graded = honest
    found = read_findings(findings_text(graded.judgements))
    again = recompute_points(graded.grade, found, rubric=rubric)
    assert (again.points, again.open) == (graded.grade.points, ("discussion",))


def test_an_open_criterion_is_said_everywhere(tmp_path):
    """Class page, feedback, export and Gradescope say that the grade is not final."""
    rubric, grade = with_manual(two_cart_rubric()), with_open(make_grade("team-1"))
    with book_of(tmp_path, grade, rubric=rubric) as book:
        write_outputs(book, tmp_path)
        done = export(book, PLATFORMS["moodle"], tmp_path)
    result = json.loads(results_text(new_view(grade, rubric)))
    feedback = (tmp_path / "feedback" / "team-1" / "feedback.html").read_text(encoding="utf-8")
    table = (tmp_path / "moodle.csv").read_text(encoding="utf-8")
    remarks = [one.text for one in done.remarks if "not final" in one.text]
    page = (tmp_path / "class.html").read_text(encoding="utf-8")
    for text in (page, feedback, table, result["output"], *remarks):
        assert "not final" in text.casefold()
    assert len(remarks) == 1
    summary = feedback.split('id="criteria"')[0]
    assert (WORDS.text("lost") in summary, WORDS.text("earned_all") in summary) == (False, False)
    assert "discussion: 0" not in table
    assert "status" not in result["tests"][-1]


def test_an_open_criterion_has_no_points_yet(tmp_path):
    """Tables leave its points empty, also 0; means and lost points do not count it."""
    rubric = with_manual(two_cart_rubric())
    class_ = [with_open(make_grade(name)) for name in ("a", "b", "c")]
    with book_of(tmp_path, *class_, rubric=rubric) as book:
        page = class_page([one.grade for one in book.entries()], rubric=rubric)
        assert "lowest: discussion" not in page
        book.override("a", "discussion", 3, why="damping", by="Ada")
        book.override("b", "discussion", 0, why="none handed in", by="Ada")
        write_outputs(book, tmp_path)
        frame = book.to_frame()
        lost = [points_lost(entry.grade, rubric) for entry in book.entries()]
    with (tmp_path / "grades.csv").open(encoding="utf-8", newline="") as file:
        assert [row["discussion"] for row in csv.DictReader(file)] == ["3", "0", ""]
    own = frame.loc[frame["criterion"] == "discussion"]
    assert own["outcome"].to_list() == ["partial", "fail", ""]
    assert own["points"].isna().to_list() == [False, False, True]
    # (3 + 0) of twice 4 points: the mean over the two teams that were graded
    assert re.search(r"discussion</td>.*?38\s%", (tmp_path / "class.html").read_text("utf-8"), re.S)
    assert lost == [{"discussion"}, {"discussion"}, set()]


def test_adjustments_add_up_and_survive_regrading(book):
    """Every adjustment counts; the total never falls below 0, and a bonus may exceed the points."""
    finish(book, make_grade("team-1"), key="first")
    book.adjust("team-1", 1.5, why="plot", by="Ada")
    assert book.entry("team-1").grade.points == 21.5
    book.adjust("team-1", -100, why="copied", by="Bob")
    finish(book, make_grade("team-1", share=0.5), key="second")
    entry = book.entry("team-1")
    assert (entry.grade.points, book.class_now().entries[0].grade.points) == (0, 0)
    adjusted = [(a.points, a.why) for a in entry.grade.adjustments]
    assert adjusted == [(1.5, "plot"), (-100, "copied")]
    events = [(e.points, e.by) for e in book.history("team-1")[1] if e.what == "adjusted"]
    assert events == [(1.5, "Ada"), (-100, "Bob")]
    assert re.search(r"-100 .*Bob: copied\n", history_text(*book.history("team-1")))
    book.adjust("team-1", 100, why="it was not", by="Bob")
    assert book.entry("team-1").grade.points == 11.5
    assert read_grade(entry.grade.model_dump_json(by_alias=True)) == entry.grade


def test_a_total_is_adjusted_after_lateness(tmp_path):
    """Lateness is deducted from the points earned, not from an adjustment; a failed grade has 0."""
    late = make_grade("late", days_late=1.0)  # 10 % a day
    with book_of(tmp_path, late, failed_grade("broken", "no data")) as book:
        for name, points in (("late", -3), ("broken", 5)):
            book.adjust(name, points, why="agreed", by="Ada")
        assert book.entry("late").grade.points == 20 - 2 - 3
        assert book.entry("broken").grade.points == 5
        export(book, PLATFORMS["moodle"], tmp_path)
    assert ",5," in (tmp_path / "moodle.csv").read_text(encoding="utf-8").replace('"', "")


@pytest.mark.parametrize(
    ("points", "why"), [(0.0, "x"), (float("nan"), "x"), (float("inf"), "x"), (1.0, " ")]
)
def test_an_adjustment_is_a_number_other_than_0_with_a_reason(tmp_path, points, why):
    """Anything else is refused."""
    with (
        book_of(tmp_path, make_grade("team-1")) as book,
        pytest.raises(ConfigError, match=str(points) if why == "x" else "reason"),
    ):
        book.adjust("team-1", points, why=why, by="Ada")


def test_the_desk_refuses_an_adjustment_sent_twice(tmp_path):
    """A form is valid once, so that a double click does not deduct twice."""
    with book_of(tmp_path, make_grade("team-1")) as book:
        seen = book.entry("team-1").version(TOTAL)
        book.change("team-1", TOTAL, -2.0, why="late notes", by="Ada", version=seen)
        with pytest.raises(Conflict):
            book.change("team-1", TOTAL, -2.0, why="late notes", by="Ada", version=seen)
        assert book.entry("team-1").grade.points == 18


def test_a_row_with_a_decimal_comma_too_many_changes_nothing(tmp_path):
    """A cell beyond the headings is refused with its line, since "0,5" would give 0 points."""
    table = tmp_path / "points.csv"
    table.write_text("submission,laws\nteam-1,0.5\nteam-2,0,5\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"line 3: .*found 3"):
        read_wishes(table, why="x")


def test_points_come_from_a_table(tmp_path):
    """The commands read one change, a table with a column per criterion, and an adjustment."""
    table = tmp_path / "points.csv"
    with book_of(tmp_path, make_grade("team-1"), rubric=with_manual(two_cart_rubric())) as book:
        book.close()

    def run(command: str, *words: object, text: str = "", status: int = 0) -> str:
        table.write_text(text, encoding="utf-8")
        by = ("--why", "copied plots", "--by", "Ada")
        done = cartlab_here(command, tmp_path, *words, *by)
        assert done.returncode == status, done.stderr
        return done.stderr

    said = run("override", "--from", table, text="submission;discussion;pieces\nteam-1;2,5;\n")
    assert said.count("1 change") == 1
    assert "20.5 of 24" in run("adjust", "team-1", "-2")
    own = tmp_path / "feedback" / "team-1"
    grade = read_grade((own / "grade.json").read_text())
    assert (grade.points, grade.adjustments[0].points) == (20.5, -2)
    for page in (own / "feedback.html", tmp_path / "class.html"):
        assert re.search("−2.*copied plots", page.read_text(encoding="utf-8"))
    assert "found -1; " in run("override", "team-1", "pieces", "-1", status=2)
    for text, where in (
        ("submission,discussion\nteam-1,9\n", r"line 2: discussion: .* 9;"),
        ("submission,discussion\nnobody,1\n", r"points\.csv line 2: nobody: "),
    ):
        assert re.search(where, run("override", "--from", table, text=text, status=2))
    table.write_text("submission,discussion,why\nteam-1,good,well done\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"line 2, .*discussion.*good"):
        read_wishes(table)
    table.write_text("submission,laws\nteam-1,1\nteam-2,1\nteam-1,2\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"line 4: team-1, laws.*2$"):
        read_wishes(table, why="x")


def test_check_rubric_shows_a_manual_criterion():
    """A rubric with a manual criterion is valid; nothing may wait for it."""
    text = (RUBRICS / "throne-2dof.toml").read_text(encoding="utf-8")
    manual = '\n[[criteria]]\nid = "discussion"\ncheck = "manual"\npoints = 4\n'
    rubric = parse_rubric(text + manual, where="r.toml")
    assert re.search("discussion: .*a person", rubric_text(rubric))
    after = manual.replace("discussion", "b") + 'requires = ["discussion"]\n'
    for more in (after.replace("manual", "data"), 'requires = ["pieces"]\n'):
        with pytest.raises(InvalidRubric, match="requires"):
            parse_rubric(text + manual + more, where="r.toml")
