"""The TA's team page changes the total, and shows what the team wrote beside the points."""

import re
from html import unescape
from urllib.parse import urlsplit

import pytest

from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.intake.files import digest
from pipeline.grading.rubric import Manual
from tests.helpers.desks import at_desk, through_proxy, write_users
from tests.helpers.grades import make_grade, make_outcome, shared_flag, two_cart_rubric

pytestmark = pytest.mark.usefixtures("all_work_here")
STUDENT = """
[[users]]
name = "s1"
role = "student"
grades = [{ gradebook = "grades", submission = "team-1" }]
"""
TEAM = "/grades/0/team?of=team-1"
TOTAL = re.compile(r'#total" class="steps"><input type="hidden" name="seen" value="(.*?)"')


@pytest.fixture
def grades(tmp_path):
    """Return the folder of a class of one team, with its submission beside it."""
    team, out = tmp_path / "team-1", tmp_path / "grades"
    team.mkdir()
    (team / "submission.toml").write_text("version = 1\n", "utf-8")
    (team / "notes.md").write_text("Friction **matters**. <script>alert(1)</script>\n", "utf-8")
    (team / "paper.pdf").write_bytes(b"%PDF-1.4\n")
    rubric = two_cart_rubric()
    manual = Manual(check="manual", id="discussion", title="discussion", points=4)
    rubric = rubric.model_copy(update={"criteria": (*rubric.criteria, manual)})
    grade = make_grade("team-1", flags=(shared_flag("team-2"),))
    own = grade.criteria[0].model_copy(
        update={"id": "discussion", "outcome": "skip", "points": 0.0, "out_of": 4.0}
    )
    grade = grade.model_copy(update={"criteria": (*grade.criteria, own), "open": ("discussion",)})
    out.mkdir()
    with Gradebook(out, assignment="lab", create=True) as book:
        outcome = make_outcome(grade, key=f"lab-{digest([team])}")
        book.put(outcome)
        book.finish(Batch(keys=(outcome.key,), shared={}), rubric=rubric)
    return out


def test_the_class_page_says_that_grades_are_not_final(grades):
    """It says so until a person has graded the criterion, which lost no points before."""
    told = "1 submission not final: a person still has to grade discussion (1)."
    with at_desk(opened=grades) as ta:
        page = ta.get("/grades/0/").text
        assert told in ta.get("/grades/0/class.html").text
        for card in ("Students with accounts", "Export"):
            assert told in page.split(f"<h3>{card}</h3>")[1].split("</article>")[0]
        assert "Nobody lost points." in page
        assert "1 of 1." in ta.get("/grades/0/?state=open").text
        with Gradebook(grades) as book:
            book.override("team-1", "discussion", 1, why="too short", by="Ada")
        page = ta.get("/grades/0/").text
        assert "not final:" not in page
        assert "?lost=discussion#class" in page
        assert "0 of 1." in ta.get("/grades/0/?state=open").text


def test_a_student_reads_that_a_grade_is_not_final(grades, tmp_path):
    """An open criterion lost no points yet, so there is nothing to ask about."""
    with Gradebook(grades) as book:
        book.set_reviewed("team-1", by="Ada", reviewed=True)  # its flag is no open case any more
        book.release(by="Ada", released=True)
    with DeskServer(users=write_users(tmp_path, STUDENT)) as server:
        student = through_proxy(urlsplit(server.url).port or 0, "s1")
        page = student.get("/feedback/0/").text
        assert "Not final: " in page
        waiting = page.split(">Not graded yet</h2>")[1]
        assert "Discussion: – of 4" in waiting
        assert "<textarea" not in page
        sent = student.post("/feedback/0/ask", criterion="discussion", why="see page 3")
        assert (sent.status, "points were lost" in sent.text) == (422, True)


def test_a_ta_reads_grades_and_adjusts_a_team(grades):
    """Notes are text, not markup; a PDF is sent inert; a refused or repeated form changes nothing.

    The remark about shared recordings points to the change of the total.
    """
    with at_desk(opened=grades) as ta:
        ta.post(TEAM, do="sign", by="Ada")
        page = ta.get(f"{TEAM}&criterion=discussion").text
        assert "Friction <strong>matters</strong>" in page
        assert "<script>alert" not in page
        assert "Not final: " in page
        assert 'href="#total"' in ta.get(f"{TEAM}&remark=shared_data").text
        paper = re.search(r'href="(/grades/0/paper[^"]*)"', page)
        assert paper
        sent = ta.get(unescape(paper[1]))
        assert sent.headers["content-type"] == "application/pdf"
        assert sent.headers["content-security-policy"].startswith("sandbox")
        assert ta.get("/grades/0/paper?of=team-1&file=submission.toml").status == 404

        seen = re.search(r'value="discussion"><input type="hidden" name="seen" value="(.*?)"', page)
        assert seen
        given = {"do": "change", "criterion": "discussion", "seen": seen[1], "points": "0"}
        assert ta.post(TEAM, **given, why="none handed in").status == 303
        version = TOTAL.search(ta.get(TEAM).text)
        assert version
        asked = {"do": "adjust", "seen": version[1], "points": "-2,5"}
        refused = ta.post(TEAM, **asked, why="")
        assert (refused.status, 'value="-2,5"' in refused.text) == (422, True)
        assert ta.post(TEAM, **asked, why="copied plots").status == 303
        assert ta.post(TEAM, **asked, why="copied plots").status == 409
        assert "−2.5 points: copied plots" in ta.get(TEAM).text
    with Gradebook(grades) as book:
        grade = book.entry("team-1").grade
    assert (grade.points, grade.open) == (17.5, ())
