"""Students who must find the numbers themselves can ask the desk's check, not its report."""

import io
import re
import zipfile
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pipeline.desk.app import ROUTES
from pipeline.desk.student.files import list_held, list_missing
from pipeline.desk.users import User, Visibility, read_users
from pipeline.errors import ConfigError
from pipeline.grading.self_check.answers import FILE, read_answers
from pipeline.resources import RUBRICS
from pipeline.submission import load_submission
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import (
    Answer,
    Visitor,
    a_submission,
    at_desk,
    at_lab,
    listed_user,
    retype,
    write_users,
)
from tests.helpers.waiting import until

HERE = "/student/0/"
pytestmark = pytest.mark.usefixtures("all_work_here")
OPEN = {  # pages that show no computed number
    "", "files", "fill", "aside", "save", "experiments", "check", "hand-in", "hand-in.zip",
    "events", "stop",
}  # fmt: skip
USERS = (
    listed_user("s1", "student", folders='["team"]', rubric='"lab.toml"')
    + listed_user("s2", "student", folders='["other"]')
    + listed_user("i", "instructor", folders='["team"]')
)


@pytest.fixture
def root(tmp_path):
    """Write a lab server's folders: one team has a frequency in Hz, and a report exists."""
    for name in ("team", "other"):
        retype(a_submission(tmp_path / name), "omega_n = 13.1", "omega_n = 2.085")
        (tmp_path / name / "report").mkdir()
        for file in ("report.html", "results.json", "report.pdf"):
            (tmp_path / name / "report" / file).write_text("13.1", encoding="utf-8")
    text = (RUBRICS / "throne-1dof.toml").read_text(encoding="utf-8")
    (tmp_path / "lab.toml").write_text(text + '\n[students]\nsee = "check"\n', encoding="utf-8")
    return tmp_path


@pytest.fixture
def lab(root):
    """Start a desk behind a proxy for the folders of `root`; return visitors by name."""
    with at_lab(root, USERS) as visitor:
        yield visitor


def ask_check(visitor: Visitor, **fields: str) -> Answer:
    """Ask the check, wait for its answer, and return the page."""
    assert visitor.post(f"{HERE}check", **fields).status == 303
    until(lambda: "data-events" not in visitor.get(f"{HERE}check").text)
    return visitor.get(f"{HERE}check")


def words_of(page: Answer) -> str:
    """Return the words in the main part of a page."""
    main = re.search(r"<main.*</main>", page.text, re.DOTALL)
    assert main
    return " ".join(unescape(re.sub(r"<[^>]*>", " ", main[0])).split())


def test_students_who_must_find_the_numbers_get_no_report(lab):
    """Students who must find the numbers get no page, file or task that may show one.

    The answer is 403; their page offers the check instead.
    """
    student, other, instructor = lab("s1"), lab("s2"), lab("i")
    for path in ("report/report.html", "report/results.json", "report/report.pdf", "gap/gap.json"):
        assert student.get(HERE + path).status == 403
    for path, method, _ in ROUTES:
        if path.startswith("/student/") and path.split("/")[3] not in OPEN:
            address = re.sub(r"\{\w+:(\w+)\}", "0", path)
            ask = student.get if method == "GET" else student.post
            assert ask(address).status == 403, path
    assert student.get("/solution/0/").status == 403
    assert other.get(f"{HERE}report").status == 200
    assert instructor.get(f"{HERE}report").status == 200
    assert other.get(f"{HERE}report/results.json").status == 200
    page = student.get(HERE).text
    assert f'href="{HERE}check"' in page
    for part in ("report", "make-report", "compare"):
        assert HERE + part not in page
    assert f'href="{HERE}check"' not in other.get(HERE).text


def test_a_report_by_an_instructor_shows_them_no_number(lab):
    """If an instructor makes a report in a student's folder, the student sees no number of it.

    The page only says that some work is in progress.
    """
    student, instructor = lab("s1"), lab("i")
    assert instructor.post(f"{HERE}make-report").status == 303
    assert "The report" not in words_of(student.get(f"{HERE}hand-in"))
    told = set(re.findall(r"^data: (.+)$", student.get(f"{HERE}events").text, re.MULTILINE))
    assert told <= {"under way", "done"}
    assert "asks" not in words_of(student.get(f"{HERE}hand-in"))  # nor the report's questions


