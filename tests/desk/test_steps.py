"""The student's steps, from files to handing in, are computed from a few facts."""

import pytest

from pipeline.desk.student.submission_view import StepFacts, find_steps, next_step
from pipeline.results import ReportStatus

DONE = {"recordings": 33, "is_valid": True}


DOUBT = DONE | {"to_look_at": 1}


ASKED = DONE | {"report": "current", "questions": 3}
OPEN = {"unanswered": 1}
WRONG = {"status": ReportStatus(state="checks_failed", count=2)}


@pytest.mark.parametrize(
    ("facts", "states", "following"),
    [
        ({}, "needs none none none none", "files"),
        (DONE | {"to_look_at": 2}, "needs done none none none", "files"),
        (DONE | {"missing": ("The bench",)}, "done needs none none none", "set-up"),
        ({"recordings": 33}, "done needs none none none", "set-up"),
        (DONE, "done done needs none none", "report"),
        (DONE | {"making": True}, "done done none none none", "report"),
        (DONE | {"report": "older"}, "done done old done none", "report"),
        (DOUBT | {"report": "current"}, "doubt done done done needs", "hand-in"),
        (
            DOUBT | {"report": "answered", "unanswered": 1},
            "doubt done done needs none",
            "questions",
        ),
        (DOUBT | {"report": "older"}, "needs done old done none", "files"),
        (DOUBT | {"check": ("done", "all agree")}, "doubt done done needs", "hand-in"),
        (ASKED | WRONG, "done done doubt done needs", "hand-in"),
        (ASKED | WRONG | {"report": "answered"}, "done done doubt done needs", "hand-in"),
        (ASKED | WRONG | {"report": "older"}, "done done old done none", "report"),
        (ASKED | OPEN, "done done done needs none", "questions"),
        (ASKED, "done done done done needs", "hand-in"),
        (DONE | {"check": ("needs", "some disagree")}, "done done needs none", "check"),
        (DONE | {"check": ("done", "all agree")}, "done done done needs", "hand-in"),
        (DONE | {"report": "current", "handed": True}, "done done done done done", "hand-in"),
    ],
)
def test_each_step_follows_from_the_facts(facts, states, following):
    """The next step is the first one that is not done, or the last one if the zip was downloaded.

    If a report exists, a file in doubt does not change the next step.
    """
    steps = find_steps(StepFacts(**facts))
    assert " ".join(step.state for step in steps) == states
    assert next_step(steps).key == following
