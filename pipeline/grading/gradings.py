"""What the runner and the gradebook share: gradings, the members of a class, the batch."""

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Literal

from pipeline.grading.grade import Flag


@dataclass(frozen=True, kw_only=True)
class Member:
    """A submission of a class: whose it is, and the fingerprints of its recordings.

    Attributes
    ----------
    submission : its id, unique in the batch.
    owner : who handed it in, as the learning platform calls them, or "".
    key : hash of all that its grading depends on: the files as handed in, rubric, code, name,
        lateness; behind a hyphen that of the files alone.
    fingerprints : to find its recordings in other submissions; see `shared.py`.
    reason : one line, why it could not be graded, or "".
    grading : the number of its grading in the gradebook.
    of_class : whether it is of the assignment that is being graded.
    """

    submission: str
    authors: tuple[str, ...] = ()
    owner: str = ""
    key: str = ""
    fingerprints: bytes = field(default=b"", repr=False)
    reason: str = ""
    grading: int = 0
    of_class: bool = False

    @cached_property
    def people(self) -> set[str]:
        """The authors, however they typed their ids."""
        return set(map(person, self.authors))

    @property
    def content(self) -> str:
        """The part of its key that is of the files alone, "" where it has none."""
        return self.key.partition("-")[2]


@dataclass(frozen=True, kw_only=True)
class Grading(Member):
    """What one submission came to by itself, before it is compared with the others.

    Attributes
    ----------
    status : `failed` where it could not be graded.
    settled : False where a limit or a crash ended it: another run tries again.
    grade : `grade.json` without what other submissions add (shared data, overrides).
    findings : what the checks found, as `judge.reweigh` keeps it, "" where it failed.
    figures : (file name, SVG) for the feedback.
    detail : for whoever mends the grader: the traceback of an error of its own, or "".
    lacks_room : the disk was full. It concerns this run alone: the gradebook does not keep it.
    """

    status: Literal["graded", "failed"]
    settled: bool = True
    days_late: float = 0.0
    grade: str
    findings: str = ""
    figures: tuple[tuple[str, str], ...] = ()
    detail: str = ""
    lacks_room: bool = False

    @property
    def member(self) -> Member:
        """What a batch itself needs of a grading: all else stays in the book."""
        return Member(**{own.name: getattr(self, own.name) for own in fields(Member)})


def person(author: str) -> str:
    """Return an author's id without what people type one way today and another tomorrow."""
    return " ".join(unicodedata.normalize("NFKC", author).split()).casefold()


def go_with(given: tuple[str, ...], authors: tuple[str, ...]) -> bool:
    """Whether what was given to some people still concerns a submission of these authors.

    A submission that cannot be read names no authors: then its name decides.
    """
    if not authors or not given:
        return True
    return not set(map(person, authors)).isdisjoint(map(person, given))


@dataclass(frozen=True, kw_only=True)
class Batch:
    """A batch that ran to its end; the gradings themselves stay in the gradebook.

    Attributes
    ----------
    keys : of the gradings, in the order of the submissions' ids.
    shared : by submission, the flag for recordings that stand in another submission too.
    failed : (submission, reason) of those that could not be graded.
    unsettled : those of them that the next run tries again; lacks_room : for which the disk was
        full.
    kept, moved, taken_over : what became of the class list before, see `so_far.SoFar`.
    """

    keys: tuple[str, ...]
    shared: Mapping[str, Flag]
    failed: tuple[tuple[str, str], ...] = ()
    unsettled: frozenset[str] = frozenset()
    lacks_room: frozenset[str] = frozenset()
    kept: tuple[str, ...] = ()
    moved: Mapping[str, str] = field(default_factory=dict)
    taken_over: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = ()
