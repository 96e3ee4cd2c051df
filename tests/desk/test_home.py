"""Tests of the first page, of the line of links on each page, and of the list of folders."""

import re
from html import unescape
from pathlib import Path
from urllib.parse import urlencode

import pytest

from pipeline.desk.app import DeskServer
from pipeline.desk.browse import MOST, find_root, list_folders
from pipeline.desk.gradebooks import Gradebooks
from pipeline.desk.navigation import list_links
from pipeline.desk.users import User
from pipeline.errors import ConfigError
from tests.helpers.desks import (
    Visitor,
    a_submission,
    at_desk,
    at_lab,
    listed_user,
)
from tests.helpers.grades import write_class

pytestmark = pytest.mark.usefixtures("all_work_here")


@pytest.fixture
def root(tmp_path, monkeypatch) -> Path:
    """Write a desk's root folder with one folder of each kind, hidden folders and links."""
    root, outside = tmp_path / "course", tmp_path / "outside"
    a_submission(root / "team")
    write_class(root / "grades")
    (root / "empty").mkdir()
    (root / "years" / "2026").mkdir(parents=True)
    (root / ".hidden" / "inner").mkdir(parents=True)
    outside.mkdir()
    (root / "way-out").symlink_to(outside)
    (root / "to-hidden").symlink_to(root / ".hidden" / "inner")
    (root / "same").symlink_to(root / "empty")
    (root / "loop").symlink_to(root / "loop")
    (root / "file.txt").write_text("x", encoding="utf-8")
    monkeypatch.chdir(root)
    return root


def links(page: str) -> list[str]:
    """Return the names in the line of links."""
    line = re.findall(r'<nav aria-label="Rooms">.*?</nav>', page, re.DOTALL)[0]
    return [unescape(name) for name in re.findall(r">([^<>]+)</a>", line)]


def test_a_long_list_is_sorted_before_it_is_cut(root, monkeypatch):
    """A long list is sorted before it is cut, whatever the disk's order, and the page says so.

    A submission comes first, whatever its name, so it is never cut off.
    """
    for number in range(MOST + 5):
        (root / "years" / f"team-{number:03d}").mkdir()
    listed = list_folders(root, "years")
    assert (len(listed.found), listed.left_off) == (MOST, True)
    with at_desk() as visitor:
        assert f" {MOST} folders" in visitor.get("/open?in=years").text
    (root / "years" / "zoe").mkdir()
    (root / "years" / "zoe" / "submission.toml").write_text("", encoding="utf-8")
    assert list_folders(root, "years").found[0].inside == "years/zoe"

    monkeypatch.setattr("pipeline.desk.browse._LOOKED_AT", 5)
    (root / "long").mkdir()
    for n in (7, 2, 9, 4, 1, 8, 3, 6, 5):
        (root / "long" / f"{n}").mkdir()
    listed = list_folders(root, "long")
    assert [one.path.name for one in listed.found] == ["1", "2", "3", "4", "5"]
    assert listed.left_off


@pytest.mark.parametrize("instead", ["nothing", "a file", "a link to itself"])
def test_a_lost_folder_is_named_on_its_page_and_breaks_no_other(tmp_path, instead):
    """If an opened folder is gone, its page says so, and no other page fails."""
    team, graded = a_submission(tmp_path / "team"), write_class(tmp_path / "graded")
    with at_desk(team, opened=graded) as visitor:
        for folder in (team, graded):
            folder.rename(tmp_path / f"{folder.name}-away")
            if instead == "a file":
                folder.write_text("x", encoding="utf-8")
            elif instead == "a link to itself":
                folder.symlink_to(folder)
        for room, folder in (("student/0/", team), ("student/0/report", team),
                             ("bench/0/", team), ("solution/0/", team),
                             ("grades/0/", graded)):  # fmt: skip
            page = visitor.get(f"/{room}")
            assert page.status == 422, room
            assert str(folder) in page.text
        assert visitor.get("/").status == 200
        for folder in (team, graded):
            folder.unlink(missing_ok=True)
            (tmp_path / f"{folder.name}-away").rename(folder)
        assert [visitor.get(f"/{room}").status for room in ("student/0/", "grades/0/")] == [200] * 2


