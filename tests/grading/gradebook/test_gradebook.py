"""The gradebook works on a real SQLite file and on a real PostgreSQL server."""

import json
import os
import re
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from itertools import count

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import DBAPIError

from pipeline.errors import ConfigError
from pipeline.grading.grade import CODES
from pipeline.grading.gradebook import rows
from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.events import with_overrides
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import history_dict, history_text
from pipeline.grading.gradebook.schema import metadata
from tests.helpers.grades import (
    failed_grade,
    finish,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)
from tests.helpers.grading_students import criterion
from tests.helpers.places import ROOT

RUBRIC = two_cart_rubric()
FORKS = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")


@pytest.fixture
def open_book(place):
    """Open the gradebook with a clock that advances by one step at each call."""
    opened, tick = [], count()

    def opener(assignment="lab", create=True):
        start = datetime(2026, 3, 1, tzinfo=UTC)
        now = lambda: start + timedelta(minutes=next(tick))  # noqa: E731
        opened.append(Gradebook(place, assignment=assignment, create=create, now=now))
        return opened[-1]

    yield opener
    for book in opened:
        book.close()


def database(place):
    url = place.replace("postgresql:", "postgresql+psycopg:")
    return create_engine(url if "://" in url else f"sqlite:///{place}/{FILE}")


def test_an_outcome_is_read_back_unchanged(open_book):
    """An outcome with any Unicode text is unchanged after the gradebook is reopened."""
    grade = make_grade("tëam 学 '\"; DROP TABLE gradings; --", share=0.5, flags=(hertz_flag(),))
    outcome = make_outcome(
        grade,
        figures=(("step-1.svg", "<svg>é</svg>"), ("bode.svg", "<svg/>")),
        fingerprints=bytes(range(256)),
        owner="Ünal_4711",
        detail="Traceback\n  line",
        days_late=1.25,
        settled=False,
    )
    book = open_book()
    book.put(outcome)
    book.close()
    assert open_book().known(outcome.key) == outcome
    assert open_book().known("another key") is None


def test_runs_that_begin_at_once_make_one_gradebook(place):
    """Runs that start at the same time on an empty database share one gradebook."""
    with ThreadPoolExecutor(8) as runs:
        books = list(runs.map(lambda n: Gradebook(place, assignment=f"{n}", create=True), range(8)))
    for book in books:
        book.put(make_outcome(make_grade("team-1")))
        assert book.known("key of team-1")
        book.close()


def test_the_newest_of_a_key_counts(open_book):
    """If a submission is graded twice under the same key, the second outcome counts."""
    book, second = open_book(), make_outcome(make_grade("team-1"), key="k")
    book.put(make_outcome(failed_grade("team-1", "too slow"), key="k", settled=False))
    book.put(second)
    assert book.known("k") == second


def test_fingerprints_are_those_of_the_newest_outcomes(open_book):
    """Each submission's newest outcome gives its fingerprints, also those of other assignments."""
    earlier = open_book("lab of last year")
    earlier.put(make_outcome(make_grade("team-1", authors=("old",)), key="1", fingerprints=b"o"))
    book = open_book()
    book.put(make_outcome(make_grade("team-1"), key="2", fingerprints=b"first"))
    book.put(make_outcome(make_grade("team-1"), key="3", fingerprints=b"second"))
    found = {(p.submission, p.authors): p.fingerprints for p in book.fingerprints()}
    assert found == {("team-1", ("old",)): b"o", ("team-1", ("s-team-1",)): b"second"}


def test_reading_fingerprints_does_not_keep_a_writer_waiting(open_book, monkeypatch):
    """Outcomes can be stored while another program reads the fingerprints."""
    monkeypatch.setattr(rows, "_PAGE", 10)
    book = open_book()
    for n in range(15):  # the fingerprints fill more than one page
        book.put(make_outcome(make_grade(f"team-{n}")))
    prints = book.fingerprints()
    next(prints)
    book.put(make_outcome(make_grade("another")))
    assert sum(1 for _ in prints) == 14


