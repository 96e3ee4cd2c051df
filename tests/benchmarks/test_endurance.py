"""The endurance test notices lost, doubled and damaged changes, and rising memory."""

import subprocess
import sys

import pytest
from numpy.testing import assert_allclose

from benchmarks.endurance import SETTLING, Memory
from benchmarks.endurance_checks import Found, check_book, check_folders
from benchmarks.endurance_people import Change, Journal, digest
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.submission import load_submission
from tests.helpers import postgres
from tests.helpers.desks import a_submission
from tests.helpers.grades import fill_book, seen
from tests.helpers.places import ROOT


def _points(token: str, points: float, *, confirmed: bool = True) -> Change:
    return Change(kind="points", by="Ada", where=("team-02", "laws"), token=token, points=points,
                  confirmed=confirmed)  # fmt: skip


@pytest.fixture(scope="module")
def book(tmp_path_factory):
    """Return a class with manual points, some of them changed twice, and one answered request."""
    place = str(tmp_path_factory.mktemp("book"))
    fill_book(place)
    with Gradebook(place) as book:
        for why, points in (("once", 0.5), ("twice", 0.5), ("x", 0.0), ("twice", 0.5)):
            book.override("team-02", "laws", points, why=why, by="Ada")
        book.release(True, by="prof")
        book.ask("team-04", "laws", why="see page 3", by="s4")
        (asked,) = book.queue().waiting
        book.answer("team-04", "laws", 0.5, text="right", by="Ada", version=seen(asked))
    return place


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (_points("once", 0.5), None),
        (_points("once", 0.5, confirmed=False), None),
        (_points("never", 0.5, confirmed=False), None),
        (_points("never", 0.5), "lost"),
        (_points("twice", 0.5), "doubled"),
        (_points("once", 1.0), "spoilt"),
        (Change(kind="request", by="s4", where=("team-04", "laws"), token="see page 3"), None),
        (Change(kind="answer", by="Ada", where=("team-04", "laws"), token="right",
                confirmed=True), None),
        (Change(kind="answer", by="Ada", where=("team-04", "laws"), token="another",
                confirmed=True), "lost"),
        (Change(kind="reopened", by="Ada", where=("team-04", "laws"), token="",
                confirmed=True), "lost"),
        (Change(kind="together", by="Ada", where=("", "laws"), token="once",
                teams=("team-02", "team-03"), points=0.5), "spoilt"),
    ],
)  # fmt: skip
def test_a_change_of_points_is_stored_exactly_once(book, change, wrong):
    """A confirmed change must be stored exactly once; any other change at most once."""
    found = Found()
    with Gradebook(book) as opened:
        teams = [one.submission for one in opened.class_now().entries]

    check_book(book, Journal(sent=[change]), teams=teams, found=found)

    named = {key: [t for t in getattr(found, key) if "nobody sent" not in t]
             for key in ("lost", "doubled", "spoilt")}  # fmt: skip
    assert [key for key, sentences in named.items() if sentences] == ([wrong] if wrong else [])


def test_a_team_that_left_the_class_is_lost(book):
    """A graded team that is missing from the class list is reported, and so are unknown points."""
    found = Found()

    check_book(book, Journal(), teams=["team-01"], found=found)

    assert "of 1 teams" in found.lost[0]
    assert any("nobody sent" in sentence for sentence in found.spoilt)


def test_recordings_and_rows_are_compared_with_what_was_sent(tmp_path):
    """A missing or changed recording, and a row with an old note, are reported."""
    folder = a_submission(tmp_path / "s0")
    first, *_ = load_submission(folder).experiments
    name = first.file.removeprefix("data/")
    right = digest((folder / first.file).read_bytes())

    def found(*changes: tuple[str, str, str]) -> Found:
        made = [Change(kind=kind, by="s0", where=("0", where), token=token, confirmed=True)
                for kind, where, token in changes]  # fmt: skip
        all_ = Found()
        check_folders({("s0", "0"): folder}, Journal(sent=made), found=all_)
        return all_

    assert found(("upload", name, right)) == Found()
    assert found(("upload", name, digest(b"other"))).spoilt
    assert found(("upload", "missing.csv", right)).lost
    assert found(("row", first.id, first.note)) == Found()
    assert found(("row", first.id, first.note), ("row", first.id, "newer")).lost


def test_the_slope_of_memory_is_found():
    """If memory grows steadily by 10 MB an hour, that slope is found, with no error."""
    memory = Memory()
    for second in range(0, 1800, 2):
        start = 500.0 if second < SETTLING else 0.0
        memory.at.append(float(second))
        memory.mb.append(300.0 + 10.0 * second / 3600 + start)

    seen = memory.slope(SETTLING)

    assert_allclose(seen["slope"], 10.0, rtol=1e-6)
    assert_allclose(seen["std"], 0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("part", ["class", "exploration"])
def test_a_minute_loses_nothing(part):
    """In a minute of the class with kills, and in a minute of an exploration, nothing is lost."""
    if part == "class" and (why := postgres.missing()):
        pytest.skip(why)
    command = [sys.executable, "-m", "benchmarks.endurance", part, "--quick"]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    assert ran.returncode == 0, ran.stderr
