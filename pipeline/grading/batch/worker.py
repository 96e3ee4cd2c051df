"""The process that grades one submission after another; it is stopped if it exceeds a limit."""

import re
import tempfile
import tomllib
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pipeline.errors import PipelineError, is_disk_full
from pipeline.grading.grade import grade_text
from pipeline.grading.gradings import OUT_OF_MEMORY, Grading, HandIn, failed, plain_grading
from pipeline.grading.intake.files import Changed, open_submission
from pipeline.grading.intake.repairs import Repair, text_key
from pipeline.grading.judge.award import findings_text
from pipeline.grading.judge.run import Graded, grade_submission
from pipeline.grading.rubric import Rubric
from pipeline.grading.self_check.answers import asked_note
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.ingest.files import OF_STRANGERS
from pipeline.processes import serve
from pipeline.submission import Submission, load_submission
from pipeline.submission.load import MAX_TOML_BYTES, NAME
from pipeline.submission.toml import quote

_DETAIL = 20_000  # most characters of a traceback that are kept
_TABLE = re.compile(r"\s*\[+\s*([\w.-]+)")
_ID = re.compile(r"""\s*id\s*=\s*["'“”„]?([^"'“”#]+)""")


def grade_hand_in(
    hand_in: HandIn, *, rubric: Rubric, scratch: Path, figures: bool = False
) -> Grading:
    """Open, analyse and grade one submission; if it fails, the outcome holds the reason."""
    authors: tuple[str, ...] = ()
    reason = detail = original = by = ""
    settled, no_room = True, False
    try:
        with _opened(hand_in, scratch) as (opened, original, repaired):
            by = f"by {repaired.by}: {repaired.why}" if repaired else ""
            authors = named_authors(opened)
            submission = load_submission(opened)
            original = original if submission.unread or repaired else ""
            authors = tuple(author.id for author in submission.authors)
            graded = grade_submission(
                submission,
                rubric=rubric,
                name=hand_in.id,
                days_late=hand_in.days_late,
                bench=hand_in.bench,
            )
            grade = graded.grade
            notes = [*grade.notes, *asked_note(opened)]
            if repaired:
                notes.append(f"{NAME} was repaired before grading: {repaired.why}")
            grade = grade.model_copy(update={"notes": tuple(notes), "repaired": by})
            records = graded.analysis.records if graded.analysis else ()
            drawn, detail = _figures(submission, graded, rubric) if figures else ((), "")
            return Grading(
                submission=hand_in.id,
                authors=grade.authors,
                key=hand_in.key,
                status=grade.status,
                reason=grade.reason,
                days_late=hand_in.days_late,
                grade=grade_text(grade),
                findings=findings_text(graded.judgements) if graded.judgements else "",
                fingerprints=fingerprint(records),
                figures=drawn,
                owner=hand_in.owner,
                settled=not detail,
                detail=detail,
                original=original,
            )
    except Changed:  # for example, because the folder is being synchronised
        reason, settled = "its files changed during the grading: grade it again", False
    except PipelineError as error:
        reason = str(error)
    except OSError as error:  # the cause may be this computer: a full disk or a lost folder
        reason = f"cannot be read ({error.strerror or error}); the next run tries again"
        settled, no_room = False, is_disk_full(error)
    except MemoryError:
        reason, settled = OUT_OF_MEMORY, False
    except Exception as error:  # a bug in cartlab or a library: the next run tries again
        reason = f"the grader failed: {type(error).__name__}: {quote(str(error))}"
        detail, settled = _traceback(), False
    outcome = failed(
        hand_in,
        reason,
        authors=authors,
        out_of=rubric.out_of,
        settled=settled,
        detail=detail,
        repaired=by,
    )
    return replace(outcome, is_disk_full=no_room, original=original)


def read_authors(hand_in: HandIn, *, scratch: Path) -> tuple[str, ...]:
    """Open one submission and return the author ids that it names, without grading it.

    Raises
    ------
    PipelineError, OSError : as for `open_submission`.
    """
    with _opened(hand_in, scratch) as (folder, _, _):
        return named_authors(folder)


