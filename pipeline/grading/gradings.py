"""Types shared by the runner and the gradebook: gradings, class members, batches."""

import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Literal

from pipeline.grading.grade import Flag


@dataclass(frozen=True, kw_only=True)
class Member:
    """A submission of a class: its owner and the fingerprints of its recordings.

    Attributes
    ----------
    submission : its id, unique in the batch.
    owner : the account that submitted it, as the learning platform names it, or "".
    key : hash of everything that affects the grade (submitted files, rubric, code, name and
        lateness), a hyphen, and the hash of the files alone.
    fingerprints : noise patterns of its recordings, to find them in other submissions; see
        `shared.py`.
    reason : why it could not be graded, in one line, or "".
    grading : the number of its grading in the gradebook.
    of_class : whether it belongs to the assignment being graded.
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
        """The authors, with ids in a normal form."""
        return set(map(person, self.authors))

    @property
    def content(self) -> str:
        """The part of the key that depends only on the files, or ""."""
        return self.key.partition("-")[2]


@dataclass(frozen=True, kw_only=True)
class Grading(Member):
    """The result of one submission, before it is compared with the others.

    Attributes
    ----------
    status : `failed` if it could not be graded.
    settled : False if a limit or a crash ended the grading; the next run tries again.
    grade : text of `grade.json`, without shared data and overrides.
    findings : results of the checks, as `judge.reweigh` stores them; "" if grading failed.
    figures : file names and SVG texts for the feedback.
    detail : for developers: the traceback of an error in the grader, or "".
    is_disk_full : the disk was full. This concerns only this run; the gradebook does not keep it.
    """

    status: Literal["graded", "failed"]
    settled: bool = True
    days_late: float = 0.0
    grade: str
    findings: str = ""
    figures: tuple[tuple[str, str], ...] = ()
    detail: str = ""
    is_disk_full: bool = False

    @property
    def member(self) -> Member:
        """The part that a batch keeps in memory; the gradebook stores the whole grading."""
        return Member(**{own.name: getattr(self, own.name) for own in fields(Member)})


def person(author: str) -> str:
    """Return an author's id in a normal form, so that different spellings are equal."""
    return " ".join(unicodedata.normalize("NFKC", author).split()).casefold()


def go_with(given: tuple[str, ...], authors: tuple[str, ...]) -> bool:
    """Return whether points given to some people still apply to a submission of these authors.

    A submission that cannot be read has no authors. Then points given under its name apply.
    """
    if not authors or not given:
        return True
    return not set(map(person, authors)).isdisjoint(map(person, given))


@dataclass(frozen=True, kw_only=True)
class Batch:
    """A complete batch; the gradings themselves are in the gradebook.

    Attributes
    ----------
    keys : of the gradings, in the order of the submissions' ids.
    shared : by submission, the flag for recordings that another submission also contains.
    failed : submission and reason, for those that could not be graded.
    unsettled : number of failed submissions that the next run tries again.
    is_disk_full : number of submissions that failed because the disk was full.
    kept, moved, taken_over : changes since the last class list; see `so_far.SoFar`.
    """

    keys: tuple[str, ...]
    shared: Mapping[str, Flag]
    failed: tuple[tuple[str, str], ...] = ()
    unsettled: frozenset[str] = frozenset()
    is_disk_full: frozenset[str] = frozenset()
    kept: tuple[str, ...] = ()
    moved: Mapping[str, str] = field(default_factory=dict)
    taken_over: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = ()
