"""Export class grades, or the feedback, in the formats of learning platforms.

Each table has a row for every student. If the platform's own exported table (a roster) is given,
its rows and columns stay and only the grades are filled in. See `platforms` for the formats.
"""

import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.gradebook.events import Entry
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradescope import results_text
from pipeline.grading.platforms import PLATFORMS, Platform
from pipeline.grading.publish.feedback import feedback_page
from pipeline.grading.publish.roster import (
    Remark,
    Roster,
    Student,
    about,
    not_exported,
    students_of,
)
from pipeline.grading.publish.view import GradeView, view
from pipeline.grading.rubric import Rubric
from pipeline.grading.words import WORDS, on_one_line, points_text, waiting_text
from pipeline.output import csv_text, named_folder, own_folder, write_file, zip_bytes
from pipeline.words.text import with_symbols

_NAMED = 8  # most submissions that a remark names
_ZIP = "feedback-{}.zip"
_HELD = "held back, so not exported"


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
    ConfigError : a criterion is held back, the roster is not a table of this platform, its maximum
        grade differs from the rubric's, or `out` has the name of a file of another kind.
    """
    table = out if out.suffix.lower() == ".csv" and not out.is_dir() else None
    folder = table.parent if table else named_folder(out)
    rubric = book.rubric
    if held_back := book.held_criteria:
        raise ConfigError(
            f"{', '.join(held_back)}: held back, so there are no totals yet; first end this with "
            "`cartlab hold --end`"
        )
    title = title or rubric.title or "cartlab"
    entries, held = _without_held(book)
    students, remarks = students_of(entries, platform=platform)
    left = "left as it was" if roster else "left blank"
    if platform.has_results:  # "required if not on each test case" (Gradescope's specification)
        left += f" in {platform.name}.csv, but 0 in results.json, where a score is required"
    ungraded = (s.grade.submission for s in students if not (s.points or s.undecided))
    remarks += about(f"could not be graded, {left}", ungraded)
    remarks += [*_not_final(entries), *about(_HELD, held)]
    if not platform.takes_more:
        above = [e for e in entries if e.grade.points > rubric.out_of]
        remarks += about(
            f"more than the maximum of {points_text(rubric.out_of)}, which {platform.title} does "
            "not import",
            (f"{e.submission} ({points_text(e.grade.points)})" for e in above),
            most=_NAMED,
        )
    if platform.ignored and (word := platform.ignored.search(title)):
        remarks.append(
            Remark(
                text=f"the title contains {word[0]!r}: {platform.title} does not import columns "
                "such as 'Final Score'; see in its preview whether it lists this column"
            )
        )
    if roster:
        own = Roster.read(roster, platform=platform)
        own.check_maximum(rubric.out_of, title=title)
        text, strangers = _fill_own(own, platform, students, rubric, title=title)
        remarks += strangers
    else:
        named = [s for s in students if not s.uploader]
        text = _make_table(platform, named, rubric, title=title)
        remarks += about(
            "matched only by their authors' ids; give a roster to match them also by the number in "
            "the file name",
            (f"{s.name} ({s.grade.submission})" for s in students if s.uploader),
        )
    folder.mkdir(parents=True, exist_ok=True)
    files = [table or folder / f"{platform.name}.csv"]
    write_file(files[0], text)
    if platform.has_results and not table:
        files += _write_results(entries, own_folder(folder, platform.name), held=held)
    return Exported(files=tuple(files), remarks=tuple(remarks))


def _without_held(book: Gradebook) -> tuple[list[Entry], list[str]]:
    """Return the class list without grades that are held back, and the names of these."""
    every = list(book.shown_entries())
    held = [entry.submission for entry in every if entry.hold]
    return [entry for entry in every if not entry.hold], held


def _not_final(entries: Sequence[Entry]) -> list[Remark]:
    """Return a remark that names the submissions that a person has yet to grade."""
    unfinished = [entry.submission for entry in entries if entry.grade.open]
    return about(
        f"not final, exported with the points so far: {len(unfinished)} of {len(entries)} "
        "submissions have criteria that a person has not graded",
        unfinished,
        most=_NAMED,
    )


def _fill_own(
    roster: Roster, platform: Platform, students: Sequence[Student], rubric: Rubric, *, title: str
) -> tuple[str, list[Remark]]:
    """Return the platform's own table with grades filled in, and remarks on mismatches."""
    form = platform.form(numbered=any(map(roster.has, platform.numbers)))
    there = {name: text for name, text in form.if_there.items() if roster.has(name)}
    columns = {
        name.format(title=title): lambda student, text=text: text.format_map(
            values_of(student, rubric)
        )
        for name, text in {**form.filled, **there}.items()
    }
    return roster.fill(
        students, columns, keep=form.kept or None,
        possible=points_text(rubric.out_of) if platform.maxima else "",
    )  # fmt: skip


