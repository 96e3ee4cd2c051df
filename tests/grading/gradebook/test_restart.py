"""A PostgreSQL server that restarts during a grading costs some time, and no grade is doubled."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import Engine
from sqlalchemy.event import listen, remove
from sqlalchemy.exc import OperationalError

from pipeline.grading.batch import grade_class
from pipeline.grading.gradebook.database import Lost
from pipeline.grading.gradebook.gradebook import Gradebook
from tests.helpers import postgres
from tests.helpers.grades import finish, make_grade, make_outcome

AWAY = 1.0  # s without a server


@pytest.fixture(scope="module")
def server() -> Iterator[postgres.Server]:
    """Start a PostgreSQL server that the tests can stop."""
    if why := postgres.missing():
        (pytest.fail if os.environ.get(postgres.NEEDED) else pytest.skip)(why)
    with postgres.running_server() as server:
        yield server


@pytest.fixture
def told() -> list[str]:
    """Return the list of messages while waiting."""
    return []


@pytest.fixture
def book(server, told, request) -> Iterator[Gradebook]:
    """Return a gradebook that waits a minute for its server, each test with its own assignment."""
    name = request.node.name
    with Gradebook(
        server.url, assignment=name, create=True, patience=60.0, waiting=told.append
    ) as opened:
        yield opened


def restart(server: postgres.Server) -> None:
    """Stop the server at once, and start it again a little later, in the background."""
    server.stop()
    threading.Thread(target=lambda: (time.sleep(AWAY), server.start()), daemon=True).start()


def test_a_server_that_is_away_at_the_start_is_waited_for(server, told):
    """A gradebook waits for a server that does not answer yet, and says so."""
    restart(server)
    with Gradebook(
        server.url, assignment="start", create=True, patience=60.0, waiting=told.append
    ) as book:
        store(book, "a")
    assert "trying again" in told[0]


def test_a_class_is_not_graded_without_its_list(server, told, tmp_path, monkeypatch):
    """If the server stays away, grading ends at its first question, before any name is chosen."""
    monkeypatch.setattr(grade_class, "_PATIENCE", 0.1)
    server.stop()
    try:
        with pytest.raises(Lost):
            grade_class.grade_class(
                [tmp_path],
                rubric_file=Path("throne-1dof"),
                out=tmp_path / "out",
                options=grade_class.Options(gradebook=server.url),
                say=told.append,
            )
    finally:
        server.start()
    assert "trying again" in told[0]


def store(book: Gradebook, *names: str) -> None:
    """Store gradings, and the class list of them."""
    outcomes = [make_outcome(make_grade(name, share=0.5)) for name in names]
    for outcome in outcomes:
        book.put(outcome)
    finish(book, *outcomes)


def n_graded(book: Gradebook, name: str) -> int:
    """Return how often a submission was graded."""
    return sum(event.what == "graded" for event in book.history(name)[1])


@contextmanager
def once(what: str, act: Callable[..., None]) -> Iterator[None]:
    """Do something at the first event of this kind at a database."""
    done = []

    def happen(*arguments: object) -> None:
        if not done:
            done.append(what)
            act(*arguments)

    listen(Engine, what, happen)
    try:
        yield
    finally:
        remove(Engine, what, happen)
    assert done == [what]


def test_a_server_that_is_away_is_waited_for(server, book, told):
    """Between two gradings the server restarts: all are stored once, and a message says why."""
    store(book, "a")
    restart(server)
    store(book, "a", "b")
    assert [entry.grade.submission for entry in book.entries()] == ["a", "b"]
    assert told
    assert all("trying again" in line for line in told)


def test_a_server_that_is_lost_in_a_transaction_is_tried_again(server, book):
    """In the middle of a transaction the server is lost: it is done again as a whole."""
    with once("after_cursor_execute", lambda *_: restart(server)):
        store(book, "a", "b")
    assert n_graded(book, "a") == n_graded(book, "b") == 1


def test_a_grading_is_stored_once_if_the_answer_was_lost(server, book):
    """The server stored a grading but its answer was lost: the grading is not stored twice."""

    def lose_the_answer(connection) -> None:
        connection.connection.dbapi_connection.commit()
        raise OperationalError("COMMIT", {}, Exception("server closed the connection"))

    with once("commit", lose_the_answer):
        store(book, "a")
    assert n_graded(book, "a") == 1


def test_a_wrong_address_is_named_while_waiting(server, told):
    """A wrong address looks like a server that restarts: each message names it and the reason."""
    wrong = server.url.replace("pg-", "none-")
    with pytest.raises(Lost, match="none-"):
        Gradebook(wrong, assignment="x", create=True, patience=0.2, waiting=told.append).close()
    assert "none-" in told[0]


def test_a_server_is_not_waited_for_without_patience(server, told):
    """All commands but `grade` report at once that the server does not answer."""
    wrong = server.url.replace("pg-", "none-")
    with pytest.raises(Lost):
        Gradebook(wrong, assignment="x", create=False, waiting=told.append).close()
    assert told == []
