"""The steps from dropped files to the zip, and the state of each."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

State = Literal["done", "needs", "old", "none"]  # as the page shows them; "none" means not yet
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
    questions, unanswered : numbers of questions in the last report.
    handed : whether the zip was downloaded in its current state.
    check : state of the check; None in a lab that has a report instead.
    """

    recordings: int = 0
    to_look_at: int = 0
    missing: tuple[str, ...] = ()
    is_valid: bool = False
    report: str = "none"
    making: bool = False
    questions: int = 0
    unanswered: int = 0
    handed: bool = False
    check: Status | None = None


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


def _files(facts: StepFacts) -> Status:
    if not facts.recordings:
        return "needs", "drop them"
    return ("needs", f"{facts.to_look_at} to look at") if facts.to_look_at else ("done", "done")


def _set_up(facts: StepFacts) -> Status:
    if not facts.recordings:
        return "none", "not yet"
    return ("done", "done") if facts.is_valid and not facts.missing else ("needs", "needs you")


def _report(facts: StepFacts) -> Status:
    if facts.making:
        return "none", "being made"
    if facts.report == "current":
        return "done", "done"
    if facts.report == "answered":
        return "done", "answers newer"
    if facts.report == "older":
        return "old", "out of date"
    ready = all(find(facts)[0] == "done" for find in (_files, _set_up))
    return ("needs", "make it") if ready else ("none", "not yet")


def _questions(facts: StepFacts) -> Status:
    if facts.report == "none":
        return "none", "not yet"
    if facts.unanswered:
        return "needs", f"{facts.unanswered} open"
    return "done", "done" if facts.questions else "none asked"


def _check(facts: StepFacts) -> Status:
    return facts.check or ("none", "not yet")


def _has_result(facts: StepFacts) -> bool:
    """Return whether the current files have a report, or a check in which all numbers agree.

    If so, doubts no longer block the next steps.
    """
    return (_check if facts.check else _report)(facts)[0] == "done"


def _hand_in(facts: StepFacts) -> Status:
    steps = (_set_up,) if facts.check else (_set_up, _questions)
    if not _has_result(facts) or any(find(facts)[0] != "done" for find in steps):
        return "none", "not yet"
    return ("done", "downloaded") if facts.handed else ("needs", "ready")


# Key, title, address relative to the room, and a function that returns the state.
_STEPS: tuple[tuple[str, str, str, Callable[[StepFacts], Status]], ...] = (
    ("files", "Files", "#files", _files),
    ("set-up", "Set-up", "#details", _set_up),
    ("report", "Report", "report", _report),
    ("questions", "Questions", "questions", _questions),
    ("check", "Check", "check", _check),
    ("hand-in", "Hand in", "hand-in", _hand_in),
)


def find_steps(facts: StepFacts) -> tuple[Step, ...]:
    """Return every step with its state."""
    left_out = ("report", "questions") if facts.check else ("check",)
    found = [
        (key, title, address, find(facts))
        for key, title, address, find in _STEPS
        if key not in left_out
    ]
    return tuple(
        Step(key=key, title=title, address=address, state=state, word=word)
        for key, title, address, (state, word) in found
    )


def next_step(steps: Sequence[Step]) -> Step:
    """Return the first step that is not done, or the last step.

    Files that a person must look at are skipped once there is a report, or a check in which all
    numbers agree.
    """
    has_result = any(s.state == "done" for s in steps if s.key in ("report", "check"))
    open_ = [s for s in steps if s.state != "done" and not (has_result and s.key == "files")]
    return open_[0] if open_ else steps[-1]
