"""The students of a class list, each with one grade."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.entry import Entry
from pipeline.grading.gradebook.events import TOTAL
from pipeline.grading.gradings import person
from pipeline.grading.intake.lms_names import Platform, read_owner
from pipeline.grading.words import points_text

# Gradescope's specification of the score in `results.json`: "optional, but required if not on each
# test case".
_GRADESCOPE_NEEDS = " in gradescope.csv, but 0 in results.json, where a score is required"


@dataclass(frozen=True, kw_only=True)
class Student:
    """One student's grade.

    Attributes
    ----------
    id : id of the author in the submission; or "".
    name, number : name and number of the account that submitted, on the platform for which grades
        are exported; or "".
    uploader : whether this entry is the account that submitted; it belongs to one of several
        authors, but it is unknown to which.
    undecided : message that names the submissions, if the student is in several with different
        points.
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
        """The points as text.

        Empty if the submission was not graded, because a zero would look like a grade. Also empty
        if a person must decide which of several submissions counts.
        """
        ungraded = self.grade.status == "failed" and not self.by_hand
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
    entries: Sequence[Entry], *, platform: Platform, blank: bool = True
) -> tuple[list[Student], list[Remark]]:
    """Return every student once, and remarks on students whose grade or name is unclear.

    Parameters
    ----------
    blank : whether a student without a grade gets an empty cell; False if the platform's own table
        is filled in, which keeps its cell.
    """
    found: dict[str, list[Student]] = {}
    for entry in entries:
        for student in _students(entry, platform=platform):
            # Two students without an id are not the same student.
            nameless = student.number if student.uploader else entry.submission
            found.setdefault(person(student.id) or f"\0{nameless}", []).append(student)
    students = [one_of(several) for several in found.values()]
    remarks = [Remark(text=s.undecided, left_out=True) for s in students if s.undecided]
    strangers = [s for s in students if not (s.id or s.name or s.number)]
    if nobodys := [s for s in strangers if not (s.by_hand or s.grade.unsettled)]:
        remarks.append(not_exported("it names no author", nobodys))
    if unread := [s for s in strangers if s.grade.awaits_grading]:
        remarks.append(not_exported("its authors could not be read yet", unread))
    if by_hand := [s.grade.submission for s in strangers if s.by_hand]:
        folders = f"so exported under the name of its folder: {', '.join(by_hand)}"
        remarks.append(Remark(text=f"it names no author, {folders}"))
    students = [
        replace(s, name=s.grade.submission) if s in strangers else s
        for s in students
        if s.by_hand or s not in strangers
    ]
    ungraded = dict.fromkeys(s.grade.submission for s in students if not (s.points or s.undecided))
    if ungraded:
        left = "left blank" if blank else "left as it was"
        where = f"{left}{_GRADESCOPE_NEEDS if platform == 'gradescope' else ''}"
        remarks.append(Remark(text=f"could not be graded, {where}: {', '.join(ungraded)}"))
    return students, remarks


def not_exported(why: str, students: Sequence[Student]) -> Remark:
    """Return a remark that names students who are missing from a table, with the reason."""
    called = ", ".join(student.called for student in students)
    lost = any(student.points or student.undecided for student in students)
    return Remark(text=f"{why}, so not exported: {called}", left_out=lost)


def _students(entry: Entry, *, platform: Platform) -> list[Student]:
    """Return the authors of a submission.

    On Canvas, the account that submitted is added if there are several authors. If a submission
    names no authors, the authors stored with its points given by hand are used.
    """
    name, of, number = read_owner(entry.owner)
    number = number if of in ("", platform) else ""
    given = [
        author for o in (*entry.overrides.values(), *entry.adjustments) for author in o.authors
    ]
    authors = entry.grade.authors or tuple(dict.fromkeys(given)) or ("",)
    by_hand = frozenset(entry.overrides) | ({TOTAL} if entry.adjustments else set())
    own = Student(id="", name=name, number=number, grade=entry.grade, by_hand=by_hand)
    if len(authors) == 1:
        return [replace(own, id=authors[0])]
    named = [replace(own, id=author, name="", number="") for author in authors]
    # Only Canvas' number belongs to a student; those of Moodle and Gradescope belong to the team's
    # upload.
    return [*named, replace(own, uploader=True)] if number and platform == "canvas" else named
