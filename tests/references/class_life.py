"""The whole life of one class, as people see it: a desk, the command line and the exports.

A class is graded, reviewed, changed by hand, released, questioned, answered, graded again with
another rubric and exported. The facts are what a person reads: histories, grades, tables, the
states on the pages, and the status of each answer.
"""

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from html import unescape
from io import StringIO
from pathlib import Path
from unittest.mock import patch
from urllib.parse import urlencode, urlsplit

from pipeline.cli import main
from pipeline.desk import jobs
from pipeline.desk.app import DeskServer
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from tests.helpers.desks import Answer, Visitor, WorkerHere, through_proxy, write_users
from tests.helpers.grades import make_grade, make_outcome, two_cart_rubric, write_class
from tests.references.facts import Facts, read_facts

ROOM, HERE, QUEUE = "/grades/0/", "/feedback/0/", "/grades/0/requests"
TEAMS = ("team-01", "team-02", "team-03", "team-04", "team-05", "broken")
PLATFORMS = ("canvas", "moodle", "gradescope")
STAFF = {"Ada": "ta", "Bob": "ta", "prof": "instructor"}
USERS = "".join(
    f'[[users]]\nname = "{name}"\nrole = "{role}"\ngradebooks = ["grades"]\n'
    for name, role in STAFF.items()
) + (
    '[[users]]\nname = "s4"\nrole = "student"\n'
    'grades = [{ gradebook = "grades", submission = "team-04" }]\n'
)
_TIME = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+(?:[+-]\d\d:?\d\d|Z)?")
_STATES = re.compile(r'data-(?:state|code)="([^"]*)"')


def life(folder: Path, *, anonymous: bool) -> Facts:
    """Return what people see of a class at each moment of its life."""
    grades = write_class(folder / "grades", anonymous=anonymous)
    users, found = write_users(folder, USERS), {}
    with _all_work_here(), DeskServer(users=users) as server:
        port = urlsplit(server.url).port or 0
        people = {name: through_proxy(port, name) for name in ("Ada", "Bob", "prof", "s4")}
        for name, act in (
            ("graded", lambda: []),
            ("reviewed", lambda: reviewed(people)),
            ("changed", lambda: changed(people, grades)),
            ("asked", lambda: asked(people)),
            ("answered", lambda: answered(people)),
            ("together", lambda: changed_together(people)),
            ("graded again", lambda: graded_again(grades, anonymous=anonymous)),
            ("removed", lambda: [_says("remove", grades, "team-05")["exit"]]),
        ):
            statuses = act()
            found[name] = {"statuses": statuses, **seen(people, grades, anonymous=anonymous)}
    found["exports"] = exports(grades, folder)
    return found


# -------------------------------------------------------------------------------- what happens


def reviewed(people: dict[str, Visitor]) -> list[int]:
    """Mark two submissions as reviewed, and take one mark back."""
    ada = people["Ada"]
    return [
        ada.post(_team("team-01"), do="accept").status,
        ada.post(_team("team-03"), do="accept").status,
        ada.post(_team("team-03"), do="unsee").status,
    ]


def changed(people: dict[str, Visitor], grades: Path) -> list[int]:
    """Change points at the desk and by commands; a change of something older is refused."""
    ada, bob = people["Ada"], people["Bob"]
    old = _version(ada.get(_team("team-04", criterion="laws")), "laws")
    by = ("--by", "Cleo")
    return [
        _change(ada, "team-04", old, points="0.5", why="half right"),
        _change(bob, "team-04", old, points="1", why="right"),  # Bob saw the points before Ada's
        _change(bob, "team-01", "", points="1", why="A fine report."),  # a comment only
        _says("override", grades, "team-03", "laws", "0.75", "--why", "seen", *by)["exit"],
        _says("override", grades, "team-03", "laws", "auto", "--why", "not so", *by)["exit"],
        _says("override", grades, "team-03", "laws", "9", "--why", "too much", *by)["exit"],
        _says("adjust", grades, "team-05", "-2", "--why", "late at the bench", *by)["exit"],
        _says("override", grades, "broken", "laws", "1", "--why", "read by eye", *by)["exit"],
    ]


