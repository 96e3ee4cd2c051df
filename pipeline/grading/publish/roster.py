"""The students of a class list with one grade each, and a platform's table of students (roster)."""

import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.errors import ConfigError
from pipeline.grading.csv_table import read_table
from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.gradings import person
from pipeline.grading.platforms import Account, Platform, bare_number, read_number
from pipeline.grading.publish.view import GradeView, view
from pipeline.grading.words import points_text
from pipeline.output import csv_text
from pipeline.submission.toml import quote
from pipeline.words.numbers import first_few

if TYPE_CHECKING:
    import pandas as pd


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
    what: str, names: Iterable[str], *, most: int = sys.maxsize, left_out: bool = False
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


# A title in Canvas, perhaps followed by the assignment's id.
_TITLE = re.compile(r"(.*?)(?: \(\d+\))?")


@dataclass(frozen=True, kw_only=True, eq=False)
class Roster:
    """The table that a platform exports; all cells are texts.

    Attributes
    ----------
    headings : the table's own headings by the English ones, if the table is in another language.
    """

    platform: Platform
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
        keys = platform.needed or (*platform.numbers, *platform.ids)
        known = (all if platform.needed else any)(name in table for name in keys)
        headings = platform.headings(table)
        headings = {name: own for name, own in headings.items() if name not in table}
        if not known and not headings:
            wanted = (" and " if platform.needed else ", or ").join(keys)
            raise ConfigError(
                f"{path.name}: is not {platform.title}'s table; that has the columns {wanted}"
            )
        twice = table.columns[table.columns.duplicated() & (table.columns != "")]
        if len(twice):
            raise ConfigError(f"{path.name}: has two columns {quote(twice[0])}")
        return cls(platform=platform, file=path.name, table=table, headings=headings)

    def has(self, name: str) -> bool:
        """Return whether the table has a column, given by its English heading."""
        return self.headings.get(name, name) in self.table

    def check_maximum(self, out_of: float, *, title: str) -> None:
        """Refuse a table with a different maximum grade; importing it would not change the maximum.

        Raises
        ------
        ConfigError : the column or the row of maximum grades has a different maximum.
        """
        column = self._title(title)
        maximum = self.platform.maximum
        stated = []
        if maximum and self.has(maximum):
            stated += [*self.table[self.headings.get(maximum, maximum)].unique()]
        if column in self.table:
            stated += [*self.table.loc[self._of_all(), column]]
        for text in stated:
            if (most := read_number(text)) is not None and most != out_of:
                raise ConfigError(
                    f"{self.file}: has the maximum grade {text}, the rubric {out_of:g}: "
                    "set the assignment's maximum on the platform and download the table again"
                )

    def identify(self, students: Sequence[Student]) -> list[Student]:
        """Return the students with the number and the name in their row, if they have a row.

        A number counts only if the name does not contradict it: the number of a group's download is
        no number of a student.
        """
        index, _ = self._index
        cells = {role: self.table[name].str.strip() for name, role in self._roles()}
        number, name = cells.get(self.platform.numbers[0]), cells.get(self.platform.names[0])

        def identified(student: Student) -> Student:
            at = index.get(("number", student.number))
            if name is not None and at is not None and student.name:
                at = at if _letters(name[at]) == _letters(student.name) else None
            at = _row_of(replace(student, number=""), index) if at is None else at
            if at is None or number is None:
                return replace(student, number="")
            shown = student.name if name is None else name[at]
            return replace(student, number=bare_number(number[at]), name=shown)

        return list(map(identified, students))

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
        possible : the maximum points, for the row about the assignments.
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
            and read_number(old) != read_number(table.loc[at, points])
        }
        remarks = self._name_rows(f"replaced in {self.file}", replaced)
        remarks += self._remarks(students, matched, found, settled)
        of_all = set(table.index[self._of_all()])
        own = table[points].drop(index=graded).items()
        kept = {at: text for at, text in own if text.strip() and at not in of_all}
        remarks += self._name_rows(f"no grade from cartlab, so {self.file} keeps its own", kept)
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
        remarks += about(
            "given no points, because another account submitted and received them",
            (f"{s.called} ({s.grade.submission})" for s in passed_over),
            left_out=True,
        )
        remarks += not_exported(f"in several rows of {self.file}", twice)
        remarks += not_exported(f"not in {self.file}", strangers)
        reached = {student.grade.submission for several in found.values() for student in several}
        teams = (s.grade.submission for s in students if len(s.team) > 1)
        lost = (name for name in teams if name not in reached)
        remarks += about(f"none of these is in {self.file}", lost)
        by_number = (s for s in settled.values() if s.uploader and not s.undecided)
        return remarks + about(
            "matched by the number in the file name, and therefore taken to be one of the authors",
            (f"{s.name} ({s.grade.submission})" for s in by_number),
        )

    def _name_rows(self, what: str, grades: Mapping[Any, str]) -> list[Remark]:
        """Return a remark on grades in the table, with the names in their rows."""
        column = next((name for name, role in self._roles() if role in self.platform.names), None)
        called = self.table.iloc[:, 0] if column is None else self.table[column]
        return about(what, (f"{called[at]} ({text})" for at, text in grades.items()), most=8)

    def _roles(self) -> Iterable[tuple[Any, Any]]:
        """Yield each column and its heading in English, as far as known."""
        english = {own: name for name, own in self.headings.items()}
        return ((name, english.get(name, name)) for name in self.table.columns)

    def _of_all(self) -> "pd.Series":
        """Return a mask of the rows that are about assignments, not about a student."""
        # There may be several columns without a name, and the first column may be one.
        students = self.table["Student"] if "Student" in self.table else self.table.iloc[:, 0]
        maxima = self.platform.maxima
        return students.str.contains(maxima, regex=False) & bool(maxima)

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
            if role in self.platform.numbers:
                words.append(("number", cells.map(bare_number)))
            if role in self.platform.ids:
                words += [("id", cells), ("id", cells.str.split("@").str[0])]
            if role in self.platform.names:
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


def _letters(name: str) -> str:
    """Return a name as Canvas writes it in file names: "Doe, Jane" becomes "doejane"."""
    return "".join(c for c in person(name) if c.isalnum())
