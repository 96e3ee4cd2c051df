"""Write the output of a grading: `grades.csv`, `class.html`, and all feedback.

The files depend only on the gradebook. Writing them again gives the same files.
"""

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.grade import Flag, Grade, grade_text
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.publish.class_page import class_page
from pipeline.grading.publish.feedback import feedback_page
from pipeline.grading.publish.pseudonyms import KEY_FILE, STRANGER, key_text, pseudonyms
from pipeline.grading.publish.view import view
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.class_questions import (
    Quantity,
    RepeatedAuthors,
    find_distant,
    find_repeated_authors,
    recomputed_numbers,
    with_recordings,
)
from pipeline.grading.similarity.shared_flag import find_clusters, renamed
from pipeline.grading.words import on_one_line
from pipeline.output import csv_text, own_folder, write_file
from pipeline.resources import TEMPLATES
from pipeline.words.progress import Progress, silent

FEEDBACK = "feedback"
_PAGE, _JSON, _CLASS = "feedback.html", "grade.json", "class.html"
_WHOLE = ""  # key of the class page in the table of hashes
# File with a hash of the data of each page. A page is written again only if its hash has changed.
_MADE = ".made.json"
_BEFORE = ("submission", "authors", "status", "points", "out_of", "days_late", "deducted")
_AFTER = ("remarks", "by_hand", "reason", "adjusted", "open")


def write_outputs(
    book: Gradebook, out: Path, *, progress: Progress = silent
) -> list[RepeatedAuthors]:
    """Write the output files of a gradebook into a folder.

    Returns the people who are authors of several submissions. If the rubric is `anonymous`, all
    names are left out, and `anonymous-key.csv` has them. Feedback of submissions that are no longer
    in the class is removed, and so is that of a grade that is held back; other files stay. No file
    has a criterion that is held back.
    """
    rubric = book.rubric.without(book.held_criteria)
    names = _names(book, out) if rubric.anonymous else None
    folder = own_folder(out, FEEDBACK)
    folder.mkdir(parents=True, exist_ok=True)
    made_of = _read_made(folder)
    layout = _digest_layout(rubric, book.held_criteria)
    grades: list[Grade] = []
    held: set[str] = set()
    now_of: dict[str, str] = {}
    gradings: dict[str, int] = {}
    authors: dict[str, tuple[str, ...]] = {}
    shared: dict[str, Flag] = {}
    numbers: dict[str, dict[Quantity, float]] = {}
    for entry in book.shown_entries():
        for flag in entry.grade.flags:
            if flag.code == "shared_data":
                shared[entry.submission] = flag
        seen = view(entry, "staff", names=names)
        grade = seen.grade
        grades.append(grade)
        numbers[grade.submission] = recomputed_numbers(grade, rubric=rubric)
        if entry.hold:
            held.add(grade.submission)
        gradings[entry.submission], authors[entry.submission] = entry.grading, entry.grade.authors
        if entry.hold:
            continue
        now_of[grade.submission] = _digest(layout, entry.key, repr(grade))
        own = own_folder(folder, _checked(grade.submission))
        there = (own / _PAGE).is_file() and (own / _JSON).is_file()
        if there and made_of.get(grade.submission) == now_of[grade.submission]:
            continue
        progress(f"feedback: {grade.submission}")
        (folder / _MADE).unlink(missing_ok=True)  # if this run stops, the next one writes all pages
        own.mkdir(exist_ok=True)
        page = feedback_page(seen, figures=book.figures(entry), name=grade.submission)
        write_file(own / _PAGE, page)
        write_file(own / _JSON, grade_text(grade))
    if names is not None:
        # The order of the class list would reveal the names.
        grades.sort(key=lambda grade: grade.submission)
    _remove_stale(folder, keep=set(now_of))
    write_file(out / "grades.csv", grades_csv(grades, rubric=rubric, held=held))
    repeated = repeated_authors_of(book, authors, gradings=gradings, names=names)
    clusters = find_clusters(shared)
    if names is not None:
        clusters = renamed(clusters, names, other=STRANGER)
    distant = find_distant(numbers)
    whole = repeated, clusters, distant, sorted(held)
    now_of[_WHOLE] = _digest(layout, repr(whole), *now_of.values())
    if made_of.get(_WHOLE) != now_of[_WHOLE] or not (out / _CLASS).is_file():
        page = class_page(
            grades,
            rubric=rubric,
            repeated_authors=repeated,
            clusters=clusters,
            distant=distant,
            held=held,
        )
        write_file(out / _CLASS, page)
    write_file(
        folder / _MADE, json.dumps(now_of, indent=0, ensure_ascii=False, sort_keys=True) + "\n"
    )
    return repeated


