"""Types shared by the runner, its grading processes and the gradebook: hand-ins, gradings, batches.

Importing this module loads no code that grades.
"""

import base64
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

from pipeline.grading.grade import Flag, Grade, grade_text
from pipeline.grading.rubric import Rubric


@dataclass(frozen=True, kw_only=True)
class HandIn:
    """The files that one team submitted, to be graded.

    Attributes
    ----------
    id : id that is unique in the batch and valid as a folder name.
    sources : one folder, or several files, which may be archives.
    owner : account that submitted the files, with platform and account number, such as "Jane Doe
        (moodle 1024)"; see `platforms.Account`; or "".
    handed_in : time of the hand-in in ISO 8601, or "" if the platform does not give it.
    problem : why the files cannot be opened, if this is already known; or "".
    parent : name of the parent folder, which may be used to make the id unique.
    key : hash of everything that affects the outcome; see `Grading`.
    digest : expected hash of the submitted files; "" to skip this check.
    repairs : see `intake.repairs.read_repairs`.
    bench : the team's bench in an answer key, as JSON; or "".
    """

    id: str
    sources: tuple[Path, ...] = ()
    owner: str = ""
    handed_in: str = ""
    days_late: float = 0.0
    problem: str = ""
    parent: str = ""
    key: str = ""
    digest: str = ""
    bench: str = field(default="", repr=False)
    repairs: Mapping[str, Mapping[str, str]] = field(default_factory=dict, hash=False)

    def plain(self) -> dict[str, Any]:
        """Return the hand-in as a dictionary that JSON can store."""
        return asdict(self) | {"sources": [str(source) for source in self.sources]}

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> "HandIn":
        """Return the hand-in that `plain` turned into a dictionary."""
        return cls(**{**plain, "sources": tuple(map(Path, plain["sources"]))})


@dataclass(frozen=True, kw_only=True)
class Grading:
    """The result of grading one submission, before it is compared with the others.

    Attributes
    ----------
    submission : id of the submission, unique in the batch.
    owner : account on the learning platform that submitted the files; see `HandIn`.
    key : hash of everything that affects the grade (submitted files, rubric, code, name and
        lateness), a hyphen, and the hash of the files alone.
    fingerprints : noise patterns of the recordings, by which copies are found; see
        `similarity.fingerprints`.
    reason : why the submission could not be graded, one cause per line, or "".
    grading : number of the grading in the gradebook.
    of_class : whether the submission belongs to the assignment that is being graded.
    settled : False if the next run must grade the submission again, for example after a crash.
    grade : text of `grade.json`, without the flag for shared data and without overrides.
    findings : results of the checks, from `judge.award.findings_text`; "" if grading failed.
    figures : file name and SVG text of each figure in the feedback.
    detail : for developers: the traceback of an error in the grader, or "".
    is_disk_full : whether the disk was full; the gradebook does not store this.
    original : text of `submission.toml` as handed in, if it has a mistake or was repaired; else "".
        The gradebook does not store this.
    """

    submission: str
    authors: tuple[str, ...] = ()
    owner: str = ""
    key: str = ""
    fingerprints: bytes = field(default=b"", repr=False)
    reason: str = ""
    grading: int = 0
    of_class: bool = False
    status: Literal["graded", "failed"] = "graded"
    settled: bool = True
    days_late: float = 0.0
    grade: str = ""
    findings: str = ""
    figures: tuple[tuple[str, str], ...] = ()
    detail: str = ""
    is_disk_full: bool = False
    original: str = ""

    @cached_property
    def people(self) -> set[str]:
        """The authors' ids in a normal form; see `person`."""
        return set(map(person, self.authors))

    @property
    def content(self) -> str:
        """The part of the key that depends only on the files, or ""."""
        return self.key.partition("-")[2]

    def without_texts(self) -> "Grading":
        """Return what a batch keeps in memory; the gradebook stores the whole grading."""
        return replace(self, grade="", findings="", figures=(), detail="", original="")


