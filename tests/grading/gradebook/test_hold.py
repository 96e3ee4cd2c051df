"""A grade that is held back appears nowhere with points, in SQLite and in PostgreSQL."""

import csv
import zipfile

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.decisions import RequestRefused
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.export import export, export_feedback
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.publish.view import GradeView, view
from pipeline.grading.total import with_total
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import (
    book_of,
    finish,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)

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


def late_team(share: float) -> Grade:
    """Return the grade of a late team that earned this share of the points for its final table.

    With less than all, it has the flag of a mistake there.
    """
    grade = make_grade("team-1", days_late=2.0)
    criteria = [
        one.model_copy(update={"points": share * one.out_of, "message": f"earned {share}"})
        if one.id == "final-frequencies"
        else one
        for one in grade.criteria
    ]
    flag = hertz_flag().model_copy(update={"evidence": {"table": "final", "ratio": 0.159}})
    flags = (flag,) if share < 1 else ()
    grade = grade.model_copy(update={"flags": flags, "notes": (f"share {share}",)})
    return with_total(grade, criteria, rubric=two_cart_rubric())


def everything(place, share: float) -> dict[str, object]:
    """Return all that students and files have of a class whose final table is held back."""
    place.mkdir()
    own = make_outcome(late_team(share), owner="doe1 (1021)")
    with book_of(place, own, make_grade("team-2", share=0.5)) as book:
        book.release(True, by="prof")
        book.override("team-1", "final-frequencies", share * 2, why=f"looked {share}", by="Ada")
        if share < 1:
            book.ask("team-1", "final-frequencies", why=f"please {share}", by="s1")
        book.hold_criterion("final-frequencies", True, why="second marker", by="Ada")
        write_outputs(book, place)
        export_feedback(book, PLATFORMS["moodle"], place / "feedback.zip")
        with pytest.raises(RequestRefused) as refused:
            book.ask("team-1", "final-frequencies", why="please", by="s1")
        feedback = book.own_feedback("team-1")
    assert feedback
    files = [path for path in place.rglob("*") if path.is_file() and "sqlite" not in path.name]
    return {
        **{str(path.relative_to(place)): path.read_bytes() for path in files},
        "view": view(feedback, "team"),
        "requests": feedback.requests,
        "refused": str(refused.value),
    }


def test_nothing_depends_on_a_criterion_that_is_held_back(tmp_path):
    """Whatever it earned: files, views, requests and refusals are the same, byte for byte."""
    none, all_ = everything(tmp_path / "none", 0.0), everything(tmp_path / "all", 1.0)
    assert [name for name in none.keys() | all_.keys() if none.get(name) != all_.get(name)] == []
    seen = all_["view"]
    assert isinstance(seen, GradeView)
    final = two_cart_rubric().criterion("final-frequencies")
    assert final is not None
    assert seen.grade.out_of == 20 - final.points
    assert seen.grade.criterion("final-frequencies") is None
    assert len(seen.held) == 1
    assert seen.grade.flags == ()
    assert 0 < seen.grade.deducted < 4


def test_a_criterion_is_held_back_and_published(book):
    """Students read its points only afterwards, and the staff always."""
    whole = book.own_feedback("team-1")
    book.hold_criterion("laws", True, why="second marker", by="Ada")
    assert book.held_criteria == ("laws",)
    own = book.own_feedback("team-1")
    assert [one.id for one in own.held] == ["laws"]
    assert own.grade.criterion("laws") is None
    assert book.entry("team-1").grade.criterion("laws") is not None
    for criterion, held, why in (
        ("laws", True, "x"), ("data", True, " "), ("data", False, "x"), ("magic", True, "x"),
    ):  # fmt: skip
        with pytest.raises(ConfigError):
            book.hold_criterion(criterion, held, why=why, by="Ada")
    finish(book, make_grade("team-1"), make_grade("team-2"), key="again")
    assert book.held_criteria == ("laws",)
    book.hold_criterion("laws", False, by="Ada")
    assert book.own_feedback("team-1").held == ()
    assert book.own_feedback("team-1").rubric == whole.rubric
    first, *others = [one.id for one in book.rubric.criteria]
    for criterion in others:
        book.hold_criterion(criterion, True, why="x", by="Ada")
    with pytest.raises(ConfigError):
        book.hold_criterion(first, True, why="x", by="Ada")


def test_totals_are_not_exported_while_a_criterion_is_held_back(tmp_path):
    """The export refuses and writes nothing, until `cartlab hold --criterion --end`."""
    out = tmp_path / "grades"
    out.mkdir()
    with book_of(out, *TEAMS):
        pass
    held = ("hold", str(out), "--criterion", "laws", "--by", "Ada")
    assert cartlab_here(*held, "team-1", "--why", "x").returncode == 2
    assert cartlab_here(*held, "--why", "x").returncode == 0
    with (out / "grades.csv").open(encoding="utf-8-sig", newline="") as file:
        assert "laws" not in next(csv.reader(file))
    export_ = ("export", str(out), "--lms", "canvas", "--out", str(tmp_path / "lms"))
    assert cartlab_here(*export_).returncode == 2
    assert not (tmp_path / "lms").exists()
    assert cartlab_here(*held, "--end").returncode == 0
    assert cartlab_here(*export_).returncode == 0


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
