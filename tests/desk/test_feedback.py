"""Without scripts, students read their feedback and ask about it, and TAs answer."""

import re
from collections.abc import Callable, Iterator
from html import unescape
from urllib.parse import quote, urlencode

import pytest

from pipeline.desk.users import read_users
from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import MOST_LETTERS, MOST_OPEN
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.grading.rubric_file import load_rubric
from pipeline.resources import RUBRICS
from tests.helpers.desks import (
    Answer,
    Visitor,
    a_submission,
    at_lab,
    listed_user,
    write_users,
)
from tests.helpers.grades import failed_grade, make_outcome, two_cart_rubric, write_class
from tests.helpers.hostile import SECRET

pytestmark = pytest.mark.usefixtures("all_work_here")
HERE, ROOM, QUEUE = "/feedback/0/", "/grades/0/", "/grades/0/requests"
GRADE = '{{ gradebook = "grades", submission = "{}" }}'


STUDENTS = {
    "s4": [GRADE.format("team-04")],
    "s5": [GRADE.format("team-05").replace(" }", ', assignment = "lab" }')],
    "s6": [GRADE.format("team-06"), GRADE.format("team-06").replace(" }", ', assignment = "x" }'),
           GRADE.format("s5")],
    "s0": [],
}  # fmt: skip


USERS = "".join(
    listed_user(name, "student", grades=f"[{', '.join(grades)}]") if grades
    else listed_user(name, "student") for name, grades in STUDENTS.items()
).replace('"s5"\nrole = "student"', '"s5"\nrole = "student"\nfolders = ["five"]')  # fmt: skip


USERS += "".join(
    listed_user(name, role, gradebooks='["grades"]')
    for name, role in (("Ada", "ta"), ("Bob", "ta"), ("prof", "instructor"))
)
HOSTILE = (
    "<script>alert(1)</script> {{ 7 * 7 }} '\"><img src=x onerror=alert(1)> \u202egnp.\x1b[31m"
)


Lab = Callable[[str], Visitor]


@pytest.fixture
def lab(tmp_path, request) -> Iterator[Lab]:
    """Start a desk with a graded, unreleased class; yield a function that returns a visitor."""
    write_class(tmp_path / "grades", anonymous=getattr(request, "param", False))
    a_submission(tmp_path / "five")
    with at_lab(tmp_path, USERS) as visitor:
        yield visitor


def release(lab: Lab, do: str = "release") -> Lab:
    """Let the class read its feedback, or hide it again."""
    assert lab("prof").post(ROOM + "release", do=do).status == 303
    return lab


@pytest.fixture
def released(lab):
    """Return `lab` with the class released."""
    return release(lab)


@pytest.fixture
def book(tmp_path, lab):
    """Return the class's gradebook."""
    with Gradebook(tmp_path / "grades") as book:
        yield book


def ask(who: Visitor, criterion: str = "laws", why: str = "see page 3") -> Answer:
    """Send the form of a criterion."""
    return who.post(HERE + "ask", criterion=criterion, why=why)


def fields(answer: Answer, at: int = 0) -> dict[str, str]:
    """Return the hidden fields of a request's form in the queue."""
    names = ("team", "criterion", "seen")
    found = [re.findall(rf'name="{name}" value="(.*?)"', answer.text)[at] for name in names]
    return dict(zip(names, map(unescape, found), strict=True))


# ------------------------------------------------------------------------- who reads what


def test_a_criterion_is_held_back_from_all_students(released, book):
    """Any TA holds it back; students see that, and nothing of it; only an instructor ends it.

    A request that was sent before is hidden with its answer, and a new one is refused.
    """
    student, ta = released("s4"), released("Ada")
    ask(student)
    laws = next(one for one in book.rubric.criteria if one.id == "laws")
    before = student.get(HERE)
    assert 'id="criterion-laws"' in before.text
    assert before.state["held"] == "0"
    assert ta.post(ROOM + "hold", do="hold", criterion="laws", why="").status == 422
    assert ta.post(ROOM + "hold", do="hold", criterion="laws", why="second marker").status == 303
    assert 'id="held-criteria"' in ta.get(ROOM).text
    for page in (student.get(HERE), student.get(HERE + "whole")):
        assert "second marker" not in page.text
        assert "see page 3" not in page.text
        assert f"of {20 - laws.points:g}" in page.text
    shown = student.get(HERE)
    assert 'id="criterion-laws"' not in shown.text
    assert (shown.state["held"], shown.state["waiting"]) == ("1", "0")
    assert ask(student).status == 422
    assert ta.post(ROOM + "export", lms="canvas").status == 422
    for who, status in ((student, 403), (ta, 403), (released("prof"), 303)):
        assert who.post(ROOM + "hold", do="let_go", criterion="laws").status == status
    assert student.get(HERE).state == before.state