def asked(people: dict[str, Visitor]) -> list[int]:
    """Ask about a criterion before and after the release, twice, and about one with all points."""
    student, prof = people["s4"], people["prof"]
    ask = {"criterion": "laws", "why": "see page 3"}
    return [
        student.post(HERE + "ask", **ask).status,
        people["Ada"].post(ROOM + "release", do="release").status,
        prof.post(ROOM + "release", do="release").status,
        student.post(HERE + "ask", **ask).status,
        student.post(HERE + "ask", **ask).status,
        student.post(HERE + "ask", criterion="poles", why="the order differs").status,
        student.post(HERE + "ask", criterion="nothing", why="?").status,
    ]


def answered(people: dict[str, Visitor]) -> list[int]:
    """Answer one request with points, answer it again, reopen it, and hide the feedback."""
    ada = people["Ada"]
    fields = _request(ada.get(QUEUE))
    answer = {**fields, "do": "answer", "points": "0.75", "text": "you are right"}
    statuses = [ada.post(QUEUE, **answer).status, ada.post(QUEUE, **answer).status]
    settled = _request(ada.get(QUEUE), at=-1)
    statuses.append(ada.post(QUEUE, **settled, do="reopen").status)
    statuses.append(people["s4"].post(HERE + "ask", criterion="laws", why="once more").status)
    statuses.append(people["prof"].post(ROOM + "release", do="hide").status)
    statuses.append(people["prof"].post(ROOM + "release", do="release").status)
    return statuses


def changed_together(people: dict[str, Visitor]) -> list[int]:
    """Give several teams the same points at once, and take one of two such changes back."""
    ada = people["Ada"]
    address = ROOM + "bulk-change?" + urlencode({"flag": "hz_for_rad_s", "criterion": "laws"})
    statuses = []
    for points, why in (("0.5", "one unit"), ("0.25", "one unit, twice")):
        page = ada.get(f"{address}&points={points}")
        seen = {
            f"seen.{unescape(name)}": unescape(version)
            for name, version in re.findall(r'name="seen\.(.*?)" value="(.*?)"', page.text)
        }
        ticked = [("team", name.removeprefix("seen.")) for name in seen]
        given = {"do": "apply", "points": points, "why": why, "listed": "1"}
        form = urlencode([*seen.items(), *given.items(), *ticked]).encode()
        answer = ada.send(address, form, kind="application/x-www-form-urlencoded")
        statuses.append(answer.status)
    done = ada.get(answer.headers["location"])
    undo = ada.post(answer.headers["location"], do="undo", set=done.value("set"))
    return [*statuses, undo.status]


def graded_again(grades: Path, *, anonymous: bool) -> list[str]:
    """Grade again with another rubric: one team is better, one is new, one has another name."""
    rubric = two_cart_rubric()
    fewer = tuple(
        c.model_copy(update={"points": c.points / 2}) if c.id == "laws" else c
        for c in rubric.criteria
    )
    rubric = rubric.model_copy(update={"criteria": fewer, "anonymous": anonymous})
    with Gradebook(grades, assignment="lab") as book:
        listed = list(book.listed())
        keys = {one.submission: f"key of {one.submission}" for one in listed}
        better = make_grade("team-04", share=0.95, authors=("s3",))
        new = make_grade("team-99", share=0.5, days_late=2.0, authors=("s99",))
        for grade, key in ((better, "second key of team-04"), (new, "key of team-99")):
            book.put(make_outcome(grade, key=key))
        keys |= {"team-04": "second key of team-04", "team-99": "key of team-99"}
        changes = book.finish(Batch(keys=tuple(keys.values()), shared={}), rubric=rubric)
    return changes


# ------------------------------------------------------------------------------- what is seen


def seen(people: dict[str, Visitor], grades: Path, *, anonymous: bool) -> Facts:
    """Return what the pages, the histories and the tables say at this moment."""
    ada, student = people["Ada"], people["s4"]
    pages = {
        "class": ada.get(ROOM),
        "requests": ada.get(QUEUE),
        "own": student.get(HERE),
        **({} if anonymous else {name: ada.get(_team(name)) for name in TEAMS}),
    }
    return {
        "pages": {name: _page(page) for name, page in pages.items()},
        "histories": {name: _says("history", grades, name, "--json") for name in TEAMS},
        "entries": _entries(grades),
    }


