"""Fixtures that give a place for a gradebook: a SQLite file or a PostgreSQL server."""

import os

import pytest
from sqlalchemy import create_engine, text

from tests.helpers import postgres
from tests.helpers.grades import book_of, make_grade


@pytest.fixture(scope="session")
def server():
    """Start a PostgreSQL server for the tests."""
    if why := postgres.missing():
        (pytest.fail if os.environ.get(postgres.NEEDED) else pytest.skip)(why)
    with postgres.running() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request, tmp_path):
    """Return an empty place where a gradebook can be made."""
    if request.param == "sqlite":
        yield str(tmp_path)
        return
    yield request.getfixturevalue("place_in_postgresql")


@pytest.fixture
def place_in_postgresql(server):
    """Yield the address of an empty database, and empty the database after the test."""
    yield server
    engine = create_engine(server.replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE"))
        connection.execute(text("CREATE SCHEMA public"))
    engine.dispose()


@pytest.fixture
def book(place):
    """Return a class of two teams that lost half of all points; the grades are released."""
    with book_of(place, *(make_grade(name, share=0.5) for name in ("team-1", "team-2"))) as opened:
        opened.release(True, by="prof")
        yield opened
