"""The way from dropped files to the zip: its steps, and how each stands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

State = Literal["done", "needs", "old", "none"]  # as chips have them; none: not yet
Stands = tuple[State, str]  # a state, and its word


@dataclass(frozen=True, kw_only=True)
class Facts:
    """The facts behind the states of the steps.

    Attributes
    ----------
    recordings : how many there are; to_look_at : how many files need a person.
    missing : groups of the set-up that lack something.
    sound : whether `submission.toml` is there and valid.
    report : "none", "current", "answered" or "older"; see `find_state` of the last report.
    making : whether it is being made.
    questions, unanswered : of the last report.
    handed : whether the zip, as it is now, was downloaded.
    check : how the check stands, in a lab that has it in place of the report.
    """

    recordings: int = 0
    to_look_at: int = 0
    missing: tuple[str, ...] = ()
    sound: bool = False
    report: str = "none"
    making: bool = False
    questions: int = 0
    unanswered: int = 0
    handed: bool = False
    check: Stands | None = None


@dataclass(frozen=True, kw_only=True)
class Step:
    """A step, where it is taken (an address within the room), and how it stands."""

    key: str
    title: str
    address: str
    state: State
    word: str


def _files(facts: Facts) -> Stands:
    if not facts.recordings:
        return "needs", "drop them"
    return ("needs", f"{facts.to_look_at} to look at") if facts.to_look_at else ("done", "done")


def _set_up(facts: Facts) -> Stands:
    if not facts.recordings:
        return "none", "not yet"
    return ("done", "done") if facts.sound and not facts.missing else ("needs", "needs you")


def _report(facts: Facts) -> Stands:
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


def _questions(facts: Facts) -> Stands:
    if facts.report == "none":
        return "none", "not yet"
    if facts.unanswered:
        return "needs", f"{facts.unanswered} open"
    return "done", "done" if facts.questions else "none asked"


def _check(facts: Facts) -> Stands:
    return facts.check or ("none", "not yet")


def _has_result(facts: Facts) -> bool:
    """Return whether the files as they are gave a report or agree: doubts then hold up nobody."""
    return (_check if facts.check else _report)(facts)[0] == "done"


def _hand_in(facts: Facts) -> Stands:
    steps = (_set_up,) if facts.check else (_set_up, _questions)
    if not _has_result(facts) or any(find(facts)[0] != "done" for find in steps):
        return "none", "not yet"
    return ("done", "downloaded") if facts.handed else ("needs", "ready")


# Key, title, address within the room, and what finds how it stands.
_STEPS: tuple[tuple[str, str, str, Callable[[Facts], Stands]], ...] = (
    ("files", "Files", "#files", _files),
    ("set-up", "Set-up", "#details", _set_up),
    ("report", "Report", "report", _report),
    ("questions", "Questions", "questions", _questions),
    ("check", "Check", "check", _check),
    ("hand-in", "Hand in", "hand-in", _hand_in),
)


def find_steps(facts: Facts) -> tuple[Step, ...]:
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
    """Return the first step that is not done; the last where all are.

    Files that need a person hold up nobody once there is a report of them, or a check that agrees.
    """
    has_result = any(s.state == "done" for s in steps if s.key in ("report", "check"))
    open_ = [s for s in steps if s.state != "done" and not (has_result and s.key == "files")]
    return open_[0] if open_ else steps[-1]