def exports(grades: Path, folder: Path) -> Facts:
    """Return the tables for each platform, with and without its roster, and the class files."""
    found: Facts = {}
    for platform in PLATFORMS:
        out = folder / "exports" / platform
        out.mkdir(parents=True)
        status = _says("export", grades, "--lms", platform, "--out", out / "grades.csv")["exit"]
        found[platform] = {"exit": status, **read_facts(out)}
    roster = folder / "roster.csv"
    heads = ("Student", "ID", "SIS User ID", "SIS Login ID", "Section", "Lab (7)")
    rows = [heads, *((f"Name {n}", str(n), f"s{n}", f"s{n}", "1", "3") for n in range(14))]
    roster.write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
    filled = folder / "exports" / "filled"
    filled.mkdir()
    out = ("--out", filled / "grades.csv", "--title", "Lab")
    said = _says("export", grades, "--lms", "canvas", "--roster", roster, *out)
    found["roster"] = {"exit": said["exit"], **read_facts(filled)}
    return found | {"class": read_facts(grades)}


def _entries(grades: Path) -> Facts:
    """Return points, flags and hand-given points of each submission on the class list."""
    with Gradebook(grades) as book:
        grades_now = [entry.grade for entry in book.entries()]
    return {
        grade.submission: {
            "points": grade.points,
            "deducted": grade.deducted,
            "criteria": {c.id: [c.outcome, c.points, c.out_of] for c in grade.criteria},
            "overrides": {o.criterion: [o.points, o.why] for o in grade.overrides},
            "adjustments": [[a.points, a.why] for a in grade.adjustments],
            "flags": [flag.code for flag in grade.flags],
        }
        for grade in grades_now
    }


def _page(answer: Answer) -> Facts:
    """Return the states on a page, and the numbers of points that it shows."""
    text = re.sub(r"<(script|style).*?</\1>", "", answer.text, flags=re.DOTALL)
    points = re.findall(r"[\d.]+ of [\d.]+ points", re.sub(r"<[^>]+>", "", text))
    return {"status": answer.status, "states": _STATES.findall(text), "points": points}


def _says(*command: str | Path) -> Facts:
    """Return the exit status of a command and what it prints; times are left out."""
    said = StringIO()
    with patch.object(sys, "argv", ["cartlab", *map(str, command)]):
        try:
            with redirect_stdout(said), redirect_stderr(StringIO()):
                main()
            status = 0
        except SystemExit as end:
            status = int(end.code or 0)
    text = _TIME.sub("…", said.getvalue())
    return {"exit": status, "said": json.loads(text) if text.startswith("{") else text.split("\n")}


# ------------------------------------------------------------------------------------ forms


def _team(name: str, **more: str) -> str:
    return f"{ROOM}team?{urlencode({'of': name, **more})}"


def _version(page: Answer, criterion: str) -> str:
    asked = rf'value="{criterion}"><input type="hidden" name="(?:seen|version)" value="(.*?)"'
    found = re.search(asked, page.text)
    return unescape(found[1]) if found else ""


def _change(who: Visitor, team: str, version: str, **fields: str) -> int:
    address = _team(team, criterion="laws")
    version = version or _version(who.get(address), "laws")
    known = {"do": "change", "criterion": "laws", "seen": version, "version": version}
    return who.post(_team(team), **known, **fields).status


def _request(page: Answer, at: int = 0) -> dict[str, str]:
    """Return the hidden fields of a request on the page of all requests."""
    found = {}
    for name in ("team", "criterion", "seen", "version"):
        if values := re.findall(rf'name="{name}" value="(.*?)"', page.text):
            found[name] = unescape(values[at])
    return found


@contextmanager
def _all_work_here() -> Iterator[None]:
    with patch.object(jobs, "Supervisor", WorkerHere):
        yield
