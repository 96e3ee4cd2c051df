"""Scripted TAs and students of a lab server, and a journal of everything that they sent.

Each person is a browser without scripts, in its own thread, and chooses its next action at random.
If the desk is killed, all wait until it is back and open their page again.
"""

import hashlib
import http.client
import random
import re
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import unescape
from typing import Any
from urllib.parse import urlencode

from tests.helpers.desks import Answer, Visitor, through_proxy

RESTS_OF_TA = (1.0, 4.0)  # s between two actions
RESTS_OF_STUDENT = (10.0, 30.0)
FULL = 40  # when a folder has this many recordings, the student continues in the next one
_MOST_TOGETHER = 8  # teams that get the same points in one change

Files = Sequence[tuple[str, bytes]]


@dataclass(kw_only=True)
class Change:
    """One form that was sent.

    Attributes
    ----------
    kind : one of points, together, request, answer, reopened, upload and row.
    where : team and criterion, or the number of the folder and the file or experiment.
    token : a text that nobody else sends, or the digest of a file.
    teams : teams that get the same points.
    confirmed : whether the desk answered that the change is stored.
    """

    kind: str
    by: str
    where: tuple[str, ...]
    token: str
    points: float | None = None
    teams: tuple[str, ...] = ()
    confirmed: bool = False


@dataclass(kw_only=True)
class Journal:
    """Everything that was sent, the time of each answer, and all refused forms.

    Attributes
    ----------
    times : page and seconds of each answer.
    refused : status, page and message of each form that was refused.
    """

    sent: list[Change] = field(default_factory=list)
    times: list[tuple[str, float]] = field(default_factory=list)
    refused: list[tuple[int, str, str]] = field(default_factory=list)

    def confirmed(self, kind: str) -> int:
        """Return how many changes of a kind the desk confirmed."""
        return sum(one.confirmed for one in self.sent if one.kind == kind)


class Gone(Exception):
    """The desk was killed before it answered."""


@dataclass(kw_only=True)
class Lab:
    """State shared by all people: the desk's port, whether it runs, and whether the lab is over.

    Attributes
    ----------
    pace : factor by which the pauses between two actions are shortened.
    """

    port: int
    teams: Sequence[str]
    pace: float = 1.0
    journal: Journal = field(default_factory=Journal)
    up: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)


class Person(threading.Thread):
    """A person who does one action after another; `fault` is an error of the script."""

    rests = RESTS_OF_TA

    def __init__(self, name: str, lab: Lab, *, seed: int) -> None:
        super().__init__(name=name, daemon=True)
        self.lab, self.draw = lab, random.Random(f"{seed} {name}")
        self.fault: BaseException | None = None
        self._visitor: Visitor = through_proxy(lab.port, name)
        self._tokens = 0

    def run(self) -> None:
        """Act until the lab is over."""
        try:
            self._rest(0.0)
            while not self.lab.over.is_set():
                self._try(self.draw.choices(*zip(*self.habits().items(), strict=True))[0])
                self._rest(self.rests[0])
            self._try(self.finish)
        except BaseException as fault:
            self.fault = fault
            raise

    def habits(self) -> Mapping[Callable[[], None], float]:
        """Return the actions of this person with their relative frequencies."""
        raise NotImplementedError

    def finish(self) -> None:
        """Do what remains when the lab is over."""

    def _rest(self, least: float) -> None:
        self.lab.over.wait(self.draw.uniform(least, self.rests[1]) / self.lab.pace)

    def _try(self, action: Callable[[], None]) -> None:
        if not self.lab.up.wait(0.2):
            return
        try:
            action()
        except Gone:
            self.lab.over.wait(0.2)

    def token(self, what: str) -> str:
        """Return a text that nobody else sends."""
        self._tokens += 1
        return f"{what} {self._tokens} of {self.name}"

    def get(self, page: str, path: str) -> str:
        """Return a page."""
        answer = self._timed(page, lambda: self._visitor.get(path))
        if answer.status != 200:
            self.lab.journal.refused.append((answer.status, page, wrong_in(answer)))
            raise Gone
        return answer.text

    def post(self, page: str, path: str, change: Change, fields: Mapping[str, Any]) -> None:
        """Send a form; the desk's answer confirms the change."""
        body = urlencode(fields, doseq=True).encode()
        kind = "application/x-www-form-urlencoded"
        self._send(page, change, lambda: self._visitor.send(path, body, kind=kind))

    def upload(self, path: str, changes: Sequence[Change], files: Files) -> None:
        """Upload files to the desk."""
        page, *others = changes
        self.lab.journal.sent += others
        self._send("upload", page, lambda: self._visitor.upload(path, files))
        for other in others:
            other.confirmed = page.confirmed

    def _send(self, page: str, change: Change, ask: Callable[[], Answer]) -> None:
        self.lab.journal.sent.append(change)
        answer = self._timed(page, ask)
        change.confirmed = answer.status == 303
        if not change.confirmed:
            self.lab.journal.refused.append((answer.status, page, wrong_in(answer)))

    def _timed(self, page: str, ask: Callable[[], Answer]) -> Answer:
        began = time.perf_counter()
        try:
            answer = ask()
        except (OSError, http.client.HTTPException):
            raise Gone from None
        self.lab.journal.times.append((page, time.perf_counter() - began))
        return answer


