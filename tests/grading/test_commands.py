"""The commands that are used after grading are run as typed."""

import csv
import io
import json
import os
import re
import sqlite3
import stat
import sys
from contextlib import closing
from pathlib import Path

import pytest

from pipeline.cli import main
from pipeline.cli.common import set_encoding
from pipeline.simulated.submission import write_submission
from tests.grading.publish.test_survey import write_paper
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import book_of, make_grade, write_class


def run(*words: object) -> tuple[int, str, str]:
    """Run a command; return its exit status, stdout and stderr."""
    done = cartlab_here(*words)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def grades(tmp_path_factory) -> Path:
    """Return a graded class, which no test may change."""
    return write_class(tmp_path_factory.mktemp("grades"))


def points_of(folder: Path, team: str) -> float:
    text = (folder / "feedback" / team / "grade.json").read_text(encoding="utf-8")
    return json.loads(text)["points"]


def test_a_class_with_a_submission_that_cannot_be_graded_is_status_one(tmp_path):
    """The others are graded, and the command names the folder that it could not grade."""
    write_submission(tmp_path / "class" / "good", "throne-1dof", seed=1, compact=True)
    spoilt = tmp_path / "class" / "spoilt"
    spoilt.mkdir()
    (spoilt / "submission.toml").write_text("[system\n", encoding="utf-8")
    out = tmp_path / "grades"
    status, _, err = run("grade", tmp_path / "class", "--rubric", "throne-1dof", "--out", out)
    assert status == 1
    assert "spoilt: " in err
    with (out / "grades.csv").open(encoding="utf-8", newline="") as file:
        assert {row["submission"]: row["status"] for row in csv.DictReader(file)} == {
            "good": "graded",
            "spoilt": "failed",
        }


def test_an_override_reaches_the_pages_at_once(tmp_path):
    """An override appears on the pages at once, and `auto` removes it.

    The history lists the override and its removal.
    """
    grades = write_class(tmp_path)
    before = points_of(grades, "team-03")

    by = ("--why", "complete", "--by", "Ada")
    status, out, err = run("override", grades, "s2", "pieces", "1", *by)
    assert (status, out) == (0, "")
    assert err.split()[:2] == ["team-03:", f"{before + 0.1:g}"]
    assert points_of(grades, "team-03") == pytest.approx(before + 0.1)
    assert "complete" in (grades / "feedback/team-03/feedback.html").read_text(encoding="utf-8")
    run("override", grades, "team-03", "pieces", "auto", *by)
    assert points_of(grades, "team-03") == before
    status, out, _ = run("history", grades, "team-03")
    assert (status, len(out.splitlines())) == (0, 5)
    assert out.count("Ada: complete") == 2
    _, out, _ = run("history", grades, "team-03", "--json")
    assert [event["what"] for event in json.loads(out)["events"]] == [
        "graded", "listed", "override", "override",
    ]  # fmt: skip


def test_an_anonymous_team_is_corrected_by_its_pseudonym(tmp_path):
    """An anonymous team can be corrected under its pseudonym, and no output shows its name."""
    grades = write_class(tmp_path, anonymous=True)
    with (grades / "anonymous-key.csv").open(newline="", encoding="utf-8") as file:
        names = {row["submission"]: row["anonymous"] for row in csv.DictReader(file)}
    anon, broken = names["team-03"], names["broken"]
    status, _, err = run("override", grades, anon, "pieces", "1", "--why", "all", "--by", "Ada")
    assert (status, err.startswith(f"{anon}: ")) == (0, True)
    assert points_of(grades, anon) == pytest.approx(float(err.split()[1]))
    _, out, _ = run("history", grades, anon)
    assert out.startswith(f"{anon}\n")
    assert "team-03" not in out
    assert "by Ada: all" in out
    _, out, _ = run("history", grades, broken)
    assert "be graded" in out
    assert run("history", grades, "anon-nobody")[0] == 2


