"""The students of a class list, each with a grade."""

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.grading.feedback_words import points_text
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook_rows import Entry
from pipeline.grading.lms_names import Platform, read_owner

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
    """

    id: str
    name: str
    number: str
    grade: Grade
    by_hand: bool
    uploader: bool = False

    @property
    def points(self) -> str:
        """The points, "" where nobody has graded it yet: a zero would say that somebody had."""
        ungraded = self.grade.status == "failed" and not self.by_hand
        return "" if ungraded else points_text(self.grade.points)

    @property
    def rank(self) -> tuple[bool, float]:
        """What is larger for the better of two grades: any is better than none."""
        return bool(self.points), self.grade.points

    @property
    def called(self) -> str:
        """What to call the student in a message."""
        return self.id or self.name or self.grade.submission


def students_of(entries: Sequence[Entry], *, platform: Platform) -> tuple[list[Student], list[str]]:
    """Return every student once, and what to say about it."""
    found: dict[str, Student] = {}
    twice: dict[str, list[str]] = {}
    for entry in entries:
        name, of, number = read_owner(entry.owner)
        authors = entry.grade.authors
        alone = len(authors) < 2  # of several, which one handed it in is not said
        number = number if of in ("", platform) else ""
        by_hand = bool(entry.overrides)
        own = [
            Student(
                id=id_,
                name=name if alone else "",
                number=number if alone else "",
                grade=entry.grade,
                by_hand=by_hand,
            )
            for id_ in authors or ("",)
        ]
        # Moodle's and Gradescope's numbers of a team's hand-in are not a student's.
        if not alone and number and platform == "canvas":
            own.append(
                Student(
                    id="",
                    name=name,
                    number=number,
                    grade=entry.grade,
                    by_hand=by_hand,
                    uploader=True,
                )
            )
        for student in own:
            # Nobody's id stands for a number, or for who is not named at all.
            nameless = student.number if student.uploader else entry.submission
            key = student.id or f"\0{nameless}"
            if key in found:
                names = twice.setdefault(student.called, [found[key].grade.submission])
                names.append(entry.submission)
                if found[key].rank >= student.rank:
                    continue
            found[key] = student
    remarks = [
        f"{id_} is in {' and '.join(names)}: the higher points are exported"
        for id_, names in twice.items()
    ]
    nameless = [key for key, s in found.items() if not (s.id or s.name or s.number)]
    if nameless:
        teams = ", ".join(found.pop(key).grade.submission for key in nameless)
        remarks.append(f"nobody is named in it, so not exported: {teams}")
    blank = dict.fromkeys(s.grade.submission for s in found.values() if not s.points)
    if blank:
        where = _GRADESCOPE_BLANK if platform == "gradescope" else "left blank"
        remarks.append(f"could not be graded, {where}: {', '.join(blank)}")
    return list(found.values()), remarks