def test_the_class_list_is_the_last_batch_that_ended(open_book):
    """Outcomes of a killed run count only if a later batch that ends includes them."""
    book = open_book()
    with pytest.raises(ConfigError, match="'lab'"):
        list(book.entries())
    finish(book, make_grade("b"), make_grade("a"))
    later = make_outcome(make_grade("a", share=0.0), key="a2")
    book.put(later)
    assert [(e.submission, e.grade.points) for e in book.entries()] == [("b", 20), ("a", 20)]
    finish(book, later)
    assert [(e.submission, e.grade.points) for e in book.entries()] == [("a", 0)]
    assert book.rubric == RUBRIC


def test_shared_data_is_flagged_in_the_class_list(open_book):
    """The class list has the flag for shared data until a later batch finds no shared data."""
    book, teams = open_book(), [make_grade(name, flags=(hertz_flag(),)) for name in "ab"]
    finish(book, *teams, shared={"a": shared_flag("b"), "b": shared_flag("a")})
    codes = [f.code for f in book.entry("a").grade.flags]
    assert codes == sorted(["shared_data", "hz_for_rad_s"], key=CODES.index)
    assert book.entry("a").grade.flags[1] == shared_flag("b")
    finish(book, *teams)
    assert [f.code for f in book.entry("a").grade.flags] == ["hz_for_rad_s"]


def test_points_given_by_hand_survive_regrading(open_book):
    """Points given by hand stay after a regrade, until they are removed.

    The deduction for lateness is computed again.
    """
    book = open_book()
    # Lateness costs a tenth, rounded to the rubric's quarter of a point: 1.1 → 1 and 0.65 → 0.75.
    finish(book, make_grade("team-1", share=0.5, days_late=1.0))
    given = book.override("team-1", "state-model", 2.0, why="right", by="Ada")
    assert (given.by, given.text) == ("Ada", "right")
    assert book.entry("team-1").grade.points == pytest.approx(10 + 1 - 1)
    again = make_grade("team-1", share=0.25, days_late=1.0)
    finish(book, again, key="again")
    grade = book.entry("team-1").grade
    assert grade.points == pytest.approx(5 - 0.5 + 2 - 0.75)
    assert grade.deducted == pytest.approx(0.75)
    model = criterion(grade, "state-model")
    assert (model.points, model.outcome) == (2.0, "pass")
    assert re.search(r"\b0\.5 to 2\b.*: right$", model.message)
    assert book.known("again of team-1").grade == make_outcome(again).grade
    book.override("team-1", "state-model", None, why="a mistake", by="Ada")
    assert book.entry("team-1").grade == again


def test_a_broken_submission_can_be_graded_by_hand(open_book):
    """A broken submission can get points by hand; it stays marked as not graded automatically."""
    book = open_book()
    finish(book, failed_grade("team-1", "no submission.toml"))
    book.override("team-1", "pieces", 1.0, why="on paper", by="Ada")
    grade = book.entry("team-1").grade
    assert (grade.status, grade.points, [c.id for c in grade.criteria]) == ("failed", 1, ["pieces"])


def test_an_override_goes_with_the_people(open_book):
    """An override belongs to the authors: a team that grows keeps it, another person does not.

    An id that differs in capitals and blanks is the same person.
    """
    book, kept = open_book(), []
    for who in (("ada 1",), (" Ada  1",), ("ada 1", "bo"), ("cy",)):
        finish(book, make_grade("team-1", share=0.0, authors=who), key=f"{who}")
        if not kept:
            book.override("ADA 1", "pieces", 1.0, why="seen", by="Ada")
        kept.append((book.entry("team-1").grade.points, bool(book.entry("team-1").overrides)))
    assert kept == [(1, True), (1, True), (1, True), (0, False)]


def test_points_count_at_once_while_the_class_is_graded_again(open_book):
    """Points belong to the authors on the class list, not to those of a grading not listed yet."""
    book = open_book()
    finish(book, make_grade("team-1", share=0.0, authors=("ann",)))
    book.put(make_outcome(make_grade("team-1", authors=("cy",)), key="not listed yet"))
    book.override("team-1", "pieces", 1.0, why="seen", by="Ada")
    assert book.entry("team-1").grade.points == 1


