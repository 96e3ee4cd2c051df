"""The students of a class list, each with one grade."""

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.entry import Entry
from pipeline.grading.gradings import person
from pipeline.grading.platforms import Account, Platform
from pipeline.grading.publish.view import GradeView, view
from pipeline.grading.words import points_text
from pipeline.words.numbers import first_few

_ALL = sys.maxsize  # names


@dataclass(frozen=True, kw_only=True)
class Student:
    """One student's grade.

    Attributes
    ----------
    id : id of the author in the submission; or "".
    name, number, download : name and number of the account that submitted, and name of its file, on
        the platform for which grades are exported; or "".
    team : all authors of the submission.
    view : the grade as the student's team may read it.
    uploader : whether this entry is the account that submitted; it belongs to one of several
        authors, but it is unknown to which.
    undecided : message that names the submissions, if the student is in several with different
        points.
    """

    id: str
    name: str
    number: str
    download: str = ""
    team: tuple[str, ...] = ()
    view: GradeView
    uploader: bool = False
    undecided: str = ""

    @property
    def grade(self) -> Grade:
        """The grade as the student's team may read it."""
        return self.view.grade

    @property
    def points(self) -> str:
        """The points as text.

        Empty if the submission was not graded, because a zero would look like a grade. Also empty
        if a person must decide which of several submissions counts.
        """
        ungraded = self.grade.status == "failed" and not self.view.is_by_hand
        return "" if ungraded or self.undecided else points_text(self.grade.points)

    @property
    def called(self) -> str:
        """The name of the student in messages."""
        return self.id or self.name or self.grade.submission


@dataclass(frozen=True, kw_only=True)
class Remark:
    """A remark for the person who uploads a table.

    Attributes
    ----------
    left_out : whether a student with points is missing from the table.
    """

    text: str
    left_out: bool = False


def one_of(several: Sequence[Student]) -> Student:
    """Combine the entries that one student has from several submissions.

    An entry with points wins over one without. If the points differ, the student gets no
    points until a person decides.
    """
    if undecided := [student for student in several if student.undecided]:
        return undecided[0]
    graded = [student for student in several if student.points] or [*several]
    if len({student.points for student in graded}) == 1:
        return graded[0]
    named = [f"{s.grade.submission} ({s.points})" for s in graded]
    return replace(
        graded[0],
        undecided=f"{graded[0].called} is in {' and '.join(named)}: left out until the wrong one "
        f"is removed with cartlab remove",
    )


def students_of(
    entries: Sequence[Entry], *, platform: Platform, accounts: bool = False
) -> tuple[list[Student], list[Remark]]:
    """Return every student once, and remarks on students whose grade or name is unclear.

    Parameters
    ----------
    accounts : whether to add the account that submitted for a team also if its number may be that
        of a group.
    """
    found: dict[str, list[Student]] = {}
    for entry in entries:
        for student in _students(entry, platform=platform, accounts=accounts):
            # Two students without an id are not the same student.
            nameless = student.number if student.uploader else entry.submission
            found.setdefault(person(student.id) or f"\0{nameless}", []).append(student)
    students = [one_of(several) for several in found.values()]
    remarks = [Remark(text=s.undecided, left_out=True) for s in students if s.undecided]
    strangers = [s for s in students if not (s.id or s.name or s.number)]
    nobodys = [s for s in strangers if not (s.view.is_by_hand or s.grade.unsettled)]
    remarks += not_exported("it names no author", nobodys)
    unread = [s for s in strangers if s.grade.awaits_grading]
    remarks += not_exported("its authors could not be read yet", unread)
    by_hand = (s.grade.submission for s in strangers if s.view.is_by_hand)
    remarks += about("it names no author, so exported under the name of its folder", by_hand)
    students = [
        replace(s, name=s.grade.submission) if s in strangers else s
        for s in students
        if s.view.is_by_hand or s not in strangers
    ]
    return students, remarks


def about(
    what: str, names: Iterable[str], *, most: int = _ALL, left_out: bool = False
) -> list[Remark]:
    """Return a remark that names some people or submissions, each once; none without names.

    Parameters
    ----------
    most : how many names it gives; of more, only the first.
    """
    named = [*dict.fromkeys(names)]
    return [Remark(text=f"{what}: {first_few(named, most)}", left_out=left_out)] if named else []


def not_exported(why: str, students: Sequence[Student]) -> list[Remark]:
    """Return a remark that names students who are missing from a table, with the reason."""
    lost = any(student.points or student.undecided for student in students)
    called = [student.called for student in students]
    return about(f"{why}, so not exported", called, left_out=lost)


def _students(entry: Entry, *, platform: Platform, accounts: bool) -> list[Student]:
    """Return the authors of a submission.

    If there are several authors, the account that submitted is added if it is a student's. If a
    submission names no authors, the authors stored with its points given by hand are used.
    """
    account = Account.read(entry.owner)
    here = account.platform in ("", platform.name)
    given = [
        author for o in (*entry.overrides.values(), *entry.adjustments) for author in o.authors
    ]
    authors = entry.grade.authors or tuple(dict.fromkeys(given)) or ("",)
    own = Student(
        id="",
        name=account.name,
        number=account.number if here else "",
        download=account.download if here else "",
        team=entry.grade.authors,
        view=view(entry, "team"),
    )
    if len(authors) == 1:
        return [replace(own, id=authors[0])]
    named = [replace(own, id=author, name="", number="", download="") for author in authors]
    has_account = (platform.is_personal or accounts) and (own.number or own.download)
    return [*named, replace(own, uploader=True)] if has_account else named
