"""Export class grades in the formats of Canvas, Moodle and Gradescope.

Each format is a table with a row for every student. If the platform's own exported table (a roster)
is given, its rows and columns stay and only the grades are filled in.

- Canvas: the CSV of its gradebook, read by `lib/gradebook_importer.rb`. It finds students by `ID`,
  `SIS User ID` or `SIS Login ID`. It finds the assignment by its title, which may be followed by
  its id in brackets.
- Moodle: the offline grading worksheet of one assignment (`mod/assign/feedback/offline`), if the
  participant numbers are known; otherwise the table for *Import CSV* of its gradebook.
- Gradescope: the table of its *Download Grades*, and a `results.json` for each submission, as an
  autograder writes it.
"""

import html
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.entry import Entry
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.intake.lms_names import Platform
from pipeline.grading.publish.gradescope import flag_messages, results_text
from pipeline.grading.publish.platforms import FORMS, WORKSHEET
from pipeline.grading.publish.roster import POINTS_POSSIBLE, Roster
from pipeline.grading.publish.students import Remark, Student, students_of
from pipeline.grading.rubric import Rubric
from pipeline.grading.words import on_one_line, person_lines, points_text, waiting_text
from pipeline.output import csv_text, named_folder, own_folder, write_file
from pipeline.words.numbers import first_few
from pipeline.words.text import with_symbols

# Canvas takes a column whose heading contains one of these words and "Score", "Points" or "Grade"
# for its own, and skips it (`NON_ASSIGNMENT_COLUMN_HEADERS` of its importer).
_IGNORED = re.compile(r"\b(?:current|final|override)\b", re.IGNORECASE)

_NAMED = 8  # most submissions that a remark names


@dataclass(frozen=True, kw_only=True)
class Exported:
    """The files written, and remarks for the person who uploads them."""

    files: tuple[Path, ...]
    remarks: tuple[Remark, ...]


def export(
    book: Gradebook,
    platform: Platform,
    out: Path,
    *,
    title: str | None = None,
    roster: Path | None = None,
) -> Exported:
    """Write the class grades for a learning platform.

    Parameters
    ----------
    out : a folder, existing or new; or a .csv file, to write only the table.
    title : title of the assignment on the platform; default: the rubric's title.

    Raises
    ------
    ConfigError : the roster is not a table of this platform, its maximum grade differs from the
        rubric's, or `out` has the name of a file of another kind.
    """
    table = out if out.suffix.lower() == ".csv" and not out.is_dir() else None
    folder = table.parent if table else named_folder(out)
    rubric = book.rubric
    title = title or rubric.title or "cartlab"
    entries = list(book.entries())
    students, remarks = students_of(entries, platform=platform, blank=roster is None)
    if unfinished := [entry.submission for entry in entries if entry.grade.open]:
        remarks.append(
            Remark(
                text=f"not final, exported with the points so far: {len(unfinished)} of "
                f"{len(entries)} submissions have criteria that a person has not graded: "
                f"{first_few(unfinished, _NAMED)}"
            )
        )
    above = [e for e in entries if e.grade.points > rubric.out_of]
    if platform == "moodle" and above:
        named = [f"{e.submission} ({points_text(e.grade.points)})" for e in above]
        remarks.append(
            Remark(
                text=f"more than the maximum of {points_text(rubric.out_of)}, which Moodle does "
                f"not import: {first_few(named, _NAMED)}"
            )
        )
    if platform == "canvas" and (word := _IGNORED.search(title)):
        remarks.append(
            Remark(
                text=f"the title contains {word[0]!r}: Canvas does not import columns such as "
                "'Final Score'; see in its preview whether it lists this column"
            )
        )
    if roster:
        own = Roster.read(roster, platform=platform)
        own.check_maximum(rubric.out_of, title=title)
        text, strangers = _fill_own(own, platform, students, rubric, title=title)
        remarks += strangers
    elif platform == "canvas":
        named = [s for s in students if not s.uploader]
        text = _make_table(platform, named, rubric, title=title)
        sent = [f"{s.name} ({s.grade.submission})" for s in students if s.uploader]
        if sent:
            remarks.append(
                Remark(
                    text="matched only by their authors' ids; give a roster to match them also "
                    f"by the number in the file name: {', '.join(sent)}"
                )
            )
    else:
        text = _make_table(platform, students, rubric, title=title)
    folder.mkdir(parents=True, exist_ok=True)
    files = [table or folder / f"{platform}.csv"]
    write_file(files[0], text)
    if platform == "gradescope" and not table:
        files += _write_results(entries, own_folder(folder, "gradescope"), rubric=rubric)
    return Exported(files=tuple(files), remarks=tuple(remarks))