def _make_table(
    platform: Platform, students: Sequence[Student], rubric: Rubric, *, title: str
) -> str:
    """Return a new table that the platform can import, if its own table was not given."""
    numbered = bool(students) and all(student.number for student in students)
    form = platform.form(numbered=numbered)
    head = [name.format(title=title) for name in form.new]
    values = [values_of(student, rubric) for student in students]
    rows = [[text.format_map(own) for text in form.new.values()] for own in values]
    if platform.maxima:
        possible = [f"    {platform.maxima}", *[""] * (len(head) - 2), points_text(rubric.out_of)]
        rows.insert(0, possible)
    if form.criterion:
        for i, c in enumerate(rubric.criteria, start=1):
            head.append(form.criterion.format(i=i, title=c.title or c.id, points=c.points))
            for row, student in zip(rows, students, strict=True):
                judged = () if student.undecided else student.grade.criteria
                row.append("".join(points_text(own.points) for own in judged if own.id == c.id))
    return csv_text(head, rows)


def values_of(student: Student, rubric: Rubric) -> dict[str, str]:
    """Return the values of a student by the names that `platforms.Table` uses for them."""
    first, _, last = student.name.partition(" ")
    comment = () if student.undecided else _comment_lines(student.view)
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
        "comment": "<br>".join(html.escape(line, quote=False) for line in comment),  # for Moodle
    }


def _comment_lines(view: GradeView) -> list[str]:
    """Return a line for each criterion with lost points or points given by hand, and for each flag.

    The deduction for lateness and the changes of the total come last.
    """
    grade = view.grade
    if grade.awaits_grading:
        return [waiting_text(grade)]
    if grade.status == "failed" and not grade.criteria:
        return [f"Could not be graded: {on_one_line(grade.reason)}", *view.person_lines()]
    by_hand = {given.criterion for given in grade.overrides}
    lost = [
        f"{c.title or c.id}: {points_text(c.points)} of {points_text(c.out_of)}. "
        f"{with_symbols('; '.join(view.reasons(c)) or WORDS.text(f'outcome_{c.outcome}'))}"
        for c in grade.criteria
        if c.id in grade.lost or c.id in by_hand
    ]
    return [*lost, *view.flag_lines(), *view.total_lines()]


def _clock(days: float) -> str:
    seconds = round(days * 24 * 3600)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


def _write_results(entries: Iterable[Entry], folder: Path, *, held: Sequence[str]) -> list[Path]:
    for name in held:  # an earlier export may have written it
        (folder / name / "results.json").unlink(missing_ok=True)
    files = []
    for entry in entries:
        own = own_folder(folder, entry.submission)
        own.mkdir(parents=True, exist_ok=True)
        write_file(own / "results.json", results_text(view(entry, "team")))
        files.append(own / "results.json")
    return files


# --------------------------------------------------------------------------- feedback