def test_removing_points_by_hand_gives_a_message(tmp_path):
    """If a removed submission had points given by hand, a message lists it."""
    grades = write_class(tmp_path)
    status, _, err = run("remove", grades, "team-02", "s2")
    assert status == 0
    assert [line.partition(": ")[2] for line in err.splitlines()] == ["team-02, team-03", "team-02"]
    assert run("remove", grades, "team-02")[0] == 2


ROSTERS = {
    "canvas": "Student,ID,SIS User ID,Section\nDoe,7,s1,A\n",
    "moodle": "Identifier,Full name,ID number,Grade\nParticipant 7,Doe,s1,\n",
    "gradescope": "First Name,Last Name,SID,Email,Total Score\nJane,Doe,s1,,\n",
}


def in_two_submissions(folder: Path, author: str) -> None:
    """Make a class in which an author has different points in two submissions, a and b."""
    class_ = [make_grade(name, share=1 / n, authors=(author,)) for n, name in ((1, "a"), (2, "b"))]
    with book_of(folder, *class_):
        pass


def test_control_characters_in_a_name_are_blanks(tmp_path):
    """Control characters in an author's id are printed as blanks."""
    in_two_submissions(tmp_path, "eve\r\x1b[2Kbob")
    status, _, err = run("export", tmp_path, "--lms", "canvas")
    assert err.startswith("eve  [2Kbob ")
    assert status == 1  # the cell of an author with points is empty in the table


@pytest.mark.parametrize("lms", sorted(ROSTERS))
@pytest.mark.parametrize("listed", [False, True])
def test_a_person_in_two_submissions_makes_every_export_fail(tmp_path, lms, listed):
    """If a person is in two submissions, each export omits the person and ends with status 1."""
    in_two_submissions(tmp_path, "s1")
    roster = tmp_path / "roster.csv"
    roster.write_text(ROSTERS[lms], encoding="utf-8")
    status, _, err = run("export", tmp_path, "--lms", lms, *(["--roster", roster] * listed))
    assert re.search(r"s1 .*a \(20\) and b \(10\)", err)
    assert status == 1


def test_letters_that_a_console_lacks_are_written_as_numbers(grades, monkeypatch):
    """A letter that the console cannot show is written as its number, and the JSON stays valid."""
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(raw, encoding="cp1252"))
    monkeypatch.setattr(
        sys, "argv", ["cartlab", "history", str(grades), "Ünal 学生 & co", "--json"]
    )
    with pytest.raises(SystemExit) as end:
        main()
    sys.stdout.flush()
    assert not end.value.code
    assert json.loads(raw.getvalue().decode("cp1252"))["submission"] == "Ünal 学生 & co"


@pytest.mark.parametrize("lms", sorted(ROSTERS))
def test_an_export_is_written_where_it_was_asked_for(grades, tmp_path, lms):
    """It is written beside the grades, into a folder, or alone into a file `….csv`."""
    status, out, err = run("export", grades, "--lms", lms)
    assert (status, out) == (0, "")
    assert f"wrote {grades / lms}.csv" in err
    assert ": broken" in err
    run("export", grades, "--lms", lms, "--out", tmp_path / "elsewhere", "--title", "Lab")
    assert (tmp_path / "elsewhere" / f"{lms}.csv").is_file()
    file = tmp_path / "exported" / "gs.csv"
    status, _, err = run("export", grades, "--lms", lms, "--out", file)
    assert (status, err.strip().endswith(f"wrote {file}")) == (0, True)
    assert [path.name for path in file.parent.iterdir()] == ["gs.csv"]
    assert file.read_bytes() == (grades / f"{lms}.csv").read_bytes()
    status, _, err = run("export", grades, "--lms", lms, "--out", tmp_path / "gs.xlsx")
    assert (status, "gs.xlsx: " in err) == (2, True)


def test_an_export_that_omits_points_ends_with_status_1(grades, tmp_path):
    """If the platform's roster lacks a team with points, the export ends with status 1."""
    roster = tmp_path / "roster.csv"
    roster.write_text("Student,ID,SIS User ID,Section\nDoe,7,nobody-here,A\n", encoding="utf-8")
    status, _, err = run("export", grades, "--lms", "canvas", "--roster", roster)
    assert "roster.csv" in err
    assert status == 1


