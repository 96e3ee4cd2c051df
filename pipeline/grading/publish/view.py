"""A grade as one audience may read it.

Every page, table and file for people uses this view. In a lab where students find the numbers
themselves (`see = "check"`), the team reads outcomes, points, the titles of flags, and what a
person wrote, but no computed number.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from pipeline.grading.grade import Code, Criterion, Flag, Grade
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.publish.pseudonyms import anonymise
from pipeline.grading.rubric import Rubric, find_remarks
from pipeline.grading.similarity.shared_flag import student_message
from pipeline.grading.words import WORDS, person_lines, points_text
from pipeline.words.numbers import listing
from pipeline.words.text import with_symbols

Audience = Literal["team", "staff"]
See = Literal["report", "check"]
_WITHOUT_NUMBERS: tuple[Code, ...] = ("missing", "shared_data")  # flags whose text has no numbers


@dataclass(frozen=True, kw_only=True)
class GradeView:
    """A grade as one audience may read it.

    Attributes
    ----------
    grade : the grade, with the names that the audience may read.
    hides_numbers : whether to leave out all computed numbers.
    comments : what a person wrote about a criterion without giving points, by criterion.
    held : titles of the criteria that are held back; the rubric and the grade do not have them.
    """

    grade: Grade
    rubric: Rubric
    hides_numbers: bool = False
    comments: Mapping[str, str] = field(default_factory=dict)
    held: tuple[str, ...] = ()

    @property
    def is_by_hand(self) -> bool:
        """Whether a person gave points or changed the total."""
        return bool(self.grade.by_hand)

    @property
    def notes(self) -> tuple[str, ...]:
        """The notes of the grader."""
        return () if self.hides_numbers else self.grade.notes

    def flag_text(self, flag: Flag) -> str:
        """Return the text of a flag for students, without the name of another team; or ""."""
        hidden = self.hides_numbers and flag.code not in _WITHOUT_NUMBERS
        return "" if hidden else student_message(flag)

    def flag_lines(self) -> list[str]:
        """Return the texts of all flags."""
        return [with_symbols(text) for text in map(self.flag_text, self.grade.flags) if text]

    def reasons(self, judged: Criterion) -> list[str]:
        """Return why a criterion has its points.

        Without numbers, these are the titles of its flags, and what a person wrote.
        """
        if not self.hides_numbers:
            return [judged.message]
        asked = (one for one in self.rubric.criteria if one.id == judged.id)
        flags = [flag for one in asked for flag in find_remarks(self.grade, one, self.rubric)]
        titles = [WORDS.text(f"title_{flag.code}") for flag in flags]
        given = {one.criterion: one.why for one in self.grade.overrides}
        why = {**self.comments, **given}.get(judged.id, "")
        return [*dict.fromkeys(titles), *([why] if why else [])]

    def total_lines(self) -> list[str]:
        """Return the sentences about the total: lateness, adjustments, and what is not final."""
        off = self.grade.deducted
        late = [f"Late: {points_text(off)} points off."] if off else []
        return [*late, *self.person_lines()]

    def person_lines(self) -> list[str]:
        """Return what people changed, have yet to grade, and hold back."""
        back = [f"Held back, so not in these points: {listing(self.held)}."] if self.held else []
        return [*person_lines(self.grade), *back]


def view(
    entry: Entry,
    audience: Audience,
    *,
    names: Mapping[str, str] | None = None,
    see: See | None = None,
) -> GradeView:
    """Return what an audience may read of a grade.

    Parameters
    ----------
    audience : a team reads its own grade; it never reads the name of another team in an anonymous
        class, and no computed number in a lab where students find them. The staff reads all.
    names : pseudonyms by submission, for a staff that may not read names; None to show names.
    see : what this reader may see; default: what the rubric lets students see.
    """
    rubric, grade = entry.rubric, entry.grade
    comments = {id_: own.text for id_, own in entry.comments.items()}
    held = tuple(asked.title or asked.id for asked in entry.held)
    if audience == "staff":
        grade = grade if names is None else anonymise(grade, names)
        return GradeView(grade=grade, rubric=rubric, comments=comments, held=held)
    if rubric.anonymous:
        grade = anonymise(grade, {entry.submission: entry.submission})
    return replace(new_view(grade, rubric, comments=comments, see=see), held=held)


def new_view(
    grade: Grade, rubric: Rubric, *, comments: Mapping[str, str] = {}, see: See | None = None
) -> GradeView:
    """Return what a team may read of a grade that may be in no gradebook yet; see `view`."""
    hides_numbers = (see or rubric.students.see) == "check"
    return GradeView(grade=grade, rubric=rubric, hides_numbers=hides_numbers, comments=comments)
