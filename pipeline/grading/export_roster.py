"""The table of students that a learning platform exports, with grades filled in."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.export_students import Student
from pipeline.grading.lms_names import Platform
from pipeline.grading.table import read_table
from pipeline.output import csv_text

POINTS_POSSIBLE = "Points Possible"  # Canvas' row on top, about the assignments
# Columns that say who a row is about.
_NUMBERS = ("ID", "Identifier", "Submission ID")
_IDS = ("SIS User ID", "SIS Login ID", "ID number", "SID", "Username", "Email", "Email address")
_NAMES = ("Student", "Full name", "Name")
# What a platform's own table has for certain, any of these; no other platform's has it.
_OWN: Mapping[Platform, tuple[frozenset[str], ...]] = {
    "canvas": (frozenset({"Student", "ID"}),),
    "moodle": (
        frozenset({"Identifier"}),
        frozenset({"ID number"}),
        frozenset({"Username"}),
        frozenset({"Email address"}),
    ),
    "gradescope": (frozenset({"SID"}), frozenset({"Email"}), frozenset({"Submission ID"})),
}
_PARTICIPANT = re.compile(r"\D+ (\d+)")  # of Moodle, in any language
_TITLE = re.compile(r"(.*?)(?: \(\d+\))?")  # of Canvas, with the assignment's id behind it


@dataclass(frozen=True, kw_only=True)
class Roster:
    """A platform's own table; cells that are not filled in stay as they are."""

    file: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @classmethod
    def read(cls, path: Path, *, platform: Platform) -> "Roster":
        """Read a platform's roster: CSV with commas, semicolons or tabs.

        Raises
        ------
        ConfigError : it is no table, or has not the columns that say who a row is about there.
        """
        lines = [row for _, row in read_table(path)]
        head = tuple(name.strip() for name in lines[0]) if lines else ()
        if not any(columns <= set(head) for columns in _OWN[platform]):
            wanted = ", or ".join(" and ".join(sorted(columns)) for columns in _OWN[platform])
            raise ConfigError(
                f"{path.name}: is not {platform.capitalize()}'s table; "
                f"that has the columns {wanted}"
            )
        rows = tuple(tuple((*row, *[""] * len(head))[: len(head)]) for row in lines[1:])
        return cls(file=path.name, head=head, rows=rows)

    def filled(
        self,
        students: Sequence[Student],
        columns: Mapping[str, Callable[[Student], str]],
        *,
        keep: Collection[str] | None = None,
        possible: str = "",
    ) -> tuple[str, list[str]]:
        """Return the table with these columns filled in, and what did not fit.

        Parameters
        ----------
        columns : by title; one that is not there yet comes last.
        keep : the columns to keep beside them, default: all.
        possible : the points possible, for Canvas' row of them.
        """
        titles = {title: self._title(title) for title in columns}
        kept = [name for name in self.head if keep is None or name in keep]
        head = [*kept, *(name for name in titles.values() if name not in kept)]
        table = [dict(zip(self.head, row, strict=True)) for row in self.rows]
        for row in table:
            if POINTS_POSSIBLE in row.get("Student", ""):
                row |= {name: row.get(name) or possible for name in titles.values()}
        index = self._index()
        strangers = []
        best: dict[int, Student] = {}
        for student in students:
            at = _row_of(student, index)
            if at is None:
                if not student.uploader:  # one of the authors, who are named
                    strangers.append(student.called)
            elif at not in best or student.rank > best[at].rank:
                best[at] = student
        for at, student in best.items():
            for title, value in columns.items():
                table[at][titles[title]] = value(student)
        remarks = []
        if strangers:
            remarks.append(f"not in {self.file}, so not exported: {', '.join(strangers)}")
        reached = {student.grade.submission for student in best.values()}
        lost = dict.fromkeys(
            s.grade.submission
            for s in students
            if len(s.grade.authors) > 1 and s.grade.submission not in reached
        )
        if lost:
            remarks.append(f"nobody of these is in {self.file}: {', '.join(lost)}")
        by_number = [f"{s.name} ({s.grade.submission})" for s in best.values() if s.uploader]
        if by_number:
            remarks.append(
                "found by the number in the file's name, so the same person as one of the "
                f"authors: {', '.join(by_number)}"
            )
        text = csv_text(head, [[row.get(name, "") for name in head] for row in table])
        return text, remarks

    def _title(self, title: str) -> str:
        """Return a column's title as the table has it."""
        for name in self.head:
            found = _TITLE.fullmatch(name)
            if name == title or (found and found[1] == title):
                return name
        return title

    def _index(self) -> dict[tuple[str, str], int | None]:
        """Return the row of everything that says who it is about; None where two rows share it."""
        index: dict[tuple[str, str], int | None] = {}
        for at, row in enumerate(self.rows):
            words = set()
            for name, value in zip(self.head, row, strict=True):
                if name in _NUMBERS:
                    found = _PARTICIPANT.fullmatch(value)
                    words.add(("number", found[1] if found else value))
                if name in _IDS or name == "ID":
                    words |= {("id", value.casefold()), ("id", value.casefold().split("@")[0])}
                if name in _NAMES:
                    words.add(("name", _letters(value)))
            for word in words:
                if word[1]:
                    index[word] = None if word in index else at
        return index


def _row_of(student: Student, index: Mapping[tuple[str, str], int | None]) -> int | None:
    for word in (
        ("number", student.number),
        ("id", student.id.casefold()),
        ("name", _letters(student.name)),
    ):
        at = index.get(word)
        if at is not None:
            return at
    return None


def _letters(name: str) -> str:
    """Return a name as Canvas has it in names of files: "Doe, Jane" is "doejane"."""
    return "".join(c for c in name.casefold() if c.isalnum())
