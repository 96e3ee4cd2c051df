"""The student's steps, from files to handing in, are computed from a few facts."""

import pytest

from pipeline.desk.student.way import Facts, find_steps, next_step

READY = Facts(recordings=33, sound=True, report="current", questions=3)


@pytest.mark.parametrize(
    ("facts", "states", "following"),
    [
        (Facts(), "needs none none none none", "files"),
        (Facts(recordings=33, to_look_at=2, sound=True), "needs done none none none", "files"),
        (
            Facts(recordings=33, missing=("The bench",), sound=True),
            "done needs none none none",
            "set-up",
        ),
        (Facts(recordings=33), "done needs none none none", "set-up"),
        (Facts(recordings=33, sound=True), "done done needs none none", "report"),
        (Facts(recordings=33, sound=True, making=True), "done done none none none", "report"),
        (Facts(recordings=33, sound=True, report="older"), "done done old done none", "report"),
        (
            Facts(recordings=33, to_look_at=1, sound=True, report="current"),
            "needs done done done needs",
            "hand-in",
        ),
        (
            Facts(recordings=33, to_look_at=1, sound=True, report="answered", unanswered=1),
            "needs done done needs none",
            "questions",
        ),
        (
            Facts(recordings=33, to_look_at=1, sound=True, report="older"),
            "needs done old done none",
            "files",
        ),
        (
            Facts(recordings=33, to_look_at=1, sound=True, check=("done", "all agree")),
            "needs done done needs",
            "hand-in",
        ),
        (
            Facts(recordings=33, sound=True, report="current", questions=3, unanswered=1),
            "done done done needs none",
            "questions",
        ),
        (READY, "done done done done needs", "hand-in"),
        (
            Facts(recordings=33, sound=True, check=("needs", "some disagree")),
            "done done needs none",
            "check",
        ),
        (
            Facts(recordings=33, sound=True, check=("done", "all agree")),
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
    facts = Facts(recordings=1, sound=True, report="current", handed=True)
    assert {step.state for step in find_steps(facts)} == {"done"}
    assert next_step(find_steps(facts)).key == "hand-in"