@pytest.mark.parametrize("key", ["key", "key of {}"])
def test_assignments_in_one_database_stay_apart(open_book, key):
    """An override in one lab has no effect in another, even if the grades have the same key.

    If no lab is named, the latest one is opened.
    """
    one, two = open_book("lab 1"), open_book("lab 2")
    for book, name in ((one, "1"), (two, "2")):
        finish(book, make_grade("team-1", share=0.0), key=key.format(name))
    one.override("team-1", "pieces", 1.0, why="seen", by="Ada")
    assert one.entry("team-1").grade.points == 1
    assert two.entry("team-1").grade.points == 0
    assert open_book(None, create=False).entry("team-1").grade.points == 0
    assert [event.what for event in two.history("team-1")[1]] == ["graded", "listed"]


def test_an_override_never_exceeds_the_points_of_the_rubric(open_book):
    """If a changed rubric has fewer points than an override, the override is lowered to them."""
    book = open_book()
    finish(book, make_grade("team-1", share=0.0))
    book.override("team-1", "state-model", 2.0, why="seen", by="Ada")
    entry = book.entry("team-1")
    model = criterion(entry.grade, "state-model")
    changed = model.model_copy(update={"points": 0.0, "out_of": 1.0})
    less = make_grade("team-1", criteria=(changed,))
    (line,) = with_overrides(less, entry.overrides, rubric=RUBRIC).criteria
    assert (line.points, line.outcome) == (1.0, "pass")


def test_fewer_points_by_hand_leave_out_that_all_is_right(open_book):
    """Of a criterion that passed, the message of the grader goes; that of another one stays."""
    book = open_book()
    for team, share in (("team-1", 1.0), ("team-2", 0.5)):
        finish(book, make_grade(team, share=share))
        said = criterion(book.entry(team).grade, "state-model").message
        book.override(team, "state-model", 0.25, why="copied", by="Ada")
        model = criterion(book.entry(team).grade, "state-model")
        assert (said in model.message, "copied" in model.message) == (share < 1, True)


@pytest.mark.parametrize(
    ("arguments", "why", "named"),
    [
        (("team-2", "pieces", 1.0), "x", "team-2: .*'team-1'"),
        (("team-01", "pieces", 1.0), "x", "team-01: .*'team-1'"),
        (("section", "pieces", 1.0), "x", "'mon-section' or 'tue-section'"),  # is in both
        (("team-1", "peices", 1.0), "x", "peices: .*pieces"),
        (("team-1", "xyz", 1.0), "x", "xyz: .*: pieces, "),
        (("team-1", "pieces", 1.5), "x", "pieces: .*1.5"),
        (("team-1", "pieces", -0.1), "x", "pieces: .*-0.1"),
        (("team-1", "pieces", float("nan")), "x", "pieces: .*nan"),
        (("team-1", "pieces", 1.0), " ", "--why"),
        (("team-1", "pieces", 0.3), "x", r"0\.25 or 0\.5"),
    ],
)
def test_an_override_that_makes_no_sense_is_refused(open_book, arguments, why, named):
    """An override that makes no sense is refused; the message names what is allowed."""
    book = open_book()
    finish(book, *map(make_grade, ("team-1", "mon-section", "tue-section")))
    with pytest.raises(ConfigError, match=named):
        book.override(*arguments, why=why, by="Ada")
    assert [event.what for event in book.history("team-1")[1]] == ["graded", "listed"]


def test_points_between_two_steps_can_be_restored(open_book):
    """Points that were given before the step of the rubric changed can be given again."""
    book, grade = open_book(), make_grade("team-1")
    finish(book, grade, rubric=RUBRIC.model_copy(update={"step": 0.1}))
    book.override("team-1", "pieces", 0.3, why="x", by="Ada")
    finish(book, grade)
    for points in (1.0, 0.3):
        book.override("team-1", "pieces", points, why="x", by="Ada")
    assert book.entry("team-1").overrides["pieces"].points == 0.3


def test_a_team_is_found_by_its_members(open_book):
    """A team can be named by one of its authors, unless the author is in several submissions."""
    book = open_book()
    finish(book, make_grade("team-1", authors=("ann", "bo")), make_grade("team-2", authors=("bo",)))
    assert book.entry("ann").submission == "team-1"
    with pytest.raises(ConfigError, match="bo: "):
        book.entry("bo")


