"""An erased submission leaves no trace, and a backup restores a gradebook."""

import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import Engine, create_engine, text
from sqlalchemy.exc import DBAPIError

from pipeline.desk.gradebooks import Gradebooks
from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish.export import export
from pipeline.grading.publish.outputs import write_outputs
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import (
    book_of,
    finish,
    make_grade,
    make_outcome,
    shared_flag,
    two_cart_rubric,
)

GONE, KEPT = "zebra-çelik", "team-2"
TRACES = ("zebra", "s-zebra", "31.41592", "quagga")  # name, author, reported number, typed text


def _fill(place: str, *, folder: Path | None = None) -> None:
    """Grade two teams that share a recording, and use every table of the gradebook.

    One team asks a question, gets points by hand and is marked as reviewed.
    """
    gone = make_grade(GONE, share=0.5)
    first = gone.criteria[0].model_copy(update={"found": {"omega_1": 31.41592}})
    gone = gone.model_copy(update={"criteria": (first, *gone.criteria[1:])})
    figure = ("fit.svg", "<svg><text>31.41592 quagga</text></svg>")
    class_ = (
        make_outcome(gone, figures=(figure,), findings="31.41592"),
        make_outcome(make_grade(KEPT)),
    )
    shared = {KEPT: shared_flag(GONE), GONE: shared_flag(KEPT)}
    with book_of(place, *class_, shared=shared) as book:
        book.set_reviewed(GONE, by="Ada", reviewed=True)
        book.release(by="Ada", released=True)
        book.ask(GONE, first.id, why="quagga: it is right", by="s-zebra")
        book.override(GONE, gone.criteria[1].id, 0.5, why="quagga", by="Ada")
        finish(book, *class_, shared=shared)
        if folder:
            write_outputs(book, folder)
            for platform in PLATFORMS.values():
                export(book, platform, folder)


def _found(content: bytes) -> list[str]:
    return [trace for trace in TRACES if trace.encode() in content]


def test_no_file_of_a_folder_keeps_a_trace(tmp_path):
    """After a student is erased, no file of the folder contains the student's data.

    The search includes the database's free pages.
    """
    folder = tmp_path / "grades"
    folder.mkdir()
    _fill(str(folder), folder=folder)
    before = {
        path.name for path in folder.rglob("*") if path.is_file() and _found(path.read_bytes())
    }
    assert {"canvas.csv", "class.html", "grades.csv", "grade.json", "results.json", FILE} <= before

    done = cartlab_here("remove", folder, GONE, "--erase")

    assert done.returncode == 0
    assert "export again" in done.stderr
    left = {path: _found(path.read_bytes()) for path in folder.rglob("*") if path.is_file()}
    assert {path: found for path, found in left.items() if found} == {}
    assert not [path for path in folder.rglob("*") if "zebra" in path.name]
    with Gradebook(folder) as book:
        assert [one.submission for one in book.entries()] == [KEPT]
        flag = book.entry(KEPT).grade.flags[0]
        assert "erased submission" in flag.message
    with closing(sqlite3.connect(folder / FILE)) as connection:
        with pytest.raises(sqlite3.IntegrityError, match="be changed"):
            connection.execute("DELETE FROM gradings")
        assert connection.execute("PRAGMA freelist_count").fetchone() == (0,)


@pytest.mark.slow
@pytest.mark.sample
def test_no_row_in_postgresql_keeps_a_trace(server, place_in_postgresql):
    """After an erasure, neither a dump of the database nor its table files contain the student."""
    url = place_in_postgresql
    _fill(url)
    assert set(_found(_dump(url))) == {"zebra", "s-zebra", "31.41592", "quagga"}

    assert cartlab_here("remove", url, GONE, "--erase").returncode == 0

    assert _found(_dump(url)) == []
    engine = _engine(url)
    with engine.connect() as connection:
        connection.execution_options(isolation_level="AUTOCOMMIT").execute(text("CHECKPOINT"))
        with pytest.raises(DBAPIError, match="be changed"):
            connection.execute(text("DELETE FROM gradings"))
    engine.dispose()
    tables = Path(url.partition("host=")[2], "data", "base").rglob("*")
    assert [path for path in tables if path.is_file() and _found(path.read_bytes())] == []


def test_a_number_of_an_erased_grading_is_not_used_again(tmp_path):
    """A desk that is open during an erasure shows and accepts no other grade for the new team."""
    desk = Gradebooks()
    with Gradebook(tmp_path, create=True) as book:
        finish(book, make_grade("alice"), make_grade("zoe"))
    seen = desk.of(tmp_path).teams["zoe"].whole_version
    with Gradebook(tmp_path) as book:
        book.erase(["zoe"])
    assert list(desk.of(tmp_path).teams) == ["alice"]
    with Gradebook(tmp_path) as book:
        again = make_grade("zoe", share=0.2, authors=("mallory",))
        finish(book, make_grade("alice"), make_outcome(again, key="other"))
        shown = desk.of(tmp_path).teams["zoe"]
        assert (shown.grade.points, shown.grade.authors) == (again.points, ("mallory",))
        assert shown.whole_version != seen
        assert book.accept_all({"zoe": seen}, by="Ada").teams == 0


def test_a_backup_of_a_file_is_the_same_gradebook(tmp_path):
    """A backup that SQLite makes of an open gradebook has the same entries and history."""
    _fill(str(tmp_path))
    copy = tmp_path / "copy.sqlite"
    with Gradebook(tmp_path) as book:
        with closing(sqlite3.connect(tmp_path / FILE)) as own, closing(sqlite3.connect(copy)) as to:
            own.backup(to)  # does the same as `sqlite3 gradebook.sqlite ".backup copy.sqlite"`
        with Gradebook(copy) as restored:
            assert list(restored.entries()) == list(book.entries())
            assert restored.history(GONE) == book.history(GONE)
            restored.override(KEPT, two_cart_rubric().criteria[0].id, 1, why="new", by="Ada")


def test_a_dump_of_a_database_is_the_same_gradebook(server, place_in_postgresql):
    """A dump restored by `psql` has the same rows, and still refuses to change or delete them."""
    url = place_in_postgresql
    _fill(url)
    with Gradebook(url) as book:
        entries, history = list(book.entries()), book.history(GONE)
    dumped = _dump(url)
    engine = _engine(url)
    with engine.begin() as connection:
        connection.execute(text("DROP SCHEMA public CASCADE"))

    psql = ["psql", "--quiet", "--set=ON_ERROR_STOP=1", url]
    subprocess.run(psql, input=dumped, check=True, stdout=subprocess.DEVNULL)

    with Gradebook(url) as book:
        assert (list(book.entries()), book.history(GONE)) == (entries, history)
        book.override(KEPT, two_cart_rubric().criteria[0].id, 1, why="new", by="Ada")
    with engine.connect() as connection, pytest.raises(DBAPIError, match="be changed"):
        connection.execute(text("DELETE FROM events"))
    engine.dispose()


def _engine(url: str) -> Engine:
    return create_engine(url.replace("postgresql:", "postgresql+psycopg:"))


def _dump(url: str) -> bytes:
    return subprocess.run(
        ["pg_dump", "--schema=public", url], check=True, stdout=subprocess.PIPE
    ).stdout
