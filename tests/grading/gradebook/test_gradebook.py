"""The gradebook works on a real SQLite file and on a real PostgreSQL server."""

import json
import os
import re
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime, timedelta
from itertools import count

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.exc import DBAPIError

from pipeline.errors import ConfigError
from pipeline.grading.grade import CODES
from pipeline.grading.gradebook import rows
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import history_dict, history_text
from pipeline.grading.gradebook.override import with_overrides
from pipeline.grading.gradebook.request_gradebook import RequestGradebook
from pipeline.grading.gradebook.schema import FILE, metadata
from pipeline.grading.gradings import Batch
from tests.helpers.grades import (
    failed_grade,
    hertz_flag,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)
from tests.helpers.places import ROOT

RUBRIC = two_cart_rubric()


@pytest.fixture
def open_book(place):
    """Open the gradebook with a clock that advances by one step at each call."""
    opened, tick = [], count()

    def opener(assignment="lab", create=True):
        start = datetime(2026, 3, 1, tzinfo=UTC)
        book = Gradebook(
            place,
            assignment=assignment,
            create=create,
            now=lambda: start + timedelta(minutes=next(tick)),
        )
        opened.append(book)
        return book

    yield opener
    for book in opened:
        book.close()


def finish(book, *outcomes, shared=None):
    """Store outcomes and make them the class list."""
    for outcome in outcomes:
        if book.known(outcome.key) is None:
            book.put(outcome)
    batch = Batch(keys=tuple(o.key for o in outcomes), shared=shared or {})
    book.finish(batch, rubric=RUBRIC)


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


def test_a_folder_may_have_the_name_of_a_database(tmp_path):
    """Whether a place is a folder or a file is decided by what exists there, not by its name."""
    (tmp_path / "lab.db").mkdir()
    Gradebook(tmp_path / "lab.db", create=True).close()
    assert (tmp_path / "lab.db" / FILE).is_file()
    Gradebook(tmp_path / "other.db", create=True).close()
    assert (tmp_path / "other.db").is_file()


def test_the_newest_of_a_key_counts(open_book):
    """If a submission is graded twice under the same key, the second outcome counts."""
    book = open_book()
    book.put(make_outcome(failed_grade("team-1", "too slow"), key="k", settled=False))
    second = make_outcome(make_grade("team-1"), key="k")

    book.put(second)

    assert book.known("k") == second


def test_fingerprints_are_those_of_the_newest_outcomes(open_book):
    """Only the newest outcome of each submission gives its fingerprints.

    Fingerprints of other assignments are included.
    """
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
    """The class list is that of the last batch that ended.

    Outcomes of a killed run count only if a later batch that ends includes them.
    """
    book = open_book()
    with pytest.raises(ConfigError, match="no grading of 'lab' is complete"):
        list(book.entries())
    finish(book, make_outcome(make_grade("b"), key="b1"), make_outcome(make_grade("a"), key="a1"))
    book.put(make_outcome(make_grade("a", share=0.0), key="a2"))

    assert [(e.submission, e.grade.points) for e in book.entries()] == [("b", 20), ("a", 20)]
    finish(book, make_outcome(make_grade("a", share=0.0), key="a2"))
    assert [(e.submission, e.grade.points) for e in book.entries()] == [("a", 0)]
    assert book.rubric == RUBRIC


def test_shared_data_is_flagged_in_the_class_list(open_book):
    """The class list has the flag for shared data until a later batch finds no shared data."""
    book = open_book()
    outcomes = [make_outcome(make_grade(name, flags=(hertz_flag(),))) for name in "ab"]
    finish(book, *outcomes, shared={"a": shared_flag("b"), "b": shared_flag("a")})

    codes = [f.code for f in book.entry("a").grade.flags]
    assert codes == sorted(["shared_data", "hz_for_rad_s"], key=CODES.index)
    assert book.entry("a").grade.flags[1] == shared_flag("b")
    finish(book, *outcomes)
    assert [f.code for f in book.entry("a").grade.flags] == ["hz_for_rad_s"]


