"""The data of the student's room: all that its pages show, and the steps to the hand-in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pipeline.desk import last_report
from pipeline.desk.ask import Ask
from pipeline.desk.seeing import sees_check
from pipeline.desk.student.check_state import find_check_state
from pipeline.desk.student.doubts import NO_DOUBTS, ask_doubts
from pipeline.desk.student.form import Field, Group, fill_form, mark_errors, read_document
from pipeline.desk.student.rows import Row, list_rows
from pipeline.desk.student.summaries import summarise
from pipeline.desk.student.way import Facts, Step, find_steps, next_step
from pipeline.errors import SubmissionError
from pipeline.ingest.fill import UNSURE
from pipeline.processes import Failed
from pipeline.submission.edit import submission_text, text_digest
from pipeline.submission.load import NAME, parse_submission


@dataclass(frozen=True, kw_only=True)
class Room:
    """The content of a submission's folder, with typed values instead of stored ones.

    Attributes
    ----------
    text : text of `submission.toml`; "" if the file is missing.
    rows : one row for each recording.
    groups : groups of the set-up; empty if the file cannot be read.
    wrong : problems of the file that belong to no field.
    findings : what the last report asked, assumed and found.
    facts : what decides the state of the steps.
    """

    text: str
    rows: tuple[Row, ...]
    groups: tuple[Group, ...]
    wrong: tuple[str, ...]
    findings: Mapping[str, Any]
    facts: Facts

    @property
    def digest(self) -> str:
        """The digest of the text, which identifies this version."""
        return text_digest(self.text)

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps from dropped files to the hand-in, with their states."""
        return find_steps(self.facts)

    @property
    def next(self) -> Step:
        """The step to do next."""
        return next_step(self.steps)


def read_room(
    ask: Ask, *, changed: Sequence[Field] = (), error: SubmissionError | None = None
) -> Room:
    """Return the data of the room that the URL names.

    Parameters
    ----------
    changed : fields that could not be written, as typed.
    error : why the fields could not be written.
    """
    folder, text = ask.folder(), ""
    try:
        text = submission_text(folder) if (folder / NAME).exists() else ""
    except SubmissionError as unreadable:
        error = unreadable
    document = read_document(text)
    ask.desk.keep_shown(text, digest=text_digest(text), to=ask.user.name)
    if error is None and text:
        error = _find_error(text, folder)
    doubts = _list_doubts(ask, folder) if UNSURE in text else NO_DOUBTS
    rows = list_rows(ask, folder, document, doubts=doubts["experiments"])
    form = fill_form(document)
    every = [f for group in form for f in group.fields] + [f for row in rows for f in row.fields]
    shown, left = mark_errors(every, changed, error)
    check = find_check_state(folder) if sees_check(ask.user, ask.folder()) else None
    report = "none" if check else last_report.find_state(folder)
    findings = last_report.NO_FINDINGS if check else last_report.read_findings(folder)
    asked = ask_doubts(
        shown,
        fractions=[row.file for row in rows if row.look["fractions"]],
        doubts=doubts,
        findings=findings if report in ("current", "answered") else last_report.NO_FINDINGS,
    )
    by_path = {field.path: field for field in asked}
    rows = [replace(row, fields=tuple(by_path[f.path] for f in row.fields)) for row in rows]
    groups = [replace(one, fields=tuple(by_path[f.path] for f in one.fields)) for one in form]
    groups = [summarise(group) for group in groups] if document else []
    job = ask.desk.jobs.of(folder)
    return Room(
        text=text,
        rows=tuple(rows),
        groups=tuple(groups),
        wrong=tuple(left),
        findings=findings,
        facts=Facts(
            recordings=sum(row.is_recording for row in rows),
            to_look_at=sum(row.needs_a_person for row in rows),
            missing=tuple(group.title for group in groups if group.missing),
            sound=bool(text) and error is None,
            report=report,
            making=bool(job and not job.over and job.task[0] == "make_report"),
            questions=len(findings["questions"]),
            unanswered=0 if check else len(last_report.list_unanswered(folder)),
            handed=ask.desk.handed.get(folder) == last_report.stat_sources(folder),
            check=check,
        ),
    )


def _list_doubts(ask: Ask, folder: Path) -> Mapping[str, Any]:
    try:
        return ask.desk.workers.do("list_doubts", folder=str(folder))
    except Failed:  # the page says what is wrong with the file
        return NO_DOUBTS


def _find_error(text: str, folder: Path) -> SubmissionError | None:
    """Return what is wrong with the stored file, or None."""
    try:
        parse_submission(text, folder=folder)
    except SubmissionError as error:
        return error
    return None
