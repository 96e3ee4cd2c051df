"""`cartlab desk` gives an error in one line, and recognises the kind of folder it opens."""

import pytest

from tests.helpers.commandline import cartlab_here
from tests.helpers.desks import (
    a_submission,
    at_desk,
    at_lab,
    listed_user,
)

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
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert why in done.stderr.lower()
    assert [path.name for path in tmp_path.iterdir()] == ["users.toml"]


def test_the_kind_of_folder_is_recognised(tmp_path):
    """A folder or file with a gradebook opens as a class, any other folder as a submission."""
    grades, team = tmp_path / "grades", a_submission(tmp_path / "team")
    grades.mkdir()
    (grades / "gradebook.sqlite").write_bytes(b"")
    with at_desk(grades) as visitor:
        for folder, room in ((grades / "gradebook.sqlite", "grades"), (team, "student"),
                             (team, "student")):  # fmt: skip
            opened = visitor.post("/open", folder=str(folder))
            assert (opened.status, opened.headers["location"]) == (303, f"/{room}/0/")
        assert visitor.post("/open", folder=str(tmp_path / "a" / "b")).status == 422
        for room in ("grades", "student"):
            assert f"/{room}/0/" in visitor.get("/").text


ADDRESSES = (
    "postgresql://[::1", "postgresql://[::1]:port/db", "postgresql://h:99999999/db", "mysql://[",
    "postgresql://127.0.0.1:1/%00", "postgresql://127.0.0.1:1/x?options=%00", "http://x", "://",
    "sqlite:///%00", "sqlite:///a\0b", "sqlite://[::1]", "sqlite://@@", "sqlite://h:port/db",
    "sqlite:///nowhere.sqlite", "sqlite:///x?timeout=soon", "sqlite://", "sqlite:///:memory:",
    "sqlite+:///x", "é://[::1", "/dev/null/x", "/proc/x", "\0", "~nobody-here/x", "x" * 5000,
)  # fmt: skip


def test_a_wrong_database_address_is_explained(tmp_path, monkeypatch):
    """If a database address is wrong, the error shows the right form, and no file is made.

    If one of a TA's gradebooks has a bad address, the others are still shown.
    """
    monkeypatch.chdir(tmp_path)
    with at_desk() as visitor:
        for typed in ADDRESSES:
            assert visitor.post("/open", folder=typed).status == 422, typed
            assert visitor.get("/").status == 200, typed
        assert "postgresql://NAME@HOST/" in visitor.post("/open", folder=ADDRESSES[0]).text
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "grades").mkdir()
    books = f'["{ADDRESSES[0]}", "grades"]'
    with at_lab(tmp_path, listed_user("ta", "ta", gradebooks=books)) as named:
        assert "/grades/1/" in named("ta").get("/").text
        assert named("ta").get("/grades/0/").status == 422
