"""`cartlab desk` gives an error in one line, and recognises the kind of folder it opens."""

from urllib.parse import urlsplit

import pytest

from pipeline.desk.app import DeskServer
from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import Visitor, a_submission, through_proxy, write_users

USERS = '[proxy]\naddress = "127.0.0.1"\nheader = "X-Name"\nsite = "http://lab"\n'
USERS += f'secret_header = "X-Secret"\nsecret = "{"s" * 24}"\n'


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--host", "127.0.0.1"], "need each other"),
        (["--users", "users.toml"], "need each other"),
        (["team", "--host", "127.0.0.1", "--users", "users.toml"], "the file lists"),
        (["--host", "127.0.0.1", "--users", "nowhere.toml"], "nowhere.toml"),
        (["--host", "127.0.0.1", "--users", "users.toml"], "users: is required"),
        (["users.toml"], "is a file"),
        (["nowhere/team"], "does not exist"),
    ],
)
def test_a_desk_that_cannot_start_is_one_line(options, why, tmp_path):
    """If the command cannot start, it ends with status 2, and nothing is served or written."""
    (tmp_path / "users.toml").write_text(USERS, encoding="utf-8")
    (tmp_path / "users.toml").chmod(0o600)
    done = cartlab_here("desk", "--no-browser", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert why in done.stderr.lower()
    assert [path.name for path in tmp_path.iterdir()] == ["users.toml"]


def test_the_kind_of_folder_is_recognised(tmp_path):
    """A folder or file with a gradebook opens as a class, any other folder as a submission."""
    grades = tmp_path / "grades"
    grades.mkdir()
    (grades / "gradebook.sqlite").write_bytes(b"")
    with DeskServer(folder=grades) as server:
        visitor = Visitor.of(server.url)
        team = a_submission(tmp_path / "team")
        for folder, room in (
            (grades / "gradebook.sqlite", "grades"), (team, "student"), (team, "student"),
        ):  # fmt: skip
            opened = visitor.post("/open", folder=str(folder))
            assert (opened.status, opened.headers["location"]) == (303, f"/{room}/0/")
        assert visitor.post("/open", folder=str(tmp_path / "a" / "b")).status == 422
        home = visitor.get("/").text
        assert "/grades/0/" in home
        assert "/student/0/" in home


ADDRESSES = (
    "postgresql://[::1", "postgresql://[::1]:port/db", "postgresql://h:99999999/db", "mysql://[",
    "postgresql://127.0.0.1:1/%00", "postgresql://127.0.0.1:1/x?options=%00", "http://x", "://",
    "sqlite:///%00", "sqlite:///a\0b", "sqlite://[::1]", "sqlite://@@", "sqlite://h:port/db",
    "sqlite:///nowhere.sqlite", "sqlite:///x?timeout=soon", "sqlite://", "sqlite:///:memory:",
    "sqlite+:///x", "é://[::1", "/dev/null/x", "/proc/x", "\0", "~nobody-here/x", "x" * 5000,
)  # fmt: skip


def test_a_wrong_database_address_is_explained(tmp_path, monkeypatch):
    """If a database address is wrong, the error shows the right form, and no file is made."""
    monkeypatch.chdir(tmp_path)
    with DeskServer() as server:
        visitor = Visitor.of(server.url)
        for typed in ADDRESSES:
            assert visitor.post("/open", folder=typed).status == 422, typed
            assert visitor.get("/").status == 200, typed
        page = visitor.post("/open", folder="postgresql://[::1").text
        assert "write postgresql://NAME@HOST/DATABASE" in page
    assert list(tmp_path.iterdir()) == []


def test_one_bad_address_does_not_hide_the_other_gradebooks(tmp_path):
    """If one of a TA's gradebooks has a bad address, the others are still shown.

    The page of the bad gradebook says what is wrong.
    """
    (tmp_path / "grades").mkdir()
    books = '["postgresql://[::1", "grades"]'
    users = f'[[users]]\nname = "ta"\nrole = "ta"\ngradebooks = {books}\n'
    file = write_users(tmp_path, users)
    with DeskServer(host="127.0.0.1", users=file) as server:
        visitor = through_proxy(urlsplit(server.url).port or 0, "ta")
        assert "/grades/1/" in visitor.get("/").text
        assert visitor.get("/grades/0/").status == 422
