"""Fill grades into the table of students (roster) that a learning platform exports."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigError
from pipeline.grading.csv_table import read_table
from pipeline.grading.gradings import person
from pipeline.grading.intake.lms_names import Platform
from pipeline.grading.publish.platforms import FORMS
from pipeline.grading.publish.students import Remark, Student, not_exported, one_of
from pipeline.output import csv_text
from pipeline.submission.toml import quote
from pipeline.words.numbers import first_few

if TYPE_CHECKING:
    import pandas as pd

POINTS_POSSIBLE = "Points Possible"  # marks the first row of Canvas, which is about the assignments
_MAXIMUM = "Maximum Grade"  # column of Moodle, whose import refuses a higher grade
# Columns that identify the student of a row: by number, by id, by name.
_NUMBERS = ("ID", "Identifier", "Submission ID")
_IDS = ("SIS User ID", "SIS Login ID", "ID number", "SID", "Username", "Email", "Email address")
_NAMES = ("Student", "Full name", "Name")
# A participant of Moodle in any language, such as "Participant 1024" or "Teilnehmer/in1024".
_PARTICIPANT = re.compile(r"^(\D+)(\d+)$")
_ID = re.compile(r"(?=.*\d)\S+")  # an id number: no spaces, and at least one digit
# A title in Canvas, perhaps followed by the assignment's id.
_TITLE = re.compile(r"(.*?)(?: \(\d+\))?")


@dataclass(frozen=True, kw_only=True, eq=False)
class Roster:
    """The table that a platform exports; all cells are texts.

    Attributes
    ----------
    headings : the table's own headings by Moodle's English ones, if the table is in another
        language.
    """

    file: str
    table: "pd.DataFrame"
    headings: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path, *, platform: Platform) -> "Roster":
        """Read a platform's roster: CSV with commas, semicolons or tabs.

        Raises
        ------
        ConfigError : the file is not a table, lacks the columns that identify a student, or has two
            columns of the same name.
        """
        table = read_table(path)
        known = any(columns <= set(table.columns) for columns in FORMS[platform].own)
        headings = _moodle_headings(table) if platform == "moodle" else {}
        headings = {name: own for name, own in headings.items() if name not in table}
        if not known and not headings:
            wanted = ", or ".join(" and ".join(sorted(columns)) for columns in FORMS[platform].own)
            raise ConfigError(
                f"{path.name}: is not {platform.capitalize()}'s table; "
                f"that has the columns {wanted}"
            )
        twice = table.columns[table.columns.duplicated() & (table.columns != "")]
        if len(twice):
            raise ConfigError(f"{path.name}: has two columns {quote(twice[0])}")
        return cls(file=path.name, table=table, headings=headings)

    def has(self, name: str) -> bool:
        """Return whether the table has a column, given by its English heading."""
        return self.headings.get(name, name) in self.table

    def check_maximum(self, out_of: float, *, title: str) -> None:
        """Refuse a table with a different maximum grade; importing it would not change the maximum.

        Raises
        ------
        ConfigError : Moodle's column or Canvas' row of possible points has a different maximum.
        """
        column = self._title(title)
        maximum = self.headings.get(_MAXIMUM, _MAXIMUM)
        stated = [*self.table[maximum].unique()] if maximum in self.table else []
        if column in self.table:
            stated += [*self.table.loc[self._of_all(), column]]
        for text in stated:
            if (most := _number(text)) is not None and most != out_of:
                raise ConfigError(
                    f"{self.file}: has the maximum grade {text}, the rubric {out_of:g}: "
                    "set the assignment's maximum on the platform and download the table again"
                )

    def fill(
        self,
        students: Sequence[Student],
        columns: Mapping[str, Callable[[Student], str]],
        *,
        keep: Collection[str] | None = None,
        possible: str = "",
    ) -> tuple[str, list[Remark]]:
        """Return the table with grades filled in, and remarks on mismatches; other cells stay.

        A student without points keeps the cells of the table; only empty ones are filled.

        Parameters
        ----------
        columns : for each column title, the function that gives a student's value, the points
            first; a missing column is added at the end.
        keep : other columns to keep; default: all.
        possible : the maximum points, for Canvas' first row.
        """
        titles = {title: self._title(title) for title in columns}
        kept = [name in (keep or self.table.columns) for name in self.table.columns]
        table = self.table.loc[:, kept].copy()
        for name in titles.values():
            if name not in table:
                table[name] = self.table.get(name, "")
            table.loc[self._of_all() & (table[name] == ""), name] = possible
        index, _ = self._index
        matched = [(_row_of(student, index), student) for student in students]
        found: dict[Any, list[Student]] = {}
        for at, student in matched:
            if at is not None:
                found.setdefault(at, []).append(student)
        settled = {at: one_of(several) for at, several in found.items()}
        filled = {at: student for at, student in settled.items() if not student.undecided}
        points = titles[next(iter(columns))]
        before = table[points].copy()
        for at, student in filled.items():
            for title, value in columns.items():
                if student.points or not table.loc[at, titles[title]].strip():
                    table.loc[at, titles[title]] = value(student)
        graded = [at for at, student in filled.items() if student.points]
        replaced = {
            at: f"{old} → {table.loc[at, points]}"
            for at, old in before[graded].items()
            if old.strip()
            and old.strip() != table.loc[at, points]
            and _number(old) != _number(table.loc[at, points])
        }
        remarks = self._name_rows(f"replaced in {self.file}", replaced)
        remarks += self._remarks(students, matched, found, settled)
        remarks += self._kept(table[points].drop(index=graded))
        return csv_text([*table.columns], table.itertuples(index=False)), remarks

    def _remarks(
        self,
        students: Sequence[Student],
        matched: Sequence[tuple[Any, Student]],
        found: Mapping[Any, Sequence[Student]],
        settled: Mapping[Any, Student],
    ) -> list[Remark]:
        """Return remarks on students without a row, rows without a student, and similar mismatches.

        Parameters
        ----------
        matched : each student with the row found, or None.
        found : for each row, the students that match it.
        settled : for each row, the student whose grade is filled in.
        """
        index, shared = self._index
        # An account without a row is no problem: it belongs to one of the authors, who have their
        # own rows.
        unmatched = [student for at, student in matched if at is None and not student.uploader]
        twice = [s for s in unmatched if not shared.isdisjoint(_words(s))]
        strangers = [s for s in unmatched if s not in twice]
        open_ = [s.undecided for s in settled.values() if s.undecided and s not in students]
        remarks = [Remark(text=text, left_out=True) for text in open_]
        passed_over = [
            s
            for at, s in matched
            if at is not None and s.points and index.get(_id_of(s), at) not in found
        ]
        if passed_over:
            named = ", ".join(f"{s.called} ({s.grade.submission})" for s in passed_over)
            remarks.append(
                Remark(
                    text="given no points, because another account submitted and received them: "
                    f"{named}",
                    left_out=True,
                )
            )
        if twice:
            remarks.append(not_exported(f"in several rows of {self.file}", twice))
        if strangers:
            remarks.append(not_exported(f"not in {self.file}", strangers))
        reached = {student.grade.submission for several in found.values() for student in several}
        lost = dict.fromkeys(
            s.grade.submission
            for s in students
            if len(s.grade.authors) > 1 and s.grade.submission not in reached
        )
        if lost:
            remarks.append(Remark(text=f"none of these is in {self.file}: {', '.join(lost)}"))
        by_number = [
            f"{s.name} ({s.grade.submission})"
            for s in settled.values()
            if s.uploader and not s.undecided
        ]
        if by_number:
            remarks.append(
                Remark(
                    text="matched by the number in the file name, and therefore taken to be one of "
                    f"the authors: {', '.join(by_number)}"
                )
            )
        return remarks

    def _kept(self, grades: "pd.Series") -> list[Remark]:
        """Return a remark on grades that only the table has.

        Parameters
        ----------
        grades : the column of grades, without the rows that cartlab filled in.
        """
        of_all = set(self.table.index[self._of_all()])
        kept = {at: text for at, text in grades.items() if text.strip() and at not in of_all}
        return self._name_rows(f"no grade from cartlab, so {self.file} keeps its own", kept)

    def _name_rows(self, what: str, grades: Mapping[Any, str]) -> list[Remark]:
        """Return a remark on grades in the table, with the names in their rows."""
        if not grades:
            return []
        column = next((name for name, role in self._roles() if role in _NAMES), None)
        called = self.table.iloc[:, 0] if column is None else self.table[column]
        named = first_few([f"{called[at]} ({text})" for at, text in grades.items()], 8)
        return [Remark(text=f"{what}: {named}")]

    def _roles(self) -> Iterable[tuple[Any, Any]]:
        """Yield each column and its heading in English, as far as known."""
        english = {own: name for name, own in self.headings.items()}
        return ((name, english.get(name, name)) for name in self.table.columns)

    def _of_all(self) -> "pd.Series":
        """Return a mask of the rows that are about assignments, not about a student."""
        # There may be several columns without a name, and the first column may be one.
        students = self.table["Student"] if "Student" in self.table else self.table.iloc[:, 0]
        return students.str.contains(POINTS_POSSIBLE, regex=False)

    def _title(self, title: str) -> str:
        if title in self.headings:
            return self.headings[title]
        for name in self.table.columns:
            found = _TITLE.fullmatch(str(name))
            if name == title or (found and found[1] == title):
                return name
        return title

    @cached_property
    def _index(self) -> tuple[dict[tuple[str, str], Any], set[Any]]:
        """Return the row of each identifying text, and the texts that are in several rows."""
        import pandas as pd

        words = []
        for name, role in self._roles():
            cells = self.table[name].map(person)
            if role in _NUMBERS:
                words.append(("number", cells.str.replace(_PARTICIPANT, r"\2", regex=True)))
            if role in _IDS or role == "ID":
                words += [("id", cells), ("id", cells.str.split("@").str[0])]
            if role in _NAMES:
                words.append(("name", cells.map(_letters)))
        found = pd.concat(
            pd.DataFrame({"kind": kind, "word": cells, "row": cells.index}) for kind, cells in words
        )
        rows = found[found["word"] != ""].drop_duplicates().set_index(["kind", "word"])["row"]
        several = rows.index.duplicated(keep=False)
        return rows.loc[~several].to_dict(), set(rows.index[several].tolist())


def _row_of(student: Student, index: Mapping[tuple[str, str], Any]) -> Any:
    return next((index[word] for word in _words(student) if word in index), None)


def _words(student: Student) -> tuple[tuple[str, str], ...]:
    """Return the texts by which the row of a student can be found, the most reliable first."""
    return (
        ("number", student.number),
        _id_of(student),
        ("name", _letters(student.name)),
    )


def _id_of(student: Student) -> tuple[str, str]:
    return "id", person(student.id)


def _number(text: str) -> float | None:
    """Read a number from a platform's table, also with a decimal comma; None for other text."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return None