def test_points_given_by_hand_survive_regrading(open_book):
    """Points given by hand stay after a regrade, until they are removed.

    The deduction for lateness is computed again.
    """
    book = open_book()
    # Lateness costs a tenth, rounded to the rubric's quarter of a point: 1.1 → 1 and 0.65 → 0.75.
    first = make_grade("team-1", share=0.5, days_late=1.0)
    finish(book, make_outcome(first, key="1"))

    given = book.override("team-1", "state-model", 2.0, why="right in another order", by="Ada")

    assert (given.by, given.why, given.at) == ("Ada", "right in another order", given.at)
    assert book.entry("team-1").grade.points == pytest.approx(10 + 1 - 1)
    finish(book, make_outcome(make_grade("team-1", share=0.25, days_late=1.0), key="2"))
    grade = book.entry("team-1").grade
    assert grade.points == pytest.approx(5 - 0.5 + 2 - 0.75)
    assert grade.deducted == pytest.approx(0.75)
    (model,) = [c for c in grade.criteria if c.id == "state-model"]
    assert (model.points, model.outcome) == (2.0, "pass")
    assert model.message.endswith("Set by hand from 0.5 to 2 of 2: right in another order")
    assert (
        book.known("2").grade == make_outcome(make_grade("team-1", share=0.25, days_late=1.0)).grade
    )
    book.override("team-1", "state-model", None, why="a mistake", by="Ada")
    assert book.entry("team-1").grade == make_grade("team-1", share=0.25, days_late=1.0)


def test_a_broken_submission_can_be_graded_by_hand(open_book):
    """A broken submission can get points by hand; it stays marked as not graded automatically."""
    book = open_book()
    finish(book, make_outcome(failed_grade("team-1", "no submission.toml")))

    book.override("team-1", "pieces", 1.0, why="on paper", by="Ada")

    grade = book.entry("team-1").grade
    assert (grade.status, grade.points, [c.id for c in grade.criteria]) == ("failed", 1, ["pieces"])


def test_an_override_goes_with_the_people(open_book):
    """An override belongs to the authors: a team that grows keeps it.

    A team of the same name in another year does not get it.
    """
    book = open_book()
    finish(book, make_outcome(make_grade("team-1", share=0.0, authors=("ann",)), key="1"))
    book.override("team-1", "pieces", 1.0, why="seen", by="Ada")

    finish(book, make_outcome(make_grade("team-1", share=0.0, authors=("ann", "bo")), key="2"))
    assert book.entry("team-1").grade.points == 1
    finish(book, make_outcome(make_grade("team-1", share=0.0, authors=("cy",)), key="3"))
    assert book.entry("team-1").grade.points == 0


def test_assignments_in_one_database_stay_apart(open_book):
    """An override in one lab has no effect in another lab of the same database.

    If no lab is named, the latest one is opened.
    """
    one, two = open_book("lab 1"), open_book("lab 2")
    finish(one, make_outcome(make_grade("team-1", share=0.0), key="1"))
    finish(two, make_outcome(make_grade("team-1", share=0.0), key="2"))

    one.override("team-1", "pieces", 1.0, why="seen", by="Ada")

    assert one.entry("team-1").grade.points == 1
    assert two.entry("team-1").grade.points == 0
    assert open_book(None, create=False).entry("team-1").grade.points == 0


def test_the_same_submission_has_a_grade_in_each_assignment(open_book):
    """If a submission is graded in two assignments, each has its own grade and overrides.

    This holds even if both assignments use the same rubric, so that the grades have the same key.
    """
    one, two = open_book("lab 1"), open_book("lab 2")
    for book in (one, two):
        finish(book, make_outcome(make_grade("team-1"), key="same"))

    two.override("team-1", "pieces", 0.0, why="seen", by="Ada")

    assert one.entry("team-1").grade.points == 20
    assert two.entry("team-1").grade.points == 19
    assert [event.what for event in one.history("team-1")[1]] == ["graded", "listed"]


def test_an_override_never_exceeds_the_points_of_the_rubric(open_book):
    """If a changed rubric has fewer points than an override, the override is lowered to them."""
    book = open_book()
    outcome = make_outcome(make_grade("team-1", share=0.0))
    finish(book, outcome)
    book.override("team-1", "state-model", 2.0, why="seen", by="Ada")
    (model,) = [c for c in book.entry("team-1").grade.criteria if c.id == "state-model"]
    given = {"state-model": book.entry("team-1").overrides["state-model"]}

    changed = model.model_copy(update={"points": 0.0, "out_of": 1.0})
    less = make_grade("team-1", criteria=(changed,))

    (line,) = with_overrides(less, given, rubric=RUBRIC).criteria
    assert (line.points, line.outcome) == (1.0, "pass")


