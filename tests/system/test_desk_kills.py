"""If the desk's server is killed at random, confirmed changes stay complete.

A change is confirmed by the answer to its form. A new grading is confirmed when the page says that
it is done.
"""

import http.client
import random
import re
import shutil
import sqlite3
import subprocess
import sys
import threading
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.resources import RUBRICS
from pipeline.submission import load_submission
from pipeline.submission.edit import edit_submission
from tests.helpers.desks import Visitor, a_submission, some_files
from tests.helpers.grades import make_grade, make_outcome, two_cart_rubric, write_class
from tests.helpers.waiting import PATIENCE, address, started, until

_RECORD = some_files(most=1)[0][1]


@dataclass(kw_only=True)
class _Save:
    """Save new titles of a submission, one after another."""

    folder: Path
    page: str = "/student/0/"
    longest: float = 1.5  # longest time before the kill, in s
    sent: int = 0
    confirmed: list[int] = field(default_factory=list)

    def prepare(self) -> None:
        a_submission(self.folder)
        edit_submission(self.folder, lambda document: document.update(title="title 0"))

    def act(self, who: Visitor) -> None:
        seen = who.get("/student/0/").value("seen")
        answer = who.post("/student/0/save", seen=seen, title=f"title {self.sent}")
        assert answer.status == 303

    def check(self) -> None:
        submission = load_submission(self.folder)
        title = int(submission.title.removeprefix("title "))
        assert (self.confirmed or [0])[-1] <= title <= self.sent
        assert submission.experiments


@dataclass(kw_only=True)
class _Upload(_Save):
    """Upload recordings of different lengths.

    The desk answers an upload only after it has also written the recording's table in the file.
    """

    longest: float = 4.0

    def content(self, number: int) -> bytes:
        return b"\n".join(_RECORD.splitlines()[: -number - 1])

    def act(self, who: Visitor) -> None:
        files = [(f"drop-{self.sent}.csv", self.content(self.sent))]
        assert who.upload("/student/0/files", files).status == 303

    def check(self) -> None:
        stored = {
            int(path.stem.removeprefix("drop-")): path.read_bytes()
            for path in (self.folder / "data").glob("drop-*")
        }
        assert all(raw == self.content(number) for number, raw in stored.items())
        named = {experiment.file for experiment in load_submission(self.folder).experiments}
        assert {f"data/drop-{number}.csv" for number in self.confirmed} <= named
        assert set(self.confirmed) <= set(stored)


@dataclass(kw_only=True)
class _Override(_Save):
    """Give points by hand, with the running number of the change as the reason."""

    page: str = "/grades/0/"
    longest: float = 0.8

    def prepare(self) -> None:
        write_class(self.folder)

    def act(self, who: Visitor) -> None:
        team = "/grades/0/team?of=team-04&criterion=laws"
        seen = re.search(r'value="laws"><input type="hidden" name="seen" value="(.*?)"',
                         who.get(team).text)  # fmt: skip
        assert seen
        sent = {"points": str(self.sent % 3 / 2), "why": f"change {self.sent}", "by": "Ada"}
        answer = who.post(team, do="change", criterion="laws", seen=seen[1], **sent)
        assert answer.status == 303

    def check(self) -> None:
        with Gradebook(self.folder) as book:
            given = {
                int(one.text.removeprefix("change ")): one.points
                for _, one in book.changes_since(0)
                if one.text.startswith("change")
            }
            assert list(given) == sorted(given)
            assert all(points == number % 3 / 2 for number, points in given.items())
            assert set(self.confirmed) <= set(given) <= set(range(1, self.sent + 1))
            assert len(book.class_now().entries) == 16
        _whole(self.folder)


@dataclass(kw_only=True)
class _Regrade(_Save):
    """Grade a changed submission again, in a class where another submission has manual points."""

    page: str = "/grades/0/"
    longest: float = 20.0
    team: Path = field(init=False)
    rubric: Path = field(init=False)

    def prepare(self) -> None:
        self.folder.mkdir()
        outcome = make_outcome(make_grade("team-04"), fingerprints=b"")
        with Gradebook(self.folder, assignment="lab", create=True) as book:
            book.put(outcome)
            book.finish(Batch(keys=(outcome.key,), shared={}), rubric=two_cart_rubric())
            book.override("team-04", "laws", 0.5, why="as told", by="Ada")
        self.team = a_submission(self.folder.with_name("team-x"), "two-cart")
        self.rubric = self.folder.with_name("lab.toml")  # names the class
        shutil.copy(RUBRICS / "throne-2dof.toml", self.rubric)

    def act(self, who: Visitor) -> None:
        new = f"title {self.sent}"
        edit_submission(self.team, lambda document: document.update(title=new))
        sent = {"paths": str(self.team), "rubric": str(self.rubric), "lateness": ""}
        assert who.post("/grades/0/grade", **sent).status == 303
        until(lambda: "data-events" not in who.get("/grades/0/").text)
        page = who.get("/grades/0/").text
        assert "Grading: 1 of 1 graded" in page, re.findall('class="wrong".*', page)

    def check(self) -> None:
        _whole(self.folder)
        with Gradebook(self.folder) as book:
            teams = {entry.submission: entry for entry in book.entries()}
            assert teams["team-04"].overrides["laws"].text == "as told"
            assert set(teams) <= {"team-04", "team-x"}
            assert not self.confirmed or "team-x" in teams


def _whole(folder: Path) -> None:
    with closing(sqlite3.connect(folder / FILE)) as book:
        assert book.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        assert book.execute("PRAGMA foreign_key_check").fetchall() == []


def kill_again_and_again(work: _Save, *, kills: int, seed: int) -> int:
    """Kill the server many times, and check its data after each kill.

    Return how many changes were confirmed.
    """
    draw = random.Random(seed)
    work.prepare()
    command = [sys.executable, "-m", "pipeline", "desk", work.folder, "--no-browser"]
    for _ in range(kills):
        with started(command, stderr=subprocess.PIPE, encoding="utf-8") as desk:
            _act_until_killed(work, desk, after=draw.uniform(0.0, work.longest))
        work.check()
    return len(work.confirmed)


def _act_until_killed(work: _Save, desk: subprocess.Popen, *, after: float) -> None:
    """Make one change after another until the desk is killed.

    The processes that the desk started must end too.
    """
    who, started_by_it = Visitor.of(address(desk)), []
    assert who.get(work.page).status == 200  # the processes that the page needs are running

    def end() -> None:
        started_by_it.extend(psutil.Process(desk.pid).children(recursive=True))
        desk.kill()

    timer = threading.Timer(after, end)
    timer.start()
    with suppress(OSError, http.client.HTTPException):
        try:
            while True:
                work.sent += 1
                work.act(who)
                work.confirmed.append(work.sent)
        except AssertionError:
            timer.cancel()
            raise
    timer.join()
    desk.wait()
    assert psutil.wait_procs(started_by_it, timeout=PATIENCE)[1] == []


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("work", [_Override, _Upload, _Regrade])
def test_a_kill_loses_nothing(work, tmp_path):
    """A confirmed override, upload or regrade is not lost if the server is killed."""
    kill_again_and_again(work(folder=tmp_path / "it"), kills=1, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("work", "kills"), [(_Override, 18), (_Upload, 16), (_Regrade, 16), (_Save, 5)]
)
def test_fifty_kills_lose_nothing(work, kills, tmp_path):
    """After 50 kills of the server during changes, and 5 during saves, nothing is lost."""
    assert kill_again_and_again(work(folder=tmp_path / "it"), kills=kills, seed=2) > 0