def test_folders_that_can_be_opened_come_first(root):
    """Folders that can be opened are listed first, each once, with their kind.

    Hidden folders are left out, and so are links that lead outside the root.
    """
    found = {one.inside: one.kind for one in list_folders(root, "").found}
    assert found == {"grades": "grading", "team": "submission", "empty": "empty", "years": "folder"}
    assert list(found)[:2] == ["grades", "team"]
    below = list_folders(root, "years/2026")
    assert below.above == ((root.name, ""), ("years", "years"))
    assert (below.here.kind, below.found) == ("empty", ())


@pytest.mark.parametrize(
    "inside",
    ["..", "../outside", "/", "way-out", ".hidden", ".hidden/inner", "to-hidden", "file.txt",
     "nowhere", "years/../..", "a\x00b", "loop"],
)  # fmt: skip
def test_no_folder_outside_of_the_root_is_listed(root, inside):
    """No folder outside the root, no hidden folder and no file can be listed.

    The desk answers such a request with one sentence.
    """
    with pytest.raises(ConfigError):
        list_folders(root, inside)
    with DeskServer() as server:
        answer = Visitor.of(server.url).get(f"/open?{urlencode({'in': inside})}")
    assert answer.status == 422


def test_the_home_folder_replaces_the_whole_disk(monkeypatch):
    """If the desk starts at the root of the disk, it lists the home folder instead."""
    monkeypatch.chdir(Path(Path.cwd().anchor))
    assert find_root() == Path.home()


def test_a_task_is_chosen_then_a_folder(root):
    """The user chooses a task on the first page, then a folder, and gets the page for the task."""
    with at_desk() as visitor:
        page = visitor.get("/open?to=bench").text
        assert re.search(r"Record here<span[^>]*> team<", page)
        for to, folder, address in (
            ("bench", "team", "/bench/0/"), ("solution", "team", "/solution/0/"),
            ("", "empty", "/student/1/"), ("bench", "grades", "/grades/0/"),
            ("open", "team", "/student/0/"),
        ):  # fmt: skip
            answer = visitor.post("/open", folder=str(root / folder), to=to)
            assert (answer.status, answer.headers["location"]) == (303, address)
        home = unescape(visitor.get("/").text)
    assert re.search(r">team</a>\s*<span>\d+ files</span> <span[^>]*>no report<", home)
    assert re.search(r">grades</a> <span[^>]*>0 of \d+ ", home)


def test_the_line_of_links_stays_short(root):
    """The line of links has only the current folder and the folders opened last.

    The link to a folder's bench is there only while the folder is shown.
    """
    with at_desk() as visitor:
        for number in range(9):
            visitor.post("/open", folder=str(root / "years" / f"t{number}"))
        assert links(visitor.get("/").text) == ["Desk", "t6", "t7", "t8"]
        assert links(visitor.get("/student/2/").text) == ["Desk", "t2", "Bench", "t6", "t7", "t8"]
        assert links(visitor.get("/solution/8/").text)[-3:] == ["t8", "Bench", "Solution"]
        assert links(visitor.get("/effects/").text)[-1] == "Effects"
        assert unescape(visitor.get("/").text).count(">t0</a>") == 3  # the page lists them all


def test_students_see_nothing_for_instructors(root):
    """Students and TAs see none of the tasks, links and lists of folders for instructors."""
    users = listed_user("s", "student", folders='["team", "empty"]')
    users += listed_user("t", "ta", gradebooks='["grades", "grades"]')
    with at_lab(root, users) as named:
        student, ta = named("s"), named("t")
        pages = [student.get("/").text, student.get("/student/0/").text, ta.get("/").text]
        for page in pages:
            for address in ("/exercises/", "/rubric/", "/effects/", "/bench/", "/solution/"):
                assert f'href="{address}' not in page
            assert "/open" not in page
        assert links(pages[0]) == ["Desk", "team", "empty"]
        for who in (student, ta):
            assert who.get("/open").status == who.get("/open?in=team").status == 403


def test_a_gradebook_that_cannot_be_reached_breaks_no_page(tmp_path, monkeypatch):
    """If a gradebook's network drive is gone, its link stays, without the number of requests."""
    books = Gradebooks()

    def gone(place):
        raise OSError("stale file handle")

    monkeypatch.setattr(books, "gradebook", gone)
    user = User(name="", role="owner", gradebooks=[tmp_path / "class"])
    assert [room.name for room in list_links(user, "/", books)] == ["Desk", "class"]