@contextmanager
def _opened(hand_in: HandIn, scratch: Path) -> Iterator[tuple[Path, str, Repair | None]]:
    """Open a private copy of a submission; yield its folder, the text handed in, and its repair."""
    with tempfile.TemporaryDirectory(
        dir=scratch, prefix="open-", ignore_cleanup_errors=True
    ) as folder:
        into = Path(folder) / hand_in.id
        opened = open_submission(hand_in.sources, into, digest=hand_in.digest)
        original = _handed_in(opened)
        yield opened, original, _repair(opened, hand_in, original)


def _handed_in(folder: Path) -> str:
    """Return the text of `submission.toml`; "" if it is too long or not text."""
    try:
        raw = (folder / NAME).read_bytes()
        return raw.decode("utf-8-sig") if len(raw) <= MAX_TOML_BYTES else ""
    except UnicodeDecodeError:
        return ""


def _repair(folder: Path, hand_in: HandIn, text: str) -> Repair | None:
    """Write the repair of a text, if there is one, into the private copy of a submission."""
    if (found := hand_in.repairs.get(text_key(text))) is None:
        return None
    repair = Repair(**found)
    (folder / NAME).write_text(repair.text, encoding="utf-8", newline="\n")
    return repair


def named_authors(folder: Path) -> tuple[str, ...]:
    """Return the author ids in `submission.toml`, even if the file has mistakes.

    A file that is not valid TOML is read line by line.

    Raises
    ------
    OSError : the file cannot be read.
    """
    with (folder / NAME).open(encoding="utf-8-sig", errors="replace") as file:
        text = file.read(MAX_TOML_BYTES)
    try:
        authors = tomllib.loads(text).get("authors")
        people = authors if isinstance(authors, list) else []
        ids = [one.get("id") for one in people if isinstance(one, dict)]
        found = [str(id_) for id_ in ids if isinstance(id_, str | int)]
    except (ValueError, RecursionError):  # ValueError also for an integer of over 4,300 digits
        found = _ids_by_line(text)
    return tuple(dict.fromkeys(id_.strip() for id_ in found if id_.strip()))


def _ids_by_line(text: str) -> Iterator[str]:
    table = ""
    for line in text.splitlines():
        if heading := _TABLE.match(line):
            table = heading[1]
        elif table == "authors" and (id_ := _ID.match(line)):
            yield id_[1]


def _figures(
    submission: Submission, graded: Graded, rubric: Rubric
) -> tuple[tuple[tuple[str, str], ...], str]:
    """Return the figures of the feedback, and the traceback of a drawing error or "".

    A drawing error leaves the grade unchanged.
    """
    from pipeline.grading.publish.feedback_figures import (
        draw_figures,  # imported late, because the import takes half a second
        draw_records,
    )

    if graded.analysis is None:
        return (), ""
    about = {asked.id for asked in rubric.criteria if asked.check == "initial"}
    initial = [criterion for criterion in graded.grade.criteria if criterion.id in about]
    try:
        drawn = draw_figures(graded.analysis, submission.reported)
        return drawn + draw_records(graded.analysis, initial), ""
    except Exception:
        return (), _traceback()


def _traceback() -> str:
    return traceback.format_exc()[-_DETAIL:]


def _prepare(
    rubric: str, scratch: str, *, figures: bool
) -> Callable[[tuple[str, dict[str, Any]], object], dict[str, Any] | Sequence[str]]:
    """Return a function that grades submissions, or only reads their authors.

    Parameters
    ----------
    rubric : the rubric as JSON.
    """
    asked = Rubric.model_validate_json(rubric)

    def do(wanted: tuple[str, dict[str, Any]], _: object) -> dict[str, Any] | Sequence[str]:
        what, plain = wanted
        hand_in = HandIn.read(plain)
        if what == "authors":
            return read_authors(hand_in, scratch=Path(scratch))
        return plain_grading(
            grade_hand_in(hand_in, rubric=asked, scratch=Path(scratch), figures=figures)
        )

    return do


if __name__ == "__main__":
    OF_STRANGERS.set(True)
    serve(_prepare)