def test_the_check_says_which_number_is_wrong_then_where(lab, root):
    """First the check names the wrong number, then it says where to look.

    No page shows the right value.
    """
    student = lab("s1")
    assert student.get(f"{HERE}check").state == {"check": "none"}
    which = ask_check(student)
    assert which.state == {"check": "wrong"}
    assert 'name="number" value="initial.omega_n"' in which.text
    where = ask_check(student, number="initial.omega_n")
    assert "Hz where" in words_of(where)
    for page, times in ((which, 1), (where, 2)):
        said = words_of(page)
        assert f"run {times} time" in said
        said = said.replace("2.085", "").replace("2π", "")
        said = re.sub(
            r"\d+ of \d+ numbers|\d+ agree|run \d+ times?|[a-z]+-\d+|[AB]\([\d, ]+\)", "", said
        )
        assert re.findall(r".{0,20}\d.{0,20}", re.sub(r"\b1 of \d+", "", said)) == []
    assert [one.stage for one in read_answers(root / "team")] == ["which", "where"]

    retype(root / "team", "omega_n = 2.085", "omega_n = 13.1")
    assert student.get(f"{HERE}check").state == {"check": "old"}
    assert ask_check(student).state == {"check": "right"}


def test_the_answers_are_zipped_and_never_replaced(lab, root):
    """The zip has the file of answers but no report, and no upload or zip replaces this file."""
    student = lab("s1")
    ask_check(student)
    before = (root / "team" / FILE).read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(FILE, "")
    student.upload(f"{HERE}files", [(FILE, b""), ("work.zip", packed.getvalue())])
    student.post(f"{HERE}aside", file=FILE)
    assert (root / "team" / FILE).read_bytes() == before
    assert student.post(f"{HERE}hand-in").status == 303
    page = student.get(f"{HERE}hand-in").text.replace("<wbr>", "")
    assert (FILE in page, "report.pdf" in page) == (True, False)
    with zipfile.ZipFile(io.BytesIO(student.get(f"{HERE}hand-in.zip").body)) as archive:
        names = archive.namelist()
        assert FILE in names
        assert not [name for name in names if name.startswith(("report", "gap"))]
        assert archive.read(FILE) == before


def test_a_result_file_is_not_zipped_as_a_recording(root):
    """If a submission names a result file as a recording, the zip leaves this file out.

    The student is told that the file is computed.
    """
    team, result = root / "team", "report/results.json"
    retype(team, f'"{load_submission(team).experiments[0].file}"', f'"{result}"')
    assert result in list_missing(team)[0]
    assert result not in list_held(team, report=False)


def test_on_a_students_computer_the_submission_hides_the_report(tmp_path):
    """On a student's own computer, a line in the submission hides the report.

    Anyone with the folder can remove the line.
    """
    folder = a_submission(tmp_path / "team")
    retype(folder, "[system]", '[students]\nsee = "check"\n\n[system]')
    with at_desk(folder) as owner:
        assert owner.get(f"{HERE}report").status == 403
        assert owner.post(f"{HERE}make-report").status == 403
        retype(folder, '[students]\nsee = "check"\n', "")
        assert owner.get(f"{HERE}report").status == 200


@pytest.mark.parametrize(
    ("role", "keys", "said"),
    [
        ("ta", {"rubric": '"lab.toml"'}, "cannot have a rubric"),
        ("student", {"folders": '["team"]', "rubric": '"none.toml"'}, "no such rubric"),
    ],
)
def test_a_wrong_rubric_in_the_list_is_one_line(root, role, keys, said):
    """A wrong rubric in the file of users is refused with an error that says what is wrong."""
    with pytest.raises(ConfigError, match=said):
        read_users(write_users(root, listed_user("x", role, **keys)))


@pytest.mark.slow
@pytest.mark.sample
def test_the_ta_sees_how_often_the_check_was_run(root):
    """The team's page for the TA says how often the check was run."""
    for _ in range(2):
        cartlab_here("check", root / "other")
    cartlab_here("grade", root / "other", "--rubric", RUBRICS / "throne-1dof.toml",
                 "--out", root / "grades", "--jobs", 1, "--no-figures")  # fmt: skip
    with at_desk(opened=root / "grades") as ta:
        assert "run 2 times" in ta.get("/grades/0/team?of=other").text


@pytest.mark.parametrize(
    ("role", "see", "task", "told"),
    [
        ("student", "check", "make_report", False),
        ("student", "check", "check_numbers", True),
        ("student", "report", "make_report", True),
        ("instructor", "check", "make_report", True),
    ],
)
def test_the_stages_of_a_report_are_hidden_from_those_who_may_only_check(role, see, task, told):
    """`show_job` leaves out the message of a task that tells computed numbers."""
    workers: Any = None  # none of these cases asks a worker
    job: Any = SimpleNamespace(task=(task,), message="K = 24.3", without_message=lambda: None)
    user = User(name="s1", role=role, see=see)
    shown = Visibility(workers).show_job(job, user, Path("team"))
    assert (shown is job) == told