def test_students_see_nothing_before_the_release(lab):
    """Students see no feedback before it is released; only an instructor can release or hide it."""
    student = lab("s4")
    assert student.get(HERE).state == {"feedback": "hidden"}
    assert "points" not in student.get(HERE).text
    assert student.get(HERE + "whole").status == 404
    assert ask(student).status == 422
    for name in ("Ada", "s4"):
        assert lab(name).post(ROOM + "release", do="release").status == 403
    assert student.get(HERE).state == {"feedback": "hidden"}
    release(lab)
    assert student.get(HERE).state["points"] == "16.99"
    whole = student.get(HERE + "whole")
    assert "omega_1" in whole.text or "ω" in whole.text
    assert "default-src 'none'" in whole.headers["content-security-policy"].split("; ")
    release(lab, "hide")
    assert student.get(HERE).state == {"feedback": "hidden"}
    assert student.get(HERE + "whole").status == 404


def test_nobody_reads_the_feedback_of_another_student(released):
    """No number, path or role lets a student read or question another student's feedback."""
    student = released("s4")
    assert student.get("/").headers["location"] == HERE
    assert "team-04" in student.get(HERE).text
    for path in ("/feedback/1/", "/feedback/-1/", "/feedback/1/whole", "/feedback/0/team-05",
                 "/feedback/0/../1/", "/feedback/0/whole?of=team-05", "/feedback/x/"):  # fmt: skip
        answer = student.get(path)
        assert answer.status == 404 or "team-05" not in answer.text, path
    assert student.post("/feedback/1/ask", criterion="laws", why="x").status == 404
    for path in (ROOM, QUEUE, ROOM + "team?of=team-04", ROOM + "feedback/team-04/feedback.html"):
        assert student.get(path).status == 403
        assert student.post(path).status in (403, 405)
    for name in ("Ada", "prof"):
        assert released(name).get(HERE).status == 403
        assert ask(released(name)).status == 403
    assert released("s0").get(HERE).status == 404


def test_a_student_sees_the_grade_that_the_list_names(released, tmp_path):
    """A student sees only the grade of the submission that the file of users names.

    If that grade or the gradebook is missing, the page shows neither its path nor the cause.
    """
    six = released("s6")
    assert "team-06" in six.get(HERE).text
    assert six.get("/feedback/1/").state == {"feedback": "hidden"}
    wrong = six.get("/feedback/2/")  # the name in the list is an author's, not the submission's
    assert wrong.status == 422
    assert [f'href="/feedback/{n}/"' in six.get("/").text for n in range(3)] == [True] * 3
    home = released("s5").get("/").text
    assert 'href="/feedback/0/"' in home
    assert "/student/0/" in home
    (tmp_path / "grades").rename(tmp_path / "elsewhere")
    for answer in (wrong, released("s4").get(HERE), ask(released("s4"))):
        assert answer.status == 422
        assert str(tmp_path) not in answer.text
        assert "gradebook" not in answer.text


@pytest.mark.parametrize(
    ("role", "grades", "why"),
    [
        ("ta", '{ gradebook = "g", submission = "a" }', "cannot have grades"),
        ("student", '{ gradebook = "h", submission = "a" }', "not exist"),
        ("student", '{ gradebook = "g" }', "submission"),
        ("student", '{ gradebook = "g", submission = "" }', "submission"),
        ("student", '{ gradebook = "postgresql://h/d", submission = "a" }', "add assignment"),
    ],
)
def test_a_wrong_grade_on_the_list_is_one_line(role, grades, why, tmp_path):
    """A wrong grade in the file of users is refused with an error that says what is wrong."""
    (tmp_path / "g").mkdir()
    path = write_users(tmp_path, listed_user("s", role, grades=f"[{grades}]"))
    with pytest.raises(ConfigError, match=why):
        read_users(path)


# ---------------------------------------------------------------------- asked and answered