def test_a_class_without_grades_asks_about_the_rubric(tmp_path):
    """If no submission could be graded, the message asks if the rubric belongs to another lab.

    Lateness is recorded nevertheless.
    """
    for name in ("team-1", "team-2"):
        (tmp_path / "c" / name).mkdir(parents=True)
        file = tmp_path / "c" / name / "submission.toml"
        file.write_text("version = 1\n[system]\ncarts = 1\n", encoding="utf-8")
    late = tmp_path / "late.csv"
    late.write_text("submission,days_late\nteam-1,2.5\nteam-9,1\n", encoding="utf-8")
    out = tmp_path / "out"
    status, _, err = run(
        "grade", tmp_path / "c", "--rubric", "throne-2dof", "--out", out, "--lateness", late,
        "--jobs", 1,
    )  # fmt: skip
    assert status == 1
    said = err.splitlines()
    for line, part in zip(said, ("team-9", "team-1: ", "team-2: ", "throne-2dof"), strict=False):
        assert part in line
    assert (len(said), said[-1].endswith(str(out))) == (5, True)
    with (out / "grades.csv").open(newline="", encoding="utf-8") as file:
        assert [row["days_late"] for row in csv.DictReader(file)] == ["2.5", "0"]
    inside = tmp_path / "c" / "team-1" / "grades"
    status, _, err = run("grade", tmp_path / "c", "--rubric", "throne-2dof", "--out", inside)
    assert (status, inside.exists()) == (2, False)
    assert "inside a" in err


@pytest.mark.slow
@pytest.mark.sample
def test_an_anonymous_grading_names_nobody_on_stderr(tmp_path, monkeypatch):
    """An anonymous grading prints no name on stderr, neither in progress lines nor in warnings."""
    monkeypatch.setattr("pipeline.cli.common.FIRST_WORD", 0.001)
    # A pseudonym contains no 1, since base 32 has only the digits 2 to 7.
    names = ["doe1-jane1", "roe1-richard1", "poe1-anna1", "moe1-max1"]
    toml = 'version = 1\n[[authors]]\nid = "{name}"\n[system]\ncarts = {carts}\n'
    for name, carts in zip(names, ("1", "1", '"two"', "1"), strict=True):
        (tmp_path / "c" / name).mkdir(parents=True)
        text = toml.format(name=name, carts=carts)
        (tmp_path / "c" / name / "submission.toml").write_text(text, encoding="utf-8")
    (tmp_path / "c" / "moe1-max1" / "submission.toml").unlink()
    (tmp_path / "c" / "moe1-max1" / "feedback").mkdir()
    (tmp_path / "c" / "moe1-max1" / "feedback" / ".made.json").write_text("{}", encoding="utf-8")
    (tmp_path / "c" / "moe1-max1" / "class.html").write_text("", encoding="utf-8")
    late, out = tmp_path / "late.csv", tmp_path / "out"
    late.write_text("submission,days_late\ndoe1-jane1,2.5\nmoe1-max1,1\n", encoding="utf-8")
    words = ("grade", tmp_path / "c", "--rubric", "throne-1dof", "--out", out, "--jobs", 1,
             "--anonymous", "--no-figures", "--lateness", late)  # fmt: skip
    said = [run(*words)[2]]
    assert "1 folder" in said[0]
    assert "1 name" in said[0]
    assert re.search(r"anon-\w+: anon-\w+/submission.toml: system.carts", said[0])
    run("override", out, "roe1-richard1", "pieces", "1", "--why", "x", "--by", "Ada")
    (tmp_path / "c" / "roe1-richard1").rename(tmp_path / "c" / "coe1-richard1")
    text = toml.format(name="poe1-anna1", carts="1") + '[design]\nmethod = "place"\n'
    (tmp_path / "c" / "poe1-anna1" / "submission.toml").write_text(text, encoding="utf-8")
    (tmp_path / "c" / "doe1-jane1" / "submission.toml").unlink()
    (tmp_path / "c" / "doe1-jane1").rmdir()
    said.append(run(*words)[2])
    assert ": anon-" in said[1]
    for text in said:
        assert not [part for name in names for part in name.split("-") if part in text], text