class Assistant(Person):
    """A TA who reviews teams, gives points to one team or several, and answers requests."""

    def habits(self) -> Mapping[Callable[[], None], float]:
        """Return the actions, which are mostly reviews."""
        return {self.look: 2, self.review: 6, self.decide: 1, self.answer: 3, self.read: 1}

    def look(self) -> None:
        """Open the class page, perhaps filtered, with its figure and news, as a browser does."""
        asked = self.draw.choice([{}, {"seen": "no"}, {"state": "remark"}, {"order": "points"},
                                  {"page": "3"}, {"q": "12"}])  # fmt: skip
        text = self.get("class", f"/grades/0/?{urlencode(asked)}")
        drawn = re.search(r"distribution\.svg[^\"]*", text)
        if drawn:
            self.get("figure", f"/grades/0/{unescape(drawn[0])}")
        self.get("news", "/grades/0/news?since=0&told=0")

    def read(self) -> None:
        """Open a team's feedback or the class page."""
        if self.draw.random() < 0.5:
            self.get("class page", "/grades/0/class.html")
        else:
            team = self.draw.choice(self.lab.teams)
            self.get("feedback in full", f"/grades/0/feedback/{team}/feedback.html")

    def review(self) -> None:
        """Change a criterion's points or comment on them; in half of the cases accept the grade."""
        team = self.draw.choice(self.lab.teams)
        path = f"/grades/0/team?of={team}"
        text = self.get("team", path)
        criteria = re.findall(r"criterion=([\w-]+)[^\"]*#chosen", text)
        if criteria:
            text = self.get("team", f"{path}&criterion={self.draw.choice(criteria)}")
        if figure := re.search(r'<img class="drawing" src="([^"]+)"', text):
            self.get("figure", unescape(figure[1]))
        shown = re.search(
            r'name="criterion" value="(.*?)"><input .*?name="seen" value="(.*?)"', text
        )
        steps = re.findall(r'type="radio" name="points" value="([^"]+)"( checked)?', text)
        if shown and steps:
            checked = [value for value, on in steps if on]
            comment = checked and self.draw.random() < 0.4
            points = checked[0] if comment else self.draw.choice(steps)[0]
            why = self.token("points")
            self.post("change points", path, Change(
                kind="points", by=self.name, where=(team, shown[1]), token=why,
                points=float(points),
            ), {"do": "change", "criterion": shown[1], "seen": shown[2], "points": points,
                "why": why})  # fmt: skip
            self.get("team", f"{path}&criterion={shown[1]}")
        if self.draw.random() < 0.5:
            self._timed("accept", lambda: self._visitor.post(path, do="accept"))

    def decide(self) -> None:
        """Give several teams the same points, or a comment, in one change."""
        text = self.get("class", "/grades/0/")
        lost = re.findall(r"[?&;]lost=([\w-]+)", text) or re.findall(
            r'<option value="([\w-]+)"', text.partition('name="lost"')[2].partition("</select>")[0]
        )
        if not lost:
            return
        criterion = self.draw.choice(sorted(set(lost)))
        path = f"/grades/0/bulk-change?{urlencode({'criterion': criterion, 'lost': criterion})}"
        text = self.get("several teams", path)
        rows = re.findall(r'name="team" value="([^"]+)".*?name="seen\.\1" value="([^"]*)"', text)
        if not rows:
            return
        chosen = self.draw.sample(rows, min(len(rows), _MOST_TOGETHER))
        steps = re.findall(r'type="radio" name="points" value="([^"]+)"', text)
        points, why = self.draw.choice(steps), self.token("together")
        teams = [team for team, _ in chosen]
        self.post("apply to several", path, Change(
            kind="together", by=self.name, where=("", criterion), token=why, teams=tuple(teams),
            points=None if points == "same" else float(points),
        ), {"do": "apply", "listed": "1", "points": points, "why": why, "team": teams,
            **{f"seen.{team}": seen for team, seen in chosen}})  # fmt: skip

    def answer(self) -> None:
        """Answer an open request, or if all are settled, reopen one."""
        text = self.get("requests", "/grades/0/requests")
        names = ("team", "criterion", "seen")
        hidden = "".join(rf'<input type="hidden" name="{name}" value="(.*?)">' for name in names)
        waiting = re.findall(rf'class="answering">\s*{hidden}', text)
        settled = re.findall(rf'{hidden}\s*<p><button name="do" value="reopen"', text)
        if waiting:
            team, criterion, seen = self.draw.choice(waiting)
            points = self.draw.choice(["", "0", "0.5"])
            said = self.token("answer")
            self.post("answer", "/grades/0/requests", Change(
                kind="answer", by=self.name, where=(team, criterion), token=said,
                points=float(points) if points else None,
            ), {"do": "answer", "team": team, "criterion": criterion, "seen": seen,
                "points": points, "text": said})  # fmt: skip
        elif settled:
            team, criterion, seen = self.draw.choice(settled)
            self.post("answer", "/grades/0/requests", Change(
                kind="reopened", by=self.name, where=(team, criterion), token="",
            ), {"do": "reopen", "team": team, "criterion": criterion, "seen": seen})  # fmt: skip