@pytest.mark.parametrize(
    ("arguments", "why", "message"),
    [
        (("team-2", "pieces", 1.0), "x", "team-2: no such submission; did you mean .team-1"),
        (("team-01", "pieces", 1.0), "x", "no such submission; did you mean .team-1.?"),
        (("team-1", "peices", 1.0), "x", "peices: the rubric has no such criterion; .*pieces"),
        (("team-1", "xyz", 1.0), "x", "no such criterion; known: pieces, .*"),
        (("team-1", "pieces", 1.5), "x", "pieces: expected 0 to 1 points, found 1.5"),
        (("team-1", "pieces", -0.1), "x", "pieces: expected 0 to 1 points"),
        (("team-1", "pieces", float("nan")), "x", "pieces: expected 0 to 1 points, found nan"),
        (("team-1", "pieces", 1.0), " ", "needs a reason"),
        (("team-1", "pieces", 0.3), "x", r"step, 0\.25: give 0\.25 or 0\.5"),
    ],
)
def test_an_override_that_makes_no_sense_is_refused(open_book, arguments, why, message):
    """An override that makes no sense is refused; the message says what is allowed."""
    book = open_book()
    finish(book, make_outcome(make_grade("team-1")))

    with pytest.raises(ConfigError, match=message):
        book.override(*arguments, why=why, by="Ada")

    assert [event.what for event in book.history("team-1")[1]] == ["graded", "listed"]


def test_a_name_that_several_submissions_end_with_suggests_them(open_book):
    """A team that is in two sections is suggested with both."""
    book = open_book()
    finish(book, *(make_outcome(make_grade(f"{at}-Team-13")) for at in ("mon", "tue")))
    with pytest.raises(ConfigError, match=r"did you mean 'mon-Team-13' or 'tue-Team-13'\?"):
        book.override("team-13", "pieces", 1.0, why="x", by="Ada")


def test_points_between_two_steps_can_be_restored(open_book):
    """Points that were given before the step of the rubric changed can be given again."""
    book = open_book()
    fine = RUBRIC.model_copy(update={"step": 0.1})
    outcome = make_outcome(make_grade("team-1"))
    book.put(outcome)
    book.finish(Batch(keys=(outcome.key,), shared={}), rubric=fine)
    book.override("team-1", "pieces", 0.3, why="x", by="Ada")
    book.finish(Batch(keys=(outcome.key,), shared={}), rubric=RUBRIC)
    book.override("team-1", "pieces", 1.0, why="x", by="Ada")
    book.override("team-1", "pieces", 0.3, why="x", by="Ada")
    assert book.entry("team-1").overrides["pieces"].points == 0.3


def test_a_team_is_found_by_its_members(open_book):
    """A team can be named by one of its authors, unless the author is in several submissions."""
    book = open_book()
    finish(
        book,
        make_outcome(make_grade("team-1", authors=("ann", "bo"))),
        make_outcome(make_grade("team-2", authors=("bo",))),
    )

    assert book.entry("ann").submission == "team-1"
    with pytest.raises(ConfigError, match="bo: is in several submissions"):
        book.entry("bo")


def test_the_history_says_who_did_what_when_and_why(open_book):
    """The history lists every grading, override and change of the class list in order of time."""
    book = open_book()
    late = make_outcome(make_grade("team-1", share=0.5, flags=(hertz_flag(),)), key="1")
    finish(book, late)
    finish(book, late)  # nothing new
    book.override("team-1", "pieces", 1.0, why="all there", by="Ada")
    finish(book, late, shared={"team-1": shared_flag("team-9")})
    book.override("team-1", "pieces", None, why="was not", by="Bob")

    name, events = book.history("s-team-1")

    assert name == "team-1"
    assert [e.at for e in events] == sorted(e.at for e in events)
    assert [(e.what, e.points) for e in events] == [
        ("graded", 10.0),
        ("listed", 10.0),
        ("override", 1.0),
        ("listed", 10.5),
        ("override", None),
    ]
    lines = history_text(name, events).splitlines()
    assert lines[1].endswith("UTC  graded    10 of 20  (hz_for_rad_s)")
    assert lines[3].endswith("UTC  override  pieces: 1 by hand, by Ada: all there")
    assert lines[4].endswith("UTC  listed    10.5 of 20  (shared_data)")
    assert lines[5].endswith("UTC  override  pieces: automatic points again, by Bob: was not")
    assert all(re.match(r"2026-03-01 00:\d\d:00 UTC  ", line) for line in lines[1:])
    assert json.loads(json.dumps(history_dict(name, events)))["events"][2]["by"] == "Ada"


