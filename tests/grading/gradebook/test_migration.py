"""A gradebook of version 0.2.0 comes into the form of this version, and says the same as before.

`version_1` holds one as SQL: of a class of three teams that used every table, written by that
version on SQLite and on PostgreSQL, with its triggers. `seen.json` is what that version said of it.
The clock of one computer was late, so the newest points of team-1 have the oldest time.
"""

import json
import os
import re
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import Engine, create_engine, inspect, text
from sqlalchemy.exc import DBAPIError

from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import history_text
from tests.helpers.grades import finish, make_grade, seen
from tests.helpers.places import ROOT

DATA = Path(__file__).parent / "version_1"
SEEN = json.loads((DATA / "seen.json").read_text(encoding="utf-8"))
OLD = {"overrides": 10, "looks": 3, "request_events": 9, "releases": 1}  # numbers of rows
FORKS = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked here")


@pytest.fixture
def old(place):
    """Return the place of the gradebook of version 0.2.0."""
    if "://" not in place:
        script = (DATA / "sqlite.sql").read_text(encoding="utf-8")
        with closing(sqlite3.connect(Path(place) / FILE)) as file:
            file.executescript(script)
        return place
    engine = _engine(place)
    with engine.begin() as connection:
        connection.exec_driver_sql((DATA / "postgresql.sql").read_text(encoding="utf-8"))
    engine.dispose()
    return place


def _engine(place: str) -> Engine:
    url = place.replace("postgresql:", "postgresql+psycopg:")
    return create_engine(url if "://" in url else f"sqlite:///{place}/{FILE}")


def _change(place: str, *statements: str) -> None:
    engine = _engine(place)
    with engine.begin() as connection:
        for statement in statements:
            connection.execute(text(statement))
    engine.dispose()


def _say(book: Gradebook) -> dict:
    """Return what a gradebook says of its class, in the form of `seen.json`."""
    teams = {
        entry.submission: {
            "points": entry.grade.points,
            "criteria": {c.id: c.points for c in entry.grade.criteria},
            "messages": {c.id: c.message for c in entry.grade.criteria},
            "reviewed_by": entry.reviewed_by,
            "requests": {id_: request.state for id_, request in entry.requests.items()},
        }
        for entry in book.entries()
    }
    return {
        "released": book.released,
        "teams": teams,
        "history": {name: history_text(*book.history(name)).splitlines()
                    for name in SEEN["history"]},
        "together": [[one.at, one.by, one.teams] for one in book.changed_together(least=1)],
    }  # fmt: skip


def test_an_older_gradebook_says_the_same(old):
    """Grades, histories, requests, reviews and the release are those of the older version."""
    for _ in range(2):  # the second time, there is nothing left to copy
        with Gradebook(old) as book:
            assert _say(book) == SEEN


def test_an_older_gradebook_goes_on(old):
    """The class is graded again, changed, undone, asked and answered."""
    with Gradebook(old, assignment="lab") as book:
        book.undo("team-1", "state-model", by="Ada", version=book.entry("team-1").version(
            "state-model"))  # fmt: skip
        assert book.entry("team-1").overrides["state-model"].points == 2.0
        ((entry, request),) = book.queue().waiting
        book.answer(entry.submission, request.criterion, 1.0, text="yes", by="Ada",
                    version=seen((entry, request)))  # fmt: skip
        finish(book, make_grade("team-1", share=0.0), key="again")
        given = {id_: own.points for id_, own in book.entry("team-1").overrides.items()}
        assert given == {"pieces": 1.0, "state-model": 2.0, "laws": 1.0}


def test_the_older_tables_stay_beside(old):
    """The older tables are kept under other names until a submission is erased.

    Neither they nor the new rows can be changed.
    """
    Gradebook(old).close()
    engine = _engine(old)
    with engine.connect() as connection:
        for name, rows in OLD.items():
            assert connection.scalar(text(f"SELECT count(*) FROM v1_{name}")) == rows
    for name in ("v1_overrides", "v1_looks", "events", "settings"):
        with pytest.raises(DBAPIError, match="be changed"), engine.begin() as connection:
            connection.execute(text(f"DELETE FROM {name}"))
    engine.dispose()
    _change(old, "CREATE TABLE v1_of_another_program (id INTEGER)")

    with Gradebook(old) as book:
        book.erase(["team-2"])
        assert [entry.submission for entry in book.entries()] == ["team-1", "new-name"]

    engine = _engine(old)
    kept = {name for name in inspect(engine).get_table_names() if name.startswith("v1_")}
    engine.dispose()
    assert kept == {"v1_of_another_program"}


@pytest.mark.parametrize(
    "older",
    [
        ["DROP TABLE request_events", "DROP TABLE releases", "DROP TABLE looks"],
        ["ALTER TABLE overrides DROP COLUMN comment"],
    ],
    ids=["requests", "comments"],
)
def test_the_oldest_gradebooks_lack_some_tables(old, older):
    """A gradebook from before requests or comments keeps its points."""
    _change(old, *older)
    with Gradebook(old) as book:
        own = book.entry("team-1").overrides
        assert {id_: one.points for id_, one in own.items()} == {"pieces": 1.0, "state-model": 1.5}
        book.release(True, by="prof")
        book.ask("team-1", "state-model", why="x", by="s1")
        assert [request.criterion for _, request in book.queue().waiting][-1] == "state-model"


def test_processes_that_open_an_older_gradebook_at_once_copy_it_once(old):
    """Eight processes open it at the same moment; each event is there once."""
    with ThreadPoolExecutor(8) as pool:
        for book in pool.map(lambda _: Gradebook(old), range(8)):
            book.close()
    with Gradebook(old) as book:
        assert _say(book) == SEEN


@pytest.mark.slow
@pytest.mark.sample
@FORKS
def test_a_kill_while_an_older_gradebook_is_copied_loses_nothing(old):
    """The process is killed before each statement in turn; then the gradebook says the same."""
    command = [sys.executable, "-m", "tests.helpers.gradebook_kills", old, "open"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stderr
    (kills,) = map(int, re.findall(r"kills (\d+)", said.stdout))
    assert kills > 30  # the tables, their indexes and locks, the rows, the names
    with Gradebook(old) as book:
        assert _say(book) == SEEN