class Student(Person):
    """A student who uploads recordings, saves rows, reads feedback and asks for reviews.

    Parameters
    ----------
    recordings : files to upload in turn; each later upload of a file has fewer lines.
    """

    rests = RESTS_OF_STUDENT

    def __init__(
        self, name: str, lab: Lab, *, team: str, recordings: Files, folders: int, seed: int
    ) -> None:
        super().__init__(name, lab, seed=seed)
        self._team, self._recordings, self._folders = team, recordings, folders
        self._uploaded = self._folder = 0

    def habits(self) -> Mapping[Callable[[], None], float]:
        """Return the actions, which are mostly uploads."""
        return {self.send: 6, self.save: 3, self.ask: 2, self.read: 1}

    @property
    def room(self) -> str:
        """Address of the student's current folder."""
        return f"/student/{self._folder}/"

    def finish(self) -> None:
        """Let the desk write all tables that are still missing because it was killed."""
        for number in range(self._folder + 1):
            self._folder = number
            self._complete(self.get("submission", self.room))

    def send(self) -> None:
        """Upload one to three recordings; if a table is then missing, let the desk write it."""
        files = [self._next() for _ in range(self.draw.randint(1, 3))]
        changes = [
            Change(kind="upload", by=self.name, where=(str(self._folder), name), token=digest(raw))
            for name, raw in files
        ]
        self.upload(f"{self.room}files", changes, files)
        text = self.get("submission", self.room)
        if "were not uploaded" in text:  # the worker was killed, and the page says so
            for change in changes:
                change.confirmed = False
        self._complete(text)
        if text.count('data-row="') >= FULL and self._folder + 1 < self._folders:
            self._folder += 1

    def save(self) -> None:
        """Write a note into one row of the table of recordings."""
        text = self.get("submission", self.room)
        rows = re.findall(r'data-row="([^"]+)" action="[^"]*experiments/(\d+)"', text)
        seen = re.search(r'name="seen" value="(.*?)"', text)
        if rows and seen:
            id_, index = self.draw.choice(rows)
            note = self.token("note")
            self.post("save a row", f"{self.room}experiments/{index}", Change(
                kind="row", by=self.name, where=(str(self._folder), unescape(id_)), token=note,
            ), {"seen": seen[1], f"experiments.{index}.note": note})  # fmt: skip
            self.get("submission", self.room)

    def read(self) -> None:
        """Read the whole feedback."""
        self.get("feedback in full", "/feedback/0/whole")

    def ask(self) -> None:
        """Ask for a review of a criterion for which this is allowed."""
        text = self.get("feedback", "/feedback/0/")
        open_ = re.findall(r'class="asking">\s*<input type="hidden" name="criterion" value="(.*?)"',
                           text)  # fmt: skip
        waits = text.count("waits for an answer")
        if open_ and waits < 4:
            criterion, why = self.draw.choice(open_), self.token("request")
            self.post("ask", "/feedback/0/ask", Change(
                kind="request", by=self.name, where=(self._team, criterion), token=why,
            ), {"criterion": criterion, "why": why})  # fmt: skip

    def _next(self) -> tuple[str, bytes]:
        """Return a recording that nobody has uploaded yet, made by leaving out the last lines."""
        rounds, number = divmod(self._uploaded, len(self._recordings))
        self._uploaded += 1
        name, raw = self._recordings[number]
        lines = raw.splitlines(keepends=True)
        return f"{rounds}-{name}", b"".join(lines[: len(lines) - rounds])

    def _complete(self, text: str) -> None:
        """Let the desk write the missing tables."""
        if 'name="file" value="data/' in text:
            self._timed("upload", lambda: self._visitor.post(f"{self.room}fill"))


def digest(raw: bytes) -> str:
    """Return a digest of the content of a file."""
    return hashlib.sha256(raw).hexdigest()


def wrong_in(answer: Answer) -> str:
    """Return the first error message of a page."""
    found = re.search(r'class="wrong"[^>]*>([^<]*)<', answer.text)
    return " ".join(unescape(found[1]).split()) if found else answer.text[:200]