def test_a_request_goes_from_the_student_to_the_ta_and_back(released, book):
    """A student's request appears in the TA's queue; the answer and its points reach the student.

    Both see every step, and each page of the TA shows the number of requests.
    """
    student, ta = released("s4"), released("Ada")
    one = f'href="{QUEUE}">1 '
    assert one not in ta.get(ROOM).text
    assert ask(student).status == 303
    assert student.get(HERE).state["waiting"] == "1"
    assert one in ta.get(ROOM).text
    assert "(1 asked)" in ta.get(ROOM).text.split("</nav>")[0]
    queue = ta.get(QUEUE)
    assert queue.state == {"waiting": "1"}
    for shown in ("see page 3", "s4 asked", "ω₁ is off.", "0.85 of 1"):
        assert shown in queue.text  # also the criterion that was asked about
    assert f"{ROOM}team?of=team-04&criterion=laws#chosen" in unescape(queue.text)
    text = "Page 3\nis right."
    done = ta.post(QUEUE, do="answer", points="0.5", text=text, **fields(queue))
    assert (done.status, done.headers["location"]) == (303, QUEUE)
    page = student.get(HERE)
    assert (page.state["waiting"], page.state["answered"]) == ("0", "1")
    assert "Ada answered: 0.5" in page.text
    assert text in page.text
    assert book.entry("team-04").overrides["laws"].points == 0.5
    assert ta.get(QUEUE).state == {"waiting": "0"}
    team = ta.get(ROOM + "team?of=team-04&criterion=laws").text
    (link,) = re.findall(r'href="([^"]*requests\?[^"]*)"', team)
    assert ta.get(unescape(link)).status == 200
    for step in (r"asked +laws: by s4: see page 3", r"answered +laws: 0.5 by hand, by Ada"):
        assert re.search(step, team)
    assert ask(student).status == 422
    assert 'id="why-laws"' not in student.get(HERE).text
    assert ta.post(QUEUE, do="reopen", **fields(ta.get(QUEUE))).status == 303
    assert 'id="why-laws"' in student.get(HERE).text
    assert ask(student, why="and page 4").status == 303


def test_a_refused_request_is_explained_at_its_field(released, book):
    """If a request or answer is refused, its field shows a message and keeps the typed text."""
    student, ta = released("s4"), released("Ada")
    long = "x" * (MOST_LETTERS + 1)
    refused = ask(student, why=long)
    assert (refused.status, refused.wrong_fields) == (422, {"why-laws"})
    assert long in refused.text
    assert book.n_waiting() == 0
    ask(student)
    sent = fields(ta.get(QUEUE))
    for points, text in (("99", "kept words"), ("auto", "kept words"), ("1", ""), ("1", long)):
        answer = ta.post(QUEUE, do="answer", points=points, text=text, **sent)
        assert (answer.status, 'role="alert"' in answer.text) == (422, True)
        assert text in answer.text
    for status, do, changed in (
        (400, "drop", {}), (404, "answer", {"team": "team-99"}),
        (422, "answer", {"text": "x", "criterion": "pieces"}),
        (409, "answer", {"text": "x", "seen": ""}),
    ):  # fmt: skip
        assert ta.post(QUEUE, do=do, **sent | changed).status == status
    assert book.n_waiting() == 1
    assert not book.entry("team-04").overrides


def test_a_team_may_have_only_a_few_open_requests(released):
    """A team with too many open requests cannot send another; a message at the field says so."""
    criteria = [criterion.id for criterion in two_cart_rubric().criteria]
    for criterion in criteria[:MOST_OPEN]:
        assert ask(released("s4"), criterion).status == 303
    refused = ask(released("s4"), criteria[MOST_OPEN])
    assert (refused.status, refused.wrong_fields) == (422, {f"why-{criteria[MOST_OPEN]}"})


def test_the_second_of_two_answers_sees_both(released, book):
    """If two TAs answer a request, the second is refused and sees both answers."""
    ask(released("s4"))
    seen = {name: fields(released(name).get(QUEUE)) for name in ("Ada", "Bob")}
    first = {"points": "0.5", "text": "ada's words"}
    assert released("Ada").post(QUEUE, do="answer", **first, **seen["Ada"]).status == 303
    second = {"points": "1", "text": "bob's words"}
    answer = released("Bob").post(QUEUE, do="answer", **second, **seen["Bob"])
    assert answer.status == 409
    cells = [unescape(cell) for cell in re.findall(r"<td>(.*?)</td>", answer.text)]
    assert cells == ["1", "0.5", "bob's words", "ada's words", "Bob", "Ada"]
    assert [e.what for e in book.history("team-04")[1]].count("answered") == 1
    assert book.entry("team-04").overrides["laws"].by == "Ada"


