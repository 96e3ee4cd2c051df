"""A grade that is held back appears nowhere with points, in SQLite and in PostgreSQL."""

import csv
import zipfile

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import RequestRefused
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.export import export, export_feedback
from pipeline.grading.publish.outputs import write_outputs
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import book_of, finish, make_grade, make_outcome, shared_flag

TEAMS = [
    make_outcome(make_grade(name, share=0.5), owner=f"doe{n} (102{n})")
    for n, name in enumerate(("team-1", "team-2", "team-3"))
]
SHARED = {"team-2": shared_flag("team-3"), "team-3": shared_flag("team-2")}


def test_only_the_staff_reads_a_grade_that_is_held_back(book):
    """The team neither reads it nor asks about it; after the end of the hold it does both."""
    book.hold("team-1", why="a case", by="Ada")
    assert book.own_feedback("team-1") is None
    assert book.own_feedback("team-2") is not None
    with pytest.raises(RequestRefused):
        book.ask("team-1", "laws", why="please", by="s1")
    assert book.entry("team-1").hold.text == "a case"
    with pytest.raises(ConfigError):
        book.hold("team-1", why="again", by="Ada")
    book.let_go("team-1", by="Bo")
    assert book.own_feedback("team-1") is not None
    with pytest.raises(ConfigError):
        book.let_go("team-1", by="Bo")
    with pytest.raises(ConfigError):
        book.hold("team-1", why=" ", by="Ada")
    told = [(event.what, event.by) for event in book.history("team-1")[1][-2:]]
    assert told == [("held", "Ada"), ("let_go", "Bo")]


def test_a_hold_survives_regrading_and_a_new_name(book):
    """Another grading, and another folder name, do not release a grade."""
    book.hold("team-1", why="a case", by="Ada")
    finish(book, make_grade("team-1"), make_grade("team-2"), key="again")
    assert book.entry("team-1").hold
    renamed = make_grade("new", authors=("s-team-1",))
    finish(book, renamed, make_grade("team-2"), key="again", moved={"team-1": "new"})
    assert book.entry("new").hold


def test_a_release_leaves_open_cases_out(place):
    """Teams with shared recordings are held back, unless a person reviewed or let them go."""
    with book_of(place, *TEAMS, shared=SHARED) as book:
        book.set_reviewed("team-3", by="Ada", reviewed=True)
        assert book.release(True, by="prof") == ["team-2"]
        readable = [t for t in ("team-1", "team-2", "team-3") if book.own_feedback(t)]
        assert readable == ["team-1", "team-3"]
        book.let_go("team-2", by="prof")
        assert book.release(False, by="prof") == []
        assert book.release(True, by="prof") == []
        assert book.own_feedback("team-2") is not None


def test_no_file_has_points_of_a_grade_that_is_held_back(tmp_path):
    """Feedback, class page, grades.csv and exports leave it out, also if they were there before."""
    out = tmp_path / "grades"
    out.mkdir()
    with book_of(out, *TEAMS) as book:
        write_outputs(book, out)
        export(book, PLATFORMS["gradescope"], out)
        assert (out / "feedback" / "team-2" / "grade.json").is_file()
        book.hold("team-2", why="a case", by="Ada")
        write_outputs(book, out)
        assert not (out / "feedback" / "team-2").exists()
        with (out / "grades.csv").open(encoding="utf-8-sig", newline="") as file:
            rows = {row["submission"]: row for row in csv.DictReader(file)}
        assert [rows[f"team-{n}"]["points"] for n in (1, 2, 3)] == ["10", "", "10"]
        assert (rows["team-2"]["status"], rows["team-2"]["laws"]) == ("held", "")
        page = (out / "class.html").read_text("utf-8")
        assert "feedback/team-1/" in page
        assert "feedback/team-2/" not in page
        for platform in PLATFORMS.values():
            done = export(book, platform, out)
            assert any("team-2" in remark.text for remark in done.remarks)
            assert "doe1" not in done.files[0].read_text("utf-8-sig")
        assert not (out / "gradescope" / "team-2" / "results.json").exists()
        pages = export_feedback(book, PLATFORMS["moodle"], out).files[0]
        with zipfile.ZipFile(pages) as packed:
            assert len(packed.namelist()) == 2
        book.let_go("team-2", by="Ada")
        write_outputs(book, out)
        assert (out / "feedback" / "team-2" / "grade.json").is_file()


def test_the_command_holds_and_ends(tmp_path):
    """`cartlab hold` writes the files without the grade, and with --end again with it."""
    (tmp_path / "g").mkdir()
    with book_of(tmp_path / "g", *TEAMS):
        pass
    feedback = tmp_path / "g" / "feedback" / "team-1"
    command = ("hold", str(tmp_path / "g"), "team-1", "--by", "Ada")
    assert cartlab_here(*command).returncode == 2
    assert cartlab_here(*command, "--why", "a case").returncode == 0
    assert not feedback.exists()
    assert cartlab_here(*command, "--end").returncode == 0
    assert feedback.is_dir()
    with Gradebook(tmp_path / "g") as book:
        assert book.entry("team-1").hold is None