def export_feedback(
    book: Gradebook, platform: Platform, out: Path, *, roster: Path | None = None
) -> Exported:
    """Write the zip of feedback files that a learning platform gives to its students.

    Each file has the page of a submission as its team may read it. Submissions that are graded
    again by the next run are left out.

    Parameters
    ----------
    out : a folder, existing or new; or a .zip file.

    Raises
    ------
    ConfigError : the platform takes no feedback files, the roster is not a table of this platform,
        or `out` has the name of a file of another kind.
    """
    if not platform.feedback:
        takers = " or ".join(one.name for one in PLATFORMS.values() if one.feedback)
        raise ConfigError(f"{platform.title} takes no zip of feedback files: give --lms {takers}")
    named = out.suffix.lower() == ".zip" and not out.is_dir()
    file = out if named else named_folder(out) / _ZIP.format(platform.name)
    exported, held = _without_held(book)
    entries = {entry.submission: entry for entry in exported}
    waiting = [name for name, entry in entries.items() if entry.grade.awaits_grading]
    ready = [entry for name, entry in entries.items() if name not in waiting]
    students, remarks = students_of(ready, platform=platform, accounts=True)
    remarks += (
        _not_final(ready) + about("not graded yet, so left out", waiting) + about(_HELD, held)
    )
    if roster:
        students = Roster.read(roster, platform=platform).identify(students)
    placed, problems = _place(students, platform, has_roster=roster is not None)
    remarks += problems
    if not placed:
        raise ConfigError("; ".join(r.text for r in remarks) or "the class has no submissions")
    pages = {
        name: feedback_page(of.view, figures=book.figures(entries[name]), name=name).encode()
        for name, of in {one.grade.submission: one for one in placed.values()}.items()
    }
    remarks += about(
        f"{platform.title} gives a page the name of the student's own file, so these pages do not "
        "end in .html",
        (path for path in placed if not path.lower().endswith((".zip", ".html"))),
        most=_NAMED,
    )
    packed = {
        path: zip_bytes([("feedback.html", page)]) if path.lower().endswith(".zip") else page
        for path, of in placed.items()
        for page in [pages[of.grade.submission]]
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, zip_bytes(packed.items()))
    return Exported(files=(file,), remarks=tuple(remarks))


def _place(
    students: Sequence[Student], platform: Platform, *, has_roster: bool
) -> tuple[dict[str, Student], list[Remark]]:
    """Return whose feedback is at each path in the zip, and remarks on students without a path."""
    placed: dict[str, Student] = {}
    whose: dict[str, str] = {}
    lost, twice, guessed = [], [], []
    for student in students:
        place = {x: getattr(student, x) for x in ("name", "number", "download")}
        path, submission = platform.feedback_path(**place), student.grade.submission
        if student.undecided or not path:
            lost += [] if student.undecided or student.uploader else [student]
        elif whose.setdefault(path.casefold(), submission) != submission:
            twice.append(student)
        elif path not in placed:
            placed[path] = student
            guessed += [student] if student.uploader and not has_roster else []
    # A file by the name of an upload, or for the account that submitted, serves the whole team.
    served = placed.values() if platform.is_by_upload else guessed
    reached = {student.grade.submission for student in served}
    lost = [student for student in lost if student.grade.submission not in reached]
    by_number = [] if platform.is_by_upload or has_roster else placed.values()
    remarks = about(
        "only the account that submitted gets the page; if these are groups, do not upload the "
        "zip, and give the worksheet with --roster",
        (f"{student.name} ({student.grade.submission})" for student in by_number),
        most=_NAMED,
    )
    remarks += not_exported(platform.feedback_needs, lost)
    return placed, remarks + not_exported("another file has the same name", twice)


def remove_exports(folder: Path) -> list[Path]:
    """Remove the files that earlier exports wrote into a class's folder; return their paths."""
    tables = [folder / f"{name}.csv" for name in PLATFORMS]
    pages = [folder / _ZIP.format(name) for name in PLATFORMS]
    results = [
        file
        for platform in PLATFORMS.values()
        if platform.has_results
        for file in (folder / platform.name).glob("*/results.json")
    ]
    there = [file for file in (*tables, *pages, *results) if file.is_file()]
    for file in there:
        file.unlink()
        if file.name == "results.json" and not any(file.parent.iterdir()):
            file.parent.rmdir()
    return there
