"""The TA's team page changes the total, and shows what the team wrote beside the points."""

import re
from html import unescape

import pytest

from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.intake.files import digest
from pipeline.grading.rubric import Manual
from tests.helpers.desks import Visitor
from tests.helpers.grades import make_grade, make_outcome, shared_flag, two_cart_rubric

pytestmark = pytest.mark.usefixtures("all_work_here")
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


def test_a_ta_reads_grades_and_adjusts_a_team(grades):
    """Notes are text, not markup; a PDF is sent inert; a refused or repeated form changes nothing.

    The remark about shared recordings points to the change of the total.
    """
    with DeskServer() as server:
        ta = Visitor.of(server.url)
        ta.post("/open", folder=str(grades))
        ta.post(TEAM, do="sign", by="Ada")
        page = ta.get(f"{TEAM}&criterion=discussion").text
        assert "Friction <strong>matters</strong>" in page
        assert "<script>alert" not in page
        assert "Not final: a person has yet to grade" in page
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
