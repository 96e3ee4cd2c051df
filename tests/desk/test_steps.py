"""The student's steps, from files to handing in, are computed from a few facts."""

import pytest

from pipeline.desk.student.steps import StepFacts, find_steps, next_step

READY = StepFacts(recordings=33, is_valid=True, report="current", questions=3)


@pytest.mark.parametrize(
    ("facts", "states", "following"),
    [
        (StepFacts(), "needs none none none none", "files"),
        (
            StepFacts(recordings=33, to_look_at=2, is_valid=True),
            "needs done none none none",
            "files",
        ),
        (
            StepFacts(recordings=33, missing=("The bench",), is_valid=True),
            "done needs none none none",
            "set-up",
        ),
        (StepFacts(recordings=33), "done needs none none none", "set-up"),
        (StepFacts(recordings=33, is_valid=True), "done done needs none none", "report"),
        (
            StepFacts(recordings=33, is_valid=True, making=True),
            "done done none none none",
            "report",
        ),
        (
            StepFacts(recordings=33, is_valid=True, report="older"),
            "done done old done none",
            "report",
        ),
        (
            StepFacts(recordings=33, to_look_at=1, is_valid=True, report="current"),
            "needs done done done needs",
            "hand-in",
        ),
        (
            StepFacts(recordings=33, to_look_at=1, is_valid=True, report="answered", unanswered=1),
            "needs done done needs none",
            "questions",
        ),
        (
            StepFacts(recordings=33, to_look_at=1, is_valid=True, report="older"),
            "needs done old done none",
            "files",
        ),
        (
            StepFacts(recordings=33, to_look_at=1, is_valid=True, check=("done", "all agree")),
            "needs done done needs",
            "hand-in",
        ),
        (
            StepFacts(recordings=33, is_valid=True, report="current", questions=3, unanswered=1),
            "done done done needs none",
            "questions",
        ),
        (READY, "done done done done needs", "hand-in"),
        (
            StepFacts(recordings=33, is_valid=True, check=("needs", "some disagree")),
            "done done needs none",
            "check",
        ),
        (
            StepFacts(recordings=33, is_valid=True, check=("done", "all agree")),
            "done done done needs",
            "hand-in",
        ),
    ],
)
def test_each_step_follows_from_the_facts(facts, states, following):
    """The next step is the first one that is not done.

    If a report exists, a file in doubt does not change the next step.
    """
    steps = find_steps(facts)
    assert " ".join(step.state for step in steps) == states
    assert next_step(steps).key == following


def test_downloading_the_current_zip_is_the_last_step():
    """Once the current zip has been downloaded, all steps are done and the last one is shown."""
    facts = StepFacts(recordings=1, is_valid=True, report="current", handed=True)
    assert {step.state for step in find_steps(facts)} == {"done"}
    assert next_step(find_steps(facts)).key == "hand-in"