@dataclass(frozen=True, kw_only=True)
class Example:
    """A submission that the lab gave out with an assignment; everybody may have its data.

    Attributes
    ----------
    fingerprints : noise patterns of its recordings.
    numbers : name and value of each number that it reports.
    """

    fingerprints: bytes = field(repr=False)
    numbers: frozenset[tuple[str, float]] = frozenset()


def person(author: str) -> str:
    """Return an author's id in a normal form, so that different spellings are equal."""
    return " ".join(unicodedata.normalize("NFKC", author).split()).casefold()


def same_people(given: tuple[str, ...], authors: tuple[str, ...]) -> bool:
    """Return whether points given to some people apply to a submission by some authors.

    They do if at least one author is among those people. If the authors or the people are
    unknown, the points apply to the submission of the same name.
    """
    if not authors or not given:
        return True
    return not set(map(person, authors)).isdisjoint(map(person, given))


@dataclass(frozen=True, kw_only=True)
class Batch:
    """A complete batch; the gradings themselves are in the gradebook.

    Attributes
    ----------
    keys : keys of the gradings, in the order of the submission ids.
    shared : flag for recordings or tables that another submission also contains, by submission.
    failed : name and reason for each submission that could not be graded.
    unsettled : number of failed submissions that the next run grades again.
    disk_full : number of submissions that failed because the disk was full.
    kept, moved, taken_over : changes to the class list; see `batch.runner.ClassChanges`.
    """

    keys: tuple[str, ...]
    shared: Mapping[str, Flag]
    failed: tuple[tuple[str, str], ...] = ()
    unsettled: int = 0
    disk_full: int = 0
    kept: tuple[str, ...] = ()
    moved: Mapping[str, str] = field(default_factory=dict)
    taken_over: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = ()


OUT_OF_MEMORY = "needs more memory than allowed"


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Settings for grading, the same for all submissions of a batch.

    Attributes
    ----------
    scratch : folder for copies of the submissions during grading.
    time_limit : time limit for one submission, in s.
    memory_limit : memory limit for one submission, in bytes, added to what an idle process needs.
    out : folder of the class, with repairs of submissions; None for a class in a database.
    """

    rubric: Rubric
    scratch: Path
    time_limit: float = 120.0
    memory_limit: int = 1_000_000_000
    figures: bool = False
    out: Path | None = None


def failed(
    hand_in: HandIn,
    reason: str,
    *,
    out_of: float,
    authors: Sequence[str] = (),
    settled: bool = True,
    detail: str = "",
    repaired: str = "",
) -> Grading:
    """Return the outcome of a submission that could not be graded.

    Parameters
    ----------
    reason : why the submission could not be graded, one cause per line.
    settled : whether the outcome is final; if not, the next run grades the submission again.
    repaired : see `Grade`.
    """
    lines = (" ".join(line.split()) for line in reason.split("\n"))
    reason = "".join(c if c.isprintable() or c == "\n" else "�" for c in "\n".join(lines))
    people = tuple(authors)
    grade = Grade.failed(
        hand_in.id,
        reason,
        out_of=out_of,
        authors=people,
        days_late=hand_in.days_late,
        unsettled=not settled,
    ).model_copy(update={"repaired": repaired})
    return Grading(
        submission=hand_in.id,
        authors=people,
        key=hand_in.key,
        status="failed",
        reason=reason,
        settled=settled,
        days_late=hand_in.days_late,
        grade=grade_text(grade),
        owner=hand_in.owner,
        detail=detail,
    )


def plain_grading(outcome: Grading) -> dict[str, Any]:
    """Return an outcome as a dictionary that JSON can store."""
    return asdict(outcome) | {"fingerprints": base64.b64encode(outcome.fingerprints).decode()}


def read_grading(plain: Mapping[str, Any]) -> Grading:
    """Return the outcome that `plain_grading` turned into a dictionary."""
    return Grading(
        **{
            **plain,
            "fingerprints": base64.b64decode(plain["fingerprints"]),
            "authors": tuple(plain["authors"]),
            "figures": tuple((name, svg) for name, svg in plain["figures"]),
        }
    )
