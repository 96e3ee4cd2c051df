"""The data of the student's room: all that its pages show, and the steps to the hand-in."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from starlette.responses import Response

from pipeline.desk import last_report
from pipeline.desk.page_request import PageRequest
from pipeline.desk.student.form import Fault, Group, fill_form, mark_errors
from pipeline.desk.student.recording_rows import RecordingRow, list_rows
from pipeline.desk.student.set_up import NO_QUESTIONS, ask_setup_questions, summarise
from pipeline.desk.student.steps import Step, StepFacts, find_steps, next_step
from pipeline.desk.toml_form import Field
from pipeline.processes import Failed
from pipeline.submission.edit import text_digest
from pipeline.submission.load import NAME

_UNREADABLE: Mapping[str, Any] = {
    "text": "", "document": {}, "doubts": None, "keeps": [], "unanswered": [], "checked": None,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SubmissionView:
    """The content of a submission's folder, with typed values instead of stored ones.

    Attributes
    ----------
    text : text of `submission.toml`; "" if the file is missing.
    document : the tables in it, with numbers as typed text.
    keeps : why a valid submission cannot be handed in yet.
    unanswered : the questions of the last report without an answer.
    rows : one row for each recording.
    groups : groups of the set-up; empty if the file cannot be read.
    wrong : problems of the file that belong to no field.
    findings : what the last report asked, assumed and found.
    facts : what decides the state of the steps.
    """

    text: str
    document: Mapping[str, Any]
    keeps: Sequence[str]
    unanswered: Sequence[Mapping[str, str]]
    rows: tuple[RecordingRow, ...]
    groups: tuple[Group, ...]
    wrong: tuple[str, ...]
    findings: Mapping[str, Any]
    facts: StepFacts

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


@dataclass(frozen=True, kw_only=True)
class StalePage:
    """The data of the page that is shown if a file was changed by others.

    Attributes
    ----------
    name, text : the file as it is now.
    changed : label of each field that the form would change, its typed and its present value.
    had : heading of the typed values.
    back : address at which to continue.
    """

    name: str
    text: str
    changed: Sequence[tuple[str, str, str]]
    back: str
    had: str = "You typed"


def show_stale(ask: PageRequest, page: StalePage) -> Response:
    """Show both versions of a file that was changed meanwhile."""
    return ask.page("stale", status=409, title=f"{page.name} was changed meanwhile", page=page)


def read_room(
    ask: PageRequest, *, changed: Sequence[Field] = (), fault: Fault | None = None
) -> SubmissionView:
    """Return the data of the room that the URL names.

    Parameters
    ----------
    changed : fields that could not be written, as typed.
    fault : why the fields could not be written.
    """
    folder, sees_check = ask.folder(), ask.sees_check
    try:
        found = ask.desk.workers.do("read_folder", folder=str(folder), check=sees_check)
    except Failed as error:  # the page still takes a new file
        found = {**_UNREADABLE, "fault": {"text": f"{NAME}: cannot be read ({error})"}}
    text, document, doubts = found["text"], found["document"], found["doubts"] or NO_QUESTIONS
    ask.desk.keep_shown(text, digest=text_digest(text), to=ask.user.name)
    if fault is None and found["fault"]:
        fault = Fault(**found["fault"])
    rows = list_rows(ask, folder, document, doubts=doubts["experiments"])
    form = fill_form(document)
    every = [f for group in form for f in group.fields] + [f for row in rows for f in row.fields]
    shown, left = mark_errors(every, changed, fault)
    check = tuple(found["checked"]) if found["checked"] else None
    report = "none" if check else last_report.find_state(folder)
    findings = last_report.NO_FINDINGS if check else last_report.read_findings(folder)
    asked = ask_setup_questions(
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
    return SubmissionView(
        text=text,
        document=document,
        keeps=found["keeps"],
        unanswered=found["unanswered"],
        rows=tuple(rows),
        groups=tuple(groups),
        wrong=tuple(left),
        findings=findings,
        facts=StepFacts(
            recordings=sum(row.is_recording for row in rows),
            to_look_at=sum(row.needs_a_person for row in rows),
            missing=tuple(group.title for group in groups if group.missing),
            is_valid=bool(text) and fault is None,
            report=report,
            making=bool(job and not job.over and job.task[0] == "make_report"),
            questions=len(findings["questions"]),
            unanswered=len(found["unanswered"]),
            handed=last_report.is_unchanged(folder, ask.desk.handed.get(folder)),
            check=check,
        ),
    )
