"""What TAs and students both see of a criterion: its evidence, and the steps of a request."""

from collections.abc import Iterable
from itertools import count

from pipeline.grading.grade import Criterion
from pipeline.grading.gradebook.events import Event, hide_people
from pipeline.grading.gradebook.history import to_the_second
from pipeline.grading.publish.feedback import numbers_table, sentence
from pipeline.grading.words import points_text
from pipeline.report.document import paragraph
from pipeline.report.html import render_blocks
from pipeline.setup import Units
from pipeline.words.text import rich


def show_evidence(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return the message, and the reported numbers next to the recomputed ones, as HTML."""
    return show_message(criterion) + show_numbers(criterion, check, units)


def show_message(criterion: Criterion) -> str:
    """Return the message of a criterion as HTML."""
    return render_blocks([paragraph(rich(sentence(criterion.message)))])


def show_numbers(criterion: Criterion, check: str, units: Units | None) -> str:
    """Return the reported numbers next to the recomputed ones as HTML; "" without numbers."""
    table = numbers_table(criterion, check=check, units=units, numbers=count(0))
    return render_blocks([table]) if table else ""


# ----------------------------------------------------------------------------------------- requests

_HEADS = {
    "asked": "asked",
    "answered": "answered",
    "reopened": "reopened it: you may ask once more",
}


def describe_steps(
    events: Iterable[Event], *, team: str = "", submission: str = ""
) -> list[dict[str, str]]:
    """Return the events of a request, oldest first: who did what, when, and in which words.

    Parameters
    ----------
    team : pseudonym, if the students must not be named.
    submission : the real name of the submission, which is then hidden too.
    """
    shown = []
    for event in events:
        hidden = team and event.what == "asked"
        by = team if hidden else event.by
        head = f"{by} {_HEADS[event.what]}"
        if event.what == "answered":
            head = f"{head}: {_describe_points(event.points)}"
        people = (submission, *event.authors, event.by * bool(hidden))
        text = hide_people(event.text, people) if team else event.text
        shown.append({"head": head, "at": to_the_second(event.at), "text": text})
    return shown


def _describe_points(points: float | None) -> str:
    if points is None:
        return "points unchanged"
    return f"{points_text(points)} {'point' if points == 1 else 'points'}"