def _letters(name: str) -> str:
    """Return a name as Canvas writes it in file names: "Doe, Jane" becomes "doejane"."""
    return "".join(c for c in person(name) if c.isalnum())


def _moodle_headings(table: "pd.DataFrame") -> dict[str, str]:
    """Return the headings of a table of Moodle in another language, by the English ones.

    Moodle translates the headings, but their order is always the same: participant, name, columns
    such as id number and email address, status, grade, maximum grade, and last the comment. A table
    from the gradebook is known by the email addresses. Empty if the table is neither.
    """
    cells = [[text.strip() for text in table.iloc[:, i]] for i in range(table.shape[1])]
    if not any(cells):
        return {}
    roles: dict[str, int] = {}
    first = next((i for i, column in enumerate(cells) if _participants(column)), len(cells))
    for i in range(first + 2, len(cells)):
        most = {_number(text) for text in cells[i]}
        if i - 1 > first + 1 and len(most) == 1 and None not in most:
            roles |= {"Identifier": first, "Grade": i - 1, _MAXIMUM: i}
    if roles:
        roles["Full name"] = first + 1
    last = len(cells) - 1
    if last > roles.get(_MAXIMUM, last) and "-" not in cells[last]:
        roles["Feedback comments"] = last
    end = roles.get("Grade", len(cells))
    for i, column in enumerate(cells[:end]):
        given = [text for text in column if text]
        if i in roles.values() or not given or len(set(given)) < len(given):
            continue
        if all("@" in text for text in given):
            roles.setdefault("Email address", i)
        elif "Email address" not in roles and all(_ID.fullmatch(text) for text in given):
            roles.setdefault("ID number", i)
    if "Identifier" not in roles and "Email address" not in roles:
        return {}
    return {name: str(table.columns[i]) for name, i in roles.items()}


def _participants(column: Sequence[str]) -> bool:
    """Return whether a column has Moodle's participants: one word and a different number each."""
    found = [_PARTICIPANT.fullmatch(text) for text in column]
    if not all(found):
        return False
    words, numbers = zip(*(one.groups() for one in found if one), strict=True)
    return len(set(words)) == 1 and len(set(numbers)) == len(numbers)
