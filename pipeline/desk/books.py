"""The gradebooks that are open at this desk, and each class as it was read last."""

import getpass
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.open_book import ClassNow, Listing, State
from pipeline.grading.gradebook.request_book import RequestBook
from pipeline.grading.publish.anonymous import anonymous_line, pseudonyms
from pipeline.grading.rubric import Rubric


@dataclass(frozen=True)
class Class:
    """A class as pages show it: under other names where it is anonymous, and in their order."""

    now: ClassNow
    state: State

    @property
    def rubric(self) -> Rubric:
        """By which it is graded."""
        return self.now.rubric

    @cached_property
    def names(self) -> Mapping[str, str] | None:
        """The pseudonym of each submission, None if names are shown."""
        if not self.rubric.anonymous:
            return None
        return pseudonyms({one.submission: one.first_key for one in self.now.listings})

    @cached_property
    def teams(self) -> Mapping[str, Listing]:
        """All of it, by the names that are shown."""
        teams = list(self.now.listings)
        if self.names is not None:  # the order of the names would tell
            teams = [replace(one, line=anonymous_line(one.line, self.names)) for one in teams]
            teams.sort(key=lambda team: team.line.submission)
        return {team.line.submission: team for team in teams}

    @cached_property
    def lost(self) -> Mapping[str, set[str]]:
        """The graded submissions without full points of a criterion; an unjudged one has 0."""
        lost: dict[str, set[str]] = {asked.id: set() for asked in self.rubric.criteria}
        whole = {asked.id: asked.points for asked in self.rubric.criteria}
        for name, team in self.teams.items():
            if team.line.status == "failed":  # as on the class page: nothing was lost
                continue
            judged = team.line.judged
            for key, points in whole.items():
                if key not in judged or judged[key]["points"] < points:
                    lost[key].add(name)
        return lost


def _find_user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # KeyError until Python 3.12: a system that does not know them
        return ""


class Books:
    """Every gradebook is opened once, and a class read when something in it is another."""

    def __init__(self) -> None:
        self.signed = _find_user()  # who changes points, where no proxy says it
        self.asked: dict[Path | str, dict[str, str]] = {}  # what was graded again last, from where
        self._books: dict[Path | str, RequestBook] = {}
        self._classes: dict[Path | str, Class] = {}
        self._drawn: dict[tuple[Path | str, str], tuple[State, Any]] = {}
        self._lock, self._drawing = threading.Lock(), threading.Lock()

    def book(self, place: Path | str) -> RequestBook:
        """Return an open gradebook.

        Raises
        ------
        ConfigError : the gradebook is missing.
        """
        with self._lock:
            if isinstance(place, Path) and not place.is_dir():
                raise ConfigError(f"{place.name}: this folder no longer exists")
            if place not in self._books:
                self._books[place] = RequestBook(place)
            return self._books[place]

    def n_waiting(self, place: Path | str) -> int:
        """Return how many requests wait in a gradebook; 0 where that cannot be read now.

        A database that nobody opened yet is not waited for: every page asks this.
        """
        if isinstance(place, str) and place not in self._books:
            return 0
        try:
            return self.book(place).n_waiting()
        except (ConfigError, OSError):  # its own page says why
            return 0

    def of(self, place: Path | str) -> Class:
        """Return the class as it is now."""
        book = self.book(place)
        state, known = book.state(), self._classes.get(place)
        if known is None or known.state != state:
            known = Class(book.class_now(known.now if known else None), state)
            self._classes[place] = known
        return known

    def drawn(self, place: Path | str, what: str, draw: Callable[[Class], Any]) -> Any:
        """Return what is drawn of a class, again only where that is another; one at a time."""
        shown = self.of(place)
        with self._drawing:
            known = self._drawn.get((place, what))
            if known is None or known[0] != shown.state:
                known = self._drawn[place, what] = shown.state, draw(shown)
            return known[1]

    def close(self) -> None:
        """Let go of all."""
        for book in self._books.values():
            book.close()