def test_the_history_gives_the_new_name_of_a_team(open_book):
    """If a team's folder has a new name in the next run, the history says so under both names."""
    book = open_book()
    finish(
        book, make_outcome(make_grade("team-1", authors=("ann",))), make_outcome(make_grade("b"))
    )
    finish(
        book,
        make_outcome(make_grade("group-1", authors=("ann",))),
        make_outcome(make_grade("b")),
        make_outcome(make_grade("c")),
    )

    assert [e.text for e in book.history("team-1")[1]][-1].endswith("continues as group-1")
    assert "was team-1 before" in [e.text for e in book.history("group-1")[1]]
    assert [e.text for e in book.history("c")[1]] == ["", ""]


def test_rows_are_only_added(open_book, place):
    """The database itself refuses to change or delete rows of any table."""
    book = open_book()
    figures = (("a.svg", "<svg/>"),)
    graded = make_grade("team-1", flags=(hertz_flag(),))
    finish(book, make_outcome(graded, figures=figures, findings="{}"))
    book.override("team-1", "pieces", 0.0, why="x", by="y")
    book.close()
    with closing(RequestGradebook(place)) as shared:
        shared.set_reviewed("team-1", by="y", reviewed=True)
        shared.release(True, by="y")
        shared.ask("team-1", "pieces", why="x", by="z")

    url = place.replace("postgresql:", "postgresql+psycopg:")
    engine = create_engine(url if "://" in url else f"sqlite:///{place}/{FILE}")
    assert len(metadata.sorted_tables) == 11
    for table in metadata.sorted_tables:
        column = table.columns.keys()[0]
        for attempt in (
            f"UPDATE {table.name} SET {column} = {column}",
            f"DELETE FROM {table.name}",
        ):
            with (
                pytest.raises(DBAPIError, match="entries of a gradebook cannot be changed"),
                engine.begin() as connection,
            ):
                connection.execute(text(attempt))
        with engine.begin() as connection:
            assert connection.scalar(text(f"SELECT count(*) FROM {table.name}")) > 0
    engine.dispose()


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")
def test_a_dozen_kills_lose_nothing(place):
    """After twelve kills of the writing process, each outcome is stored whole or not at all."""
    assert_nothing_lost(place, kills=12)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")
def test_three_hundred_kills_lose_nothing(place):
    """After 300 kills of the writing process, each outcome is stored whole or not at all."""
    assert_nothing_lost(place, kills=300)


def assert_nothing_lost(place: str, *, kills: int) -> None:
    command = [sys.executable, "-m", "tests.helpers.gradebook_kills", place, str(kills)]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    done, within, told, there = map(int, re.findall(r"\d+", said.stdout))
    assert done == kills
    assert there == told
    assert within > kills // 4  # most processes lived long enough to write


# --------------------------------------------------------- places without a gradebook


def test_a_place_without_a_gradebook_is_an_error(tmp_path):
    """If a place has no gradebook, reading it is an error and creates no file."""
    with pytest.raises(ConfigError, match=r"holds no gradebook\.sqlite; give the --out folder"):
        Gradebook(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("nonsense://", "nonsense://.*: no driver"),
        ("mysql+pymysql://u:secret@h/d", r"mysql\+pymysql://u:\*\*\*@h/d: no driver"),
        ("postgresql://u:secret@localhost:1/d", r"u:\*\*\*@localhost:1/d: .*(refused|No module)"),
        ("://", "not a database URL"),
    ],
)
def test_a_useless_address_is_an_error_without_the_password(url, message):
    """An address that cannot be used gives an error of one line without the password.

    For example, a driver is missing, no server answers, or the text is not a URL.
    """
    with pytest.raises(ConfigError, match=message) as error:
        Gradebook(url, create=True)
    assert "secret" not in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_a_gradebook_is_an_error(tmp_path):
    """A file that is not a gradebook of this version is refused with an error.

    It may be a text file, another program's database, or a gradebook of a later version.
    """
    file = tmp_path / FILE
    file.write_text("name,points\n" * 100, encoding="utf-8")
    with pytest.raises(ConfigError, match="file is not a database"):
        Gradebook(tmp_path)
    file.unlink()
    with sqlite3.connect(file) as other:
        other.execute("CREATE TABLE songs (name TEXT)")
    other.close()
    with pytest.raises(ConfigError, match="holds no gradebook"):
        Gradebook(tmp_path)
    file.unlink()
    Gradebook(tmp_path, create=True).close()
    with sqlite3.connect(file) as book:
        book.execute("DROP TRIGGER settings_no_update")
        book.execute("UPDATE settings SET value = '2'")
    book.close()
    with pytest.raises(ConfigError, match="is a gradebook of version 2, and this cartlab uses 1"):
        Gradebook(tmp_path)