def _fill_own(
    roster: Roster, platform: Platform, students: Sequence[Student], rubric: Rubric, *, title: str
) -> tuple[str, list[Remark]]:
    """Return the platform's own table with grades filled in, and remarks on mismatches."""
    form = WORKSHEET if _has_numbers(platform, roster.has("Identifier")) else FORMS[platform]
    there = {name: text for name, text in form.if_there.items() if roster.has(name)}
    columns = {
        name.format(title=title): lambda student, text=text: text.format_map(
            values_of(student, rubric)
        )
        for name, text in {**form.filled, **there}.items()
    }
    return roster.fill(
        students, columns, keep=form.kept or None,
        possible=points_text(rubric.out_of) if platform == "canvas" else "",
    )  # fmt: skip


def _make_table(
    platform: Platform, students: Sequence[Student], rubric: Rubric, *, title: str
) -> str:
    """Return a new table that the platform can import, if its own table was not given."""
    numbered = bool(students) and all(student.number for student in students)
    form = WORKSHEET if _has_numbers(platform, numbered) else FORMS[platform]
    head = [name.format(title=title) for name in form.new]
    rows = []
    for student in students:
        values = values_of(student, rubric)
        rows.append([text.format_map(values) for text in form.new.values()])
    if platform == "canvas":
        possible = [f"    {POINTS_POSSIBLE}", *[""] * (len(head) - 2), points_text(rubric.out_of)]
        rows.insert(0, possible)
    if platform == "gradescope":  # one column for each criterion
        for i, c in enumerate(rubric.criteria, start=1):
            head.append(f"{i}: {c.title or c.id} ({c.points} pts)")
            for row, student in zip(rows, students, strict=True):
                judged = () if student.undecided else student.grade.criteria
                row.append("".join(points_text(own.points) for own in judged if own.id == c.id))
    return csv_text(head, rows)


def _has_numbers(platform: Platform, numbered: bool) -> bool:
    """Return whether the table is Moodle's worksheet, which has participant numbers."""
    return platform == "moodle" and numbered


def values_of(student: Student, rubric: Rubric) -> dict[str, str]:
    """Return the values of a student by the names that `platforms.Form` uses for them."""
    first, _, last = student.name.partition(" ")
    return {
        "name": student.name,
        "id": student.id,
        "name_or_id": student.name or student.id,
        "id_or_name": student.id or student.name,
        "number": student.number,
        "first_name": first,
        "last_name": last,
        "sid": "" if "@" in student.id else student.id,
        "email": student.id if "@" in student.id else "",
        "points": student.points,
        "most": points_text(rubric.out_of),
        "status": "Graded" if student.points else "Ungraded",
        "late": _clock(student.grade.days_late),
        "comment": _comment(student),
    }


def _comment(student: Student) -> str:
    """Return short feedback as HTML, which Moodle expects."""
    if student.undecided:
        return ""
    lines = _comment_lines(student.grade, by_hand=student.by_hand)
    return "<br>".join(html.escape(line, quote=False) for line in lines)


def _comment_lines(grade: Grade, *, by_hand: Collection[str]) -> list[str]:
    """Return a line for each criterion with lost points or points given by hand, and for each flag.

    The deduction for lateness and the changes of the total come last.
    """
    if grade.awaits_grading:
        return [waiting_text(grade)]
    if grade.status == "failed" and not grade.criteria:
        return [f"Could not be graded: {on_one_line(grade.reason)}", *person_lines(grade)]
    lost = [
        f"{c.title or c.id}: {points_text(c.points)} of {points_text(c.out_of)}. "
        f"{with_symbols(c.message)}"
        for c in grade.criteria
        if c.id in grade.lost or c.id in by_hand
    ]
    late = [f"Late: {points_text(grade.deducted)} points off."] if grade.deducted else []
    return [*lost, *flag_messages(grade), *late, *person_lines(grade)]


def _clock(days: float) -> str:
    seconds = round(days * 24 * 3600)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _write_results(entries: Iterable[Entry], folder: Path, *, rubric: Rubric) -> list[Path]:
    files = []
    for entry in entries:
        own = own_folder(folder, entry.submission)
        own.mkdir(parents=True, exist_ok=True)
        text = results_text(
            entry.grade, rubric=rubric, by_hand=bool(entry.overrides or entry.adjustments)
        )
        write_file(own / "results.json", text)
        files.append(own / "results.json")
    return files


def remove_exports(folder: Path) -> list[Path]:
    """Remove the files that earlier exports wrote into a class's folder; return their paths."""
    tables = [folder / f"{platform}.csv" for platform in FORMS]
    results = (folder / "gradescope").glob("*/results.json")
    there = [file for file in (*tables, *results) if file.is_file()]
    for file in there:
        file.unlink()
        if file.name == "results.json" and not any(file.parent.iterdir()):
            file.parent.rmdir()
    return there