def test_the_history_says_who_did_what_when_and_why(open_book):
    """The history lists every grading, override and change of the class list in order of time."""
    book, late = open_book(), make_grade("team-1", share=0.5, flags=(hertz_flag(),))
    finish(book, late)
    finish(book, late)  # nothing new
    book.override("team-1", "pieces", 1.0, why="all there", by="Ada")
    finish(book, late, shared={"team-1": shared_flag("team-9")})
    book.override("team-1", "pieces", None, why="was not", by="Bob")
    name, events = book.history("s-team-1")
    assert name == "team-1"
    assert [e.at for e in events] == sorted(e.at for e in events)
    assert [(e.what, e.points, e.by) for e in events] == [
        ("graded", 10.0, ""),
        ("listed", 10.0, ""),
        ("override", 1.0, "Ada"),
        ("listed", 10.5, ""),
        ("override", None, "Bob"),
    ]
    lines = history_text(name, events).splitlines()[1:]
    parts = ("(hz_for_rad_s)", "10 of 20", "all there", "(shared_data)", "was not")
    assert [part in line for part, line in zip(parts, lines, strict=True)] == [True] * 5
    assert all(re.match(r"2026-03-01 00:\d\d:00 UTC  ", line) for line in lines)
    assert json.loads(json.dumps(history_dict(name, events)))["events"][2]["by"] == "Ada"


def test_the_history_gives_the_new_name_of_a_team(open_book):
    """If a team's folder has a new name in the next run, the history says so under both names."""
    book, other = open_book(), make_grade("b")
    finish(book, make_grade("team-1", authors=("ann",)), other)
    finish(book, make_grade("group-1", authors=("ann",)), other, make_grade("c"))
    said = {name: [e.text for e in book.history(name)[1]] for name in ("team-1", "group-1", "c")}
    assert said["team-1"][-1].endswith("group-1")
    assert any("team-1" in text for text in said["group-1"])
    assert said["c"] == ["", ""]


def test_the_history_says_when_points_by_hand_do_not_count(open_book):
    """Points by hand end to count with other authors, and count again with the same."""
    book = open_book()
    finish(book, make_grade("team-1", share=0.0, authors=("ann",)))
    for points in (0.5, 1.0):
        book.override("team-1", "pieces", points, why="seen", by="Ada")
    book.adjust("team-1", -2.0, why="late", by="Ada")
    for run, who in enumerate((("ann", "bo"), ("anne",), ("anne",), ("ann",))):
        finish(book, make_grade("team-1", share=0.0, authors=who), key=f"run {run}")
    name, events = book.history("team-1")
    told = [e for e in events if e.what in ("dropped", "restored")]
    assert [event.what for event in told] == ["dropped", "restored"]
    assert all("pieces: 1 by Ada; total -2 by Ada" in event.text for event in told)
    assert history_text(name, events).count("dropped ") == 1


def test_teams_are_accepted_together_as_they_were_seen(book):
    """A team that got another event or another grading since it was listed is left out."""
    finish(book, *(make_grade(name, share=0.5) for name in ("team-1", "team-2", "team-3")))
    seen = {row.submission: row.whole_version for row in book.class_now().entries}
    book.override("team-1", "laws", 1.0, why="x", by="Bob")
    finish(book, make_grade("team-1", share=0.5), make_grade("team-2", share=0.5),
           make_outcome(make_grade("team-3"), key="again"))  # fmt: skip
    done = book.accept_all(seen, by="Ada")
    assert (done.teams, done.kept) == (1, ("team-1", "team-3"))
    assert {row.submission: row.reviewed_by for row in book.class_now().entries} == {
        "team-1": "", "team-2": "Ada", "team-3": ""}  # fmt: skip
    assert book.accept_all({"gone": "1.0"}, by="Ada").teams == 0


def test_a_team_whose_recordings_turn_out_to_be_shared_is_not_accepted(book):
    """A flag of the class list is part of what a person saw."""
    class_ = make_grade("team-1"), make_grade("team-2")
    finish(book, *class_)
    seen = {row.submission: row.whole_version for row in book.class_now().entries}
    finish(book, *class_, shared={"team-2": shared_flag("team-1")})
    done = book.accept_all(seen, by="Ada")
    assert (done.teams, done.kept) == (1, ("team-2",))
    assert all(row.whole_version == book.entry(row.submission).whole_version
               for row in book.class_now().entries)  # fmt: skip


