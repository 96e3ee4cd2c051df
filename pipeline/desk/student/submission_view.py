"""The data of the student's room: all that its pages show, and the steps to the hand-in."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from starlette.responses import Response

from pipeline.desk import last_report
from pipeline.desk.page_request import PageRequest
from pipeline.desk.student.form import (
    NO_QUESTIONS,
    Fault,
    Group,
    ask_setup_questions,
    fill_form,
    mark_errors,
    summarise,
)
from pipeline.desk.student.recording_rows import RecordingRow, list_rows
from pipeline.desk.toml_form import Field
from pipeline.processes import Failed
from pipeline.results import ReportStatus
from pipeline.submission.edit import text_digest
from pipeline.submission.load import NAME
from pipeline.words.numbers import count

# As the page shows them. "doubt" means done, but look at it; "none" means not yet.
State = Literal["done", "doubt", "needs", "old", "none"]
Status = tuple[State, str]  # a state, and the word shown for it


@dataclass(frozen=True, kw_only=True)
class StepFacts:
    """The facts that decide the state of each step.

    Attributes
    ----------
    to_look_at : number of files that a person must look at.
    missing : groups of the set-up in which something is missing.
    is_valid : whether `submission.toml` exists and is valid.
    report : state of the report: "none", "current", "answered" or "older"; see `find_state`.
    status : how far the numbers of the last report may be used; None without a report.
    questions, unanswered : numbers of questions in the last report.
    handed : whether the zip was downloaded in its current state.
    check : state of the check; None in a lab that has a report instead.
    """

    recordings: int = 0
    to_look_at: int = 0
    missing: tuple[str, ...] = ()
    is_valid: bool = False
    report: str = "none"
    status: ReportStatus | None = None
    making: bool = False
    questions: int = 0
    unanswered: int = 0
    handed: bool = False
    check: Status | None = None

    @property
    def is_doubtful(self) -> bool:
        """Whether the report of the current files says that its numbers may be wrong."""
        is_current = self.report in ("current", "answered")
        return is_current and self.status is not None and not self.status.is_fine


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step with its state.

    Attributes
    ----------
    address : address of the page, relative to the room.
    word : text shown for the state.
    """

    key: str
    title: str
    address: str
    state: State
    word: str


_OVER = ("done", "doubt")  # states after which the next step may begin


def _files(facts: StepFacts) -> Status:
    if not facts.recordings:
        return "needs", "drop them"
    if not facts.to_look_at:
        return "done", "done"
    # Once there is a result, doubts no longer block the next steps.
    return ("doubt" if _has_result(facts) else "needs"), f"{facts.to_look_at} to look at"


def _set_up(facts: StepFacts) -> Status:
    if not facts.recordings:
        return "none", "not yet"
    return ("done", "done") if facts.is_valid and not facts.missing else ("needs", "needs you")


def _report(facts: StepFacts) -> Status:
    if facts.making:
        return "none", "being made"
    if facts.is_doubtful and facts.status:
        return "doubt", facts.status.words
    if facts.report == "current":
        return "done", "done"
    if facts.report == "answered":
        return "done", "texts newer"
    if facts.report == "older":
        return "old", "out of date"
    ready = all(find(facts)[0] == "done" for find in (_files, _set_up))
    return ("needs", "make it") if ready else ("none", "not yet")


def _questions(facts: StepFacts) -> Status:
    if facts.report == "none":
        return "none", "not yet"
    if facts.unanswered:
        return "needs", f"{count(facts.unanswered, 'question')} open"
    return "done", "all answered" if facts.questions else "no questions"


def _check(facts: StepFacts) -> Status:
    return facts.check or ("none", "not yet")


def _has_result(facts: StepFacts) -> bool:
    """Return whether the current files have a report, or a check in which all numbers agree."""
    if facts.check:
        return _check(facts)[0] == "done"
    return not facts.making and facts.report in ("current", "answered")


def _hand_in(facts: StepFacts) -> Status:
    steps = (_set_up,) if facts.check else (_set_up, _questions)
    if not _has_result(facts) or any(find(facts)[0] not in _OVER for find in steps):
        return "none", "not yet"
    return ("done", "downloaded") if facts.handed else ("needs", "ready")


# Key, title, address relative to the room, and a function that returns the state.
_STEPS: tuple[tuple[str, str, str, Callable[[StepFacts], Status]], ...] = (
    ("files", "Files", "#files", _files),
    ("set-up", "Set-up", "#details", _set_up),
    ("report", "Report", "report", _report),
    ("questions", "Discussion", "questions", _questions),
    ("check", "Check", "check", _check),
    ("hand-in", "Hand in", "hand-in", _hand_in),
)


def find_steps(facts: StepFacts) -> tuple[Step, ...]:
    """Return every step with its state."""
    left_out = ("report", "questions") if facts.check else ("check",)
    return tuple(
        Step(key=key, title=title, address=address, state=state, word=word)
        for key, title, address, find in _STEPS
        if key not in left_out
        for state, word in [find(facts)]
    )


def next_step(steps: Sequence[Step]) -> Step:
    """Return the first step that is not done, or the last step."""
    return next((step for step in steps if step.state not in _OVER), steps[-1])


# -------------------------------------------------------------------------------- the view

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


def show_stale(
    ask: PageRequest,
    name: str,
    text: str,
    *,
    changed: Sequence[tuple[str, str, str]],
    back: str,
    had: str = "You typed",
) -> Response:
    """Show both versions of a file that was changed meanwhile.

    Parameters
    ----------
    name, text : the file as it is now.
    changed : label of each field that the form would change, its typed and its present value.
    back : address at which to continue.
    had : heading of the typed values.
    """
    shown = {"name": name, "text": text, "changed": changed, "back": back, "had": had}
    return ask.page("stale", status=409, title=f"{name} was changed meanwhile", **shown)


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
        found = ask.do("read_folder", check=sees_check)
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
            status=findings["status"],
            making=bool(job and not job.over and job.task[0] == "make_report"),
            questions=len(findings["questions"]),
            unanswered=len(found["unanswered"]),
            handed=last_report.is_unchanged(folder, ask.desk.handed.get(folder)),
            check=check,
        ),
    )