@pytest.mark.parametrize(
    ("platform", "console", "expected"),
    [
        ("win32", False, "Ünal 学\n".encode()),  # a pipe or a file, which another program reads
        ("win32", True, b"\xdcnal \\u5b66\n"),
        ("linux", False, b"\xdcnal \\u5b66\n"),  # as the user chose
    ],
)
def test_pipes_of_windows_get_utf_8(platform, console, expected, monkeypatch):
    """On Windows, only a console gets the language's code page, in which JSON is not valid."""
    monkeypatch.delenv("PYTHONIOENCODING", raising=False)
    raw = io.BytesIO()
    raw.isatty = lambda: console
    stream = io.TextIOWrapper(raw, encoding="cp1252", newline="\n" if console else None)
    set_encoding(stream, platform=platform)
    stream.write("Ünal 学\n")
    stream.flush()
    assert raw.getvalue() == expected


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other rights")
def test_only_the_owner_can_read_names_and_grades(tmp_path):
    """The folder of grades, gradebook and key can be read only by their owner, whatever the umask.

    Files from earlier runs are restricted too, but a group keeps its access to the gradebook.
    """
    (tmp_path / "c" / "team-1").mkdir(parents=True)
    (tmp_path / "c" / "team-1" / "submission.toml").write_text("version = 1\n", encoding="utf-8")
    out = tmp_path / "new" / "out"
    words = ("grade", tmp_path / "c", "--rubric", "throne-1dof", "--out", out, "--jobs", 1,
             "--anonymous", "--no-figures")  # fmt: skip

    def modes(*names: str) -> list[str]:
        return [oct(stat.S_IMODE((out / name).stat().st_mode)) for name in names]

    before = os.umask(0)
    try:
        run(*words)
        assert modes("", "gradebook.sqlite", "anonymous-key.csv") == ["0o700", "0o600", "0o600"]
        with closing(sqlite3.connect(out / "gradebook.sqlite", isolation_level=None)) as book:
            for journal, beside in (("DELETE", ["-journal"]), ("WAL", ["-wal", "-shm"])):
                book.execute(f"PRAGMA journal_mode = {journal}")
                book.execute("BEGIN IMMEDIATE")
                book.execute("CREATE TABLE more (x)")
                assert modes(*(f"gradebook.sqlite{end}" for end in beside)) == ["0o600"] * len(
                    beside
                )
                book.execute("ROLLBACK")
            book.execute("PRAGMA journal_mode = DELETE")
        (out / "gradebook.sqlite").chmod(0o664)
        (out / "anonymous-key.csv").chmod(0o664)
        run(*words)
        assert modes("gradebook.sqlite", "anonymous-key.csv") == ["0o660", "0o600"]
    finally:
        os.umask(before)


def test_a_survey_is_printed_on_stdout(tmp_path):
    """A survey is printed as Markdown or JSON; columns left out are listed on stderr."""
    file = write_paper(tmp_path / "answers.csv")
    status, out, err = run("survey", file)
    assert status == 0
    assert out.startswith("| Question ")
    assert err.endswith(": Timestamp\n")
    assert json.loads(run("survey", file, "--json")[1])["students"] == 13


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("history nowhere team-1", "nowhere: "),
        ("history {grades} team-99", "team-99: "),
        ("override {grades} team-01 pieces lots --why x --by y", "lots:"),
        ("export {grades} --lms blackboard", "blackboard"),
        ("export {grades} --lms canvas --roster none.csv", "none.csv"),
        ("survey none.csv", "none.csv"),
        ("export mysql://u:secret@h/d --lms canvas", "mysql://u:***@h/d"),
    ],
)
def test_a_command_that_fails_prints_one_line(grades, tmp_path, monkeypatch, words, message):
    """A command that cannot be carried out ends with status 2 and a message of one line.

    The message contains neither a traceback nor a password.
    """
    monkeypatch.chdir(tmp_path)
    status, out, err = run(*(word.format(grades=grades) for word in words.split()))
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert "secret" not in err