def test_rows_are_only_added(book, place):
    """The database itself refuses to change or delete rows of any table."""
    graded = make_grade("team-3", flags=(hertz_flag(),))
    finish(book, make_outcome(graded, figures=(("a.svg", "<svg/>"),), findings="{}"))
    book.override("team-3", "pieces", 0.0, why="x", by="y")
    book.set_reviewed("team-3", by="y", reviewed=True)
    book.ask("team-3", "pieces", why="x", by="z")
    book.close()
    engine = database(place)
    for table in metadata.sorted_tables:
        column = table.columns.keys()[0]
        for attempt in (
            f"UPDATE {table.name} SET {column} = {column}",
            f"DELETE FROM {table.name}",
        ):
            refused = pytest.raises(DBAPIError, match="be changed")
            with refused, engine.begin() as connection:
                connection.execute(text(attempt))
        with engine.begin() as connection:
            assert connection.scalar(text(f"SELECT count(*) FROM {table.name}")) > 0
    engine.dispose()


@pytest.mark.slow
@pytest.mark.parametrize("kills", [pytest.param(12, marks=pytest.mark.sample), 300])
@FORKS
def test_kills_lose_nothing(place, kills):
    """After many kills of the writing process, each outcome is stored whole or not at all."""
    command = [sys.executable, "-m", "tests.helpers.gradebook_kills", place, str(kills)]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    done, within, told, there = map(int, re.findall(r"\d+", said.stdout))
    assert (done, there) == (kills, told)
    assert within > kills // 4  # most processes lived long enough to write


@pytest.mark.slow
@pytest.mark.sample
@FORKS
def test_a_kill_between_two_statements_loses_nothing(place):
    """Whatever a person does, a kill before any statement of it leaves all as it was."""
    command = [sys.executable, "-m", "tests.helpers.gradebook_kills", place, "statements"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    kills = {name: int(number) for name, number in re.findall(r"(\w+): kills (\d+)", said.stdout)}
    assert len(kills) == 12
    assert min(kills.values()) >= 5  # it looks for the team, reads it, and writes


# --------------------------------------------------------- places without a gradebook


def test_a_folder_may_have_the_name_of_a_database(tmp_path):
    """Whether a place is a folder or a file is decided by what exists there, not by its name."""
    (tmp_path / "lab.db").mkdir()
    for name in ("lab.db", "other.db"):
        Gradebook(tmp_path / name, create=True).close()
    assert (tmp_path / "lab.db" / FILE).is_file()
    assert (tmp_path / "other.db").is_file()


@pytest.mark.parametrize(
    ("url", "named"),
    [
        ("nonsense://", "nonsense://"),
        ("mysql+pymysql://u:secret@h/d", r"mysql\+pymysql://u:\*\*\*@h/d"),
        ("postgresql://u:secret@localhost:1/d", r"u:\*\*\*@localhost:1/d: .*(refused|No module)"),
        ("://", "URL"),
    ],
)
def test_a_useless_address_is_an_error_without_the_password(url, named):
    """If a driver or server is missing, or the text is no URL, one line says so."""
    with pytest.raises(ConfigError, match=named) as error:
        Gradebook(url, create=True)
    assert "secret" not in str(error.value)
    assert "\n" not in str(error.value)


def test_a_place_without_a_gradebook_of_this_version_is_an_error(tmp_path):
    """A missing gradebook, a text, another program's database and a later version are refused.

    Nothing is created.
    """
    file = tmp_path / FILE

    def refused(why: str) -> None:
        with pytest.raises(ConfigError, match=why):
            Gradebook(tmp_path)

    refused(r"gradebook\.sqlite; .*--out")
    assert list(tmp_path.iterdir()) == []
    file.write_text("name,points\n" * 100, encoding="utf-8")
    refused("database")
    file.unlink()
    with sqlite3.connect(file) as other:
        other.execute("CREATE TABLE songs (name TEXT)")
    other.close()
    refused("no gradebook")
    file.unlink()
    Gradebook(tmp_path, create=True).close()
    with sqlite3.connect(file) as book:
        book.execute("DROP TRIGGER settings_no_update")
        book.execute("UPDATE settings SET value = '3'")
    book.close()
    refused("version 3,")
