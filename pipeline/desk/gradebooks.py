"""The gradebooks that are open at this desk, and the last state read from each class."""

import getpass
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.decisions import points_lost
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.gradebook.gradebook import Gradebook, State
from pipeline.grading.gradebook.rows import ClassNow
from pipeline.grading.publish.pseudonyms import anonymise, pseudonyms
from pipeline.grading.rubric import Rubric


@dataclass(frozen=True)
class ClassView:
    """A class as pages show it. If it is anonymous, it has pseudonyms and is sorted by them."""

    now: ClassNow
    state: State

    @property
    def rubric(self) -> Rubric:
        """The rubric by which the class is graded."""
        return self.now.rubric

    @cached_property
    def names(self) -> Mapping[str, str] | None:
        """The pseudonym of each submission, None if names are shown."""
        if not self.rubric.anonymous:
            return None
        return pseudonyms({one.submission: one.first_key for one in self.now.entries})

    @cached_property
    def teams(self) -> Mapping[str, Entry]:
        """The teams by the names that pages show; their grades contain no other names."""
        teams = self.now.entries
        if self.names is not None:  # the order of the real names would reveal them
            teams = [replace(one, graded=anonymise(one.graded, self.names)) for one in teams]
            teams.sort(key=lambda team: team.grade.submission)
        return {team.grade.submission: team for team in teams}

    def team(self, name: str) -> Entry:
        """Return a team by its name as pages show it."""
        team = self.teams.get(name)
        if team is None:
            raise HTTPException(404, "no submission of this class has this name")
        return team

    @cached_property
    def lost(self) -> Mapping[str, set[str]]:
        """For each criterion, the teams without full points or without a judgement.

        A criterion that a person has yet to grade has lost nothing yet.
        """
        lost: dict[str, set[str]] = {asked.id: set() for asked in self.rubric.criteria}
        for name, team in self.teams.items():
            # A failed submission lost no single criterion; the class page counts in the same way.
            if team.grade.status != "failed":
                for key in points_lost(team.grade, self.rubric):
                    lost[key].add(name)
        return lost


def _find_user() -> str:
    try:
        return getpass.getuser()
    # Before Python 3.12, KeyError is raised for a user that the system does not know.
    except (OSError, KeyError):
        return ""


class Gradebooks:
    """The open gradebooks; each is opened once, and its class is read again only after a change."""

    def __init__(self) -> None:
        # Name of the person who changes points, unless a proxy states it.
        self.signed = _find_user()
        self._books: dict[Path | str, Gradebook] = {}
        self._classes: dict[Path | str, ClassView] = {}
        self._drawn: dict[tuple[Path | str, str], tuple[State, Any]] = {}
        self._lock, self._drawing = threading.Lock(), threading.Lock()

    def gradebook(self, place: Path | str) -> Gradebook:
        """Return an open gradebook.

        Raises
        ------
        ConfigError : the gradebook is missing.
        """
        with self._lock:
            if isinstance(place, Path) and not place.is_dir():
                raise ConfigError(f"{place.name}: this folder no longer exists")
            if place not in self._books:
                self._books[place] = Gradebook(place)
            return self._books[place]

    def n_waiting(self, place: Path | str) -> int:
        """Return how many requests wait in a gradebook; 0 if it cannot be read now.

        Every page calls this function, so it never opens a database, which could take long.
        """
        if isinstance(place, str) and place not in self._books:
            return 0
        try:
            return self.gradebook(place).n_waiting()
        except (ConfigError, OSError):  # the gradebook's own page reports the error
            return 0

    def of(self, place: Path | str) -> ClassView:
        """Return the class in its current state."""
        book = self.gradebook(place)
        state, known = book.state(), self._classes.get(place)
        if known is None or known.state != state:
            known = ClassView(book.class_now(known.now if known else None), state)
            self._classes[place] = known
        return known

    def drawn(self, place: Path | str, what: str, draw: Callable[[ClassView], Any]) -> Any:
        """Return a drawing of a class; it is redrawn only after a change.

        Only one drawing is made at a time.
        """
        shown = self.of(place)
        with self._drawing:
            known = self._drawn.get((place, what))
            if known is None or known[0] != shown.state:
                known = self._drawn[place, what] = shown.state, draw(shown)
            return known[1]

    def close(self) -> None:
        """Close all gradebooks."""
        for book in self._books.values():
            book.close()
