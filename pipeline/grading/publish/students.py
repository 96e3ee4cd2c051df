"""The students of a class list, each with a grade."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.rows import Entry
from pipeline.grading.gradings import person
from pipeline.grading.intake.lms_names import Platform, read_owner
from pipeline.grading.words import points_text

# `results.json` needs a score: "optional, but required if not on each test case".
_GRADESCOPE_BLANK = "left blank in gradescope.csv but 0 in results.json, which must have a score"


@dataclass(frozen=True, kw_only=True)
class Student:
    """One student's grade.

    Attributes
    ----------
    id : as the submission names the author, or "".
    name, number : as the learning platform calls who handed it in, or "". The number is the
        platform's that the grades are for. Of several authors nobody says which that is: it is
        then a student beside them, known as `uploader`.
    by_hand : the criteria whose points were given by hand.
    undecided : where the student is in several submissions with different points: in which ones.
    """

    id: str
    name: str
    number: str
    grade: Grade
    by_hand: frozenset[str]
    uploader: bool = False
    undecided: str = ""

    @property
    def points(self) -> str:
        """The points, "" where nobody has graded it yet: a zero would say that somebody had.

        And where somebody has to say which of several submissions counts.
        """
        ungraded = self.grade.status == "failed" and not self.by_hand
        return "" if ungraded or self.undecided else points_text(self.grade.points)

    @property
    def called(self) -> str:
        """What to call the student in a message."""
        return self.id or self.name or self.grade.submission


@dataclass(frozen=True, kw_only=True)
class Remark:
    """What the person who uploads a table should know.

    Attributes
    ----------
    left_out : somebody who has points has none in the table.
    """

    text: str
    left_out: bool = False


def one_of(several: Sequence[Student]) -> Student:
    """Return what stands for one student in several submissions.

    Any points are better than none; of different points none are, until a person has decided.
    """
    if undecided := [student for student in several if student.undecided]:
        return undecided[0]
    graded = [student for student in several if student.points] or [*several]
    if len({student.points for student in graded}) == 1:
        return graded[0]
    named = [f"{s.grade.submission} ({s.points})" for s in graded]
    return replace(
        graded[0],
        undecided=f"{graded[0].called} is in {' and '.join(named)}: left out, "
        "until cartlab remove takes the wrong one off",
    )


def students_of(
    entries: Sequence[Entry], *, platform: Platform
) -> tuple[list[Student], list[Remark]]:
    """Return every student once, and what to say about it."""
    found: dict[str, list[Student]] = {}
    for entry in entries:
        for student in _students(entry, platform=platform):
            # Nobody's id stands for a number, or for who is not named at all.
            nameless = student.number if student.uploader else entry.submission
            found.setdefault(person(student.id) or f"\0{nameless}", []).append(student)
    students = [one_of(several) for several in found.values()]
    remarks = [Remark(text=s.undecided, left_out=True) for s in students if s.undecided]
    strangers = [s for s in students if not (s.id or s.name or s.number)]
    if nobodys := [s for s in strangers if not s.by_hand]:
        remarks.append(not_exported("nobody is named in it", nobodys))
    if by_hand := [s.grade.submission for s in strangers if s.by_hand]:
        folders = f"so exported as who its folder is called: {', '.join(by_hand)}"
        remarks.append(Remark(text=f"nobody is named in it, {folders}"))
    students = [
        replace(s, name=s.grade.submission) if s in strangers else s
        for s in students
        if s.by_hand or s not in strangers
    ]
    blank = dict.fromkeys(s.grade.submission for s in students if not (s.points or s.undecided))
    if blank:
        where = _GRADESCOPE_BLANK if platform == "gradescope" else "left blank"
        remarks.append(Remark(text=f"could not be graded, {where}: {', '.join(blank)}"))
    return students, remarks


def not_exported(why: str, students: Sequence[Student]) -> Remark:
    """Return who is in no row of a table, and why."""
    called = ", ".join(student.called for student in students)
    lost = any(student.points or student.undecided for student in students)
    return Remark(text=f"{why}, so not exported: {called}", left_out=lost)


def _students(entry: Entry, *, platform: Platform) -> list[Student]:
    """Return the authors of a submission, and who handed it in where it may be none of them.

    Where nobody can be read in it, those it named before it was given points by hand.
    """
    name, of, number = read_owner(entry.owner)
    number = number if of in ("", platform) else ""
    given = [author for o in entry.overrides.values() for author in o.authors]
    authors = entry.grade.authors or tuple(dict.fromkeys(given)) or ("",)
    by_hand = frozenset(entry.overrides)
    own = Student(id="", name=name, number=number, grade=entry.grade, by_hand=by_hand)
    if len(authors) == 1:
        return [replace(own, id=authors[0])]
    named = [replace(own, id=author, name="", number="") for author in authors]
    # Moodle's and Gradescope's numbers of a team's hand-in are not a student's.
    return [*named, replace(own, uploader=True)] if number and platform == "canvas" else named