def repeated_authors_of(
    book: Gradebook,
    authors: Mapping[str, Sequence[str]],
    *,
    gradings: Mapping[str, int],
    names: Mapping[str, str] | None,
) -> list[RepeatedAuthors]:
    """Return the people who are authors of several submissions.

    Parameters
    ----------
    authors, gradings : for each submission, its authors and the number of its grading.
    names : pseudonyms by submission; None to show real names.
    """
    found = find_repeated_authors(authors)
    concerned = dict.fromkeys(name for people in found for name in people.submissions)
    found = with_recordings(found, book.fingerprints([gradings[name] for name in concerned]))
    if names is None:
        return found

    def hidden(people: RepeatedAuthors) -> RepeatedAuthors:
        shown = tuple(sorted(names[name] for name in people.submissions))
        return replace(people, authors=("",) * len(people.authors), submissions=shown)

    return sorted(map(hidden, found), key=lambda people: people.submissions)


def grades_csv(grades: Sequence[Grade], *, rubric: Rubric, held: Collection[str] = ()) -> str:
    """Return `grades.csv`: one row per submission, one column per criterion.

    Parameters
    ----------
    held : submissions whose grades are held back; their rows have no points.
    """
    taken = {*_BEFORE, *_AFTER}
    heads = [
        f"criterion {asked.id}" if asked.id in taken else asked.id for asked in rubric.criteria
    ]

    def cells(grade: Grade) -> dict[str, object]:
        own: dict[str, object] = {
            "submission": grade.submission,
            "authors": " ".join(grade.authors),
            "out_of": grade.out_of,
            "days_late": grade.days_late,
            "remarks": " ".join(grade.codes),
        }
        if grade.submission in held:
            return {**own, "status": "held"}
        points = (grade.judged.get(asked.id) for asked in rubric.criteria)
        given = {head: one.points for head, one in zip(heads, points, strict=True) if one}
        return {
            **own,
            **given,
            "status": grade.status,
            "points": grade.points,
            "deducted": grade.deducted,
            "by_hand": " ".join(grade.by_hand),
            "reason": on_one_line(grade.reason),
            "adjusted": sum(one.points for one in grade.adjustments),
            "open": " ".join(grade.open),
        }

    columns = (*_BEFORE, *heads, *_AFTER)
    return csv_text(columns, [[own.get(x, "") for x in columns] for own in map(cells, grades)])


def _names(book: Gradebook, out: Path) -> dict[str, str]:
    """Return the pseudonyms of a class; write the file that maps them to names."""
    keys: dict[str, str] = {}
    authors: dict[str, tuple[str, ...]] = {}
    for entry in book.entries():
        keys[entry.submission] = entry.first_key
        authors[entry.submission] = entry.grade.authors
    names = pseudonyms(keys)
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / KEY_FILE, key_text(names, authors), private=True)
    return names


def _digest_layout(rubric: Rubric, held: Sequence[str]) -> str:
    """Return a hash of everything that affects all pages, such as templates and the rubric."""
    names = ("report.html.j2", "blocks.html.j2", "report.css", "page.js")
    parts = [(TEMPLATES / name).read_text(encoding="utf-8") for name in names]
    return _digest(*parts, rubric.model_dump_json(), *held)


def _digest(*parts: str) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(part.encode() + b"\0")
    return total.hexdigest()


def _read_made(folder: Path) -> dict[str, str]:
    try:
        made = json.loads((folder / _MADE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return made if isinstance(made, dict) else {}


def _checked(name: str) -> str:
    """Return the name of a submission; refuse it if it is not a plain folder name."""
    if Path(name).name != name or name in ("", ".", ".."):
        raise ConfigError(f"{name!r}: cannot be the name of a feedback folder")
    return name


def _remove_stale(folder: Path, *, keep: set[str]) -> None:
    for own in folder.iterdir():
        if own.name in keep or own.is_symlink() or not own.is_dir():
            continue
        for name in (_PAGE, _JSON):
            (own / name).unlink(missing_ok=True)
        if not any(own.iterdir()):
            own.rmdir()
