"""Fixtures that give a place for a gradebook: a SQLite file or a PostgreSQL server."""

import os

import pytest
from sqlalchemy import create_engine, text

from tests.helpers import postgres


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
    url = server
    yield url
    engine = create_engine(url.replace("postgresql:", "postgresql+psycopg:"))
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE"))
        connection.execute(text("CREATE SCHEMA public"))
    engine.dispose()