def test_hostile_text_is_shown_as_plain_text(released):
    """Markup, templates and control characters in a request or answer appear as plain text."""
    student, ta = released("s4"), released("Ada")
    assert ask(student, why=HOSTILE).status == 303
    assert ask(student, "pieces", why="\u202e" * 40 + SECRET).status == 303
    pages = [ta.get(QUEUE), student.get(HERE)]
    ta.post(QUEUE, do="answer", points="", text=HOSTILE, **fields(pages[0]))
    pages += [
        ta.get(QUEUE), ta.get(QUEUE + "?of=team-04"),
        ta.get(ROOM), ta.get(ROOM + "team?of=team-04"),
        student.get(HERE), student.get(HERE + "whole"),
    ]  # fmt: skip
    for page in pages:
        assert page.status == 200
        body = page.text.split("<main")[-1]
        assert not re.search(r"<(?!/?script src=\"/static/)script>alert|<img src=x", body)
        assert not [mark for mark in "\u202e\x1b" if mark in body]
    assert "{{ 7 * 7 }}" in student.get(HERE).text
    assert ta.get(f"{QUEUE}?{urlencode({'of': HOSTILE})}").status == 404


@pytest.mark.parametrize("lab", [True], indirect=True)
def test_an_anonymous_class_has_anonymous_requests(released, book):
    """In an anonymous class no page of a TA names the student, who still gets the answer."""
    student, ta = released("s5"), released("Ada")
    assert ask(student, why="I am S5 of team-05, see page 3").status == 303
    queue = ta.get(QUEUE)
    sent = fields(queue)
    assert sent["team"].startswith("anon-")
    team = f"{ROOM}team?{urlencode({'of': sent['team']})}"
    ta.post(QUEUE, do="answer", points="1", text="yes", **sent)
    for page in (queue, ta.get(QUEUE), ta.get(team), ta.get(f"{QUEUE}?of={quote(sent['team'])}")):
        assert page.status == 200
        for name in ("team-05", "s5", "S5"):
            assert not re.search(rf"\b{name}\b", page.text), name
        assert "see page 3" in page.text
    assert student.get(HERE).state["answered"] == "1"
    whole = student.get(HERE + "whole").text
    assert "team-05" in whole
    assert book.entry("team-05").overrides["laws"].points == 1.0
    for other in ("team-01", "team-04"):
        assert other not in whole + student.get(HERE).text


@pytest.mark.parametrize("by_class", [False, True])
def test_students_who_must_find_the_numbers_see_none(tmp_path, by_class):
    """Students who must find the numbers see points, outcomes and flags, but no numbers.

    The student's own rubric decides this; without one, the class's rubric does.
    """
    write_class(tmp_path / "grades")
    a_submission(tmp_path / "five")
    text = (RUBRICS / "throne-2dof.toml").read_text(encoding="utf-8")
    rubric = tmp_path / "lab.toml"
    rubric.write_text(text + '\n[students]\nsee = "check"\n', encoding="utf-8")
    users = USERS.replace("[[users]]", '[[users]]\nrubric = "lab.toml"', 1)
    if by_class:
        users = USERS
        with Gradebook(tmp_path / "grades", assignment="lab") as book:
            keys = tuple(entry.key for entry in book.entries())
            book.finish(Batch(keys=keys, shared={}), rubric=load_rubric(rubric))
    with at_lab(tmp_path, users) as lab:
        student = release(lab)("s4")
        page = student.get(HERE)
        assert page.state["points"] == "16.99"
        assert "Hz where" in page.text
        assert not re.search(r"3\.12|19\.6|<table", page.text)
        assert f"{HERE}whole" not in page.text
        assert student.get(HERE + "whole").status == 403
        assert "19.6" in lab("Ada").get(ROOM + "team?of=team-04").text
        assert ask(student, why="please").status == 303


def test_a_student_reads_that_a_stopped_submission_is_not_graded_yet(lab, tmp_path):
    """If a limit ended the grading, the student sees no points and no lost criteria."""
    stopped = failed_grade("team-04", "stopped").model_copy(update={"unsettled": True})
    outcome = make_outcome(stopped, key="stopped", authors=("s4",), settled=False)
    with Gradebook(tmp_path / "grades", assignment="lab") as book:
        book.put(outcome)
        others = (entry.key for entry in book.entries() if entry.submission != "team-04")
        book.finish(Batch(keys=(*others, "stopped"), shared={}), rubric=two_cart_rubric())
    page = release(lab)("s4").get(HERE)
    assert page.state["feedback"] == "waits"
    assert 'id="lost-title"' not in page.text
    assert not re.search(r"0 of \d", page.text)
