"""After a regrade, the summary says what changed in the rubric and whose points changed."""

import os
import signal
import subprocess
import sys

import pytest

from pipeline.grading.gradebook.changes import points_changes, rubric_changes
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch
from pipeline.simulated.submission import Students, write_submission
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import make_grade, make_outcome, n_graded, two_cart_rubric
from tests.helpers.places import ROOT
from tests.helpers.waiting import started, until

RUBRIC = two_cart_rubric()


def test_a_rubric_is_compared_by_its_criteria():
    """Changed numbers, removed criteria and a new order of the criteria are listed.

    Other changes of the rubric are listed by their keys.
    """
    first, second, *rest = RUBRIC.criteria
    dearer = first.model_copy(update={"points": first.points + 1})
    late = RUBRIC.late.model_copy(update={"percent_per_day": 50.0})

    def told(**update) -> list[str]:
        changed = RUBRIC.model_copy(update=update)
        return rubric_changes(RUBRIC.model_dump_json(), changed.model_dump_json())

    assert told() == []
    assert told(criteria=(dearer, second, *rest)) == [
        f"{first.id}: points {first.points:g} → {first.points + 1:g}"
    ]
    assert told(criteria=(second, *rest)) == [f"criterion {first.id} was removed"]
    assert told(criteria=(second, first, *rest)) == ["the order of the criteria changed"]
    assert told(late=late, title="") == [
        f"title {RUBRIC.title[:39]}{'…' if len(RUBRIC.title) > 40 else ''} → nothing",
        "late.percent_per_day 10 → 50",
    ]


def test_a_rubric_of_another_version_is_not_compared():
    """If another version of cartlab wrote the earlier rubric, the summary says only that."""
    assert rubric_changes('{"version": 0}', RUBRIC.model_dump_json()) == [
        "the earlier rubric was written by another version of cartlab"
    ]


def test_points_are_compared_by_name():
    """Teams whose points changed, new teams and removed teams are listed by name."""
    assert points_changes({"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 1.5, "b": 2.0, "d": 0.0}) == [
        "a: 1 → 1.5", "d is new", "c was removed",
    ]  # fmt: skip


def test_changes_are_printed_and_kept_in_the_history(tmp_path):
    """After a regrade the changes are printed and kept in the history.

    Neither the first class list nor a second run with the same result counts as a change.
    """
    outcome = make_outcome(make_grade("a", share=0.5))
    batch = Batch(keys=(outcome.key,), shared={})
    late = RUBRIC.model_copy(update={"anonymous": True})
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        book.put(outcome)
        assert book.finish(batch, rubric=RUBRIC) == []
        assert book.finish(batch, rubric=RUBRIC) == []
        book.override("a", "laws", 1.0, why="w", by="b")
        assert book.finish(batch, rubric=late) == [
            "rubric: anonymous False → True",
            f"a: 10 → {book.entry('a').grade.points:g} (with points given by hand)",
        ]
        _, events = book.history("a")
    assert events[-1].text == "rubric: anonymous False → True"


# Submissions still ungraded when the first one is done, so that Ctrl-C comes early enough.
_LEFT = 4


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C is a signal on POSIX")
def test_ctrl_c_says_how_to_go_on(tmp_path):
    """After Ctrl-C one line says how to continue, and the same command then continues.

    Ctrl-C comes before every submission is graded, and the exit status is 130.
    """
    for number in range(_LEFT + 1):
        write_submission(tmp_path / "c" / f"t{number}", "throne-1dof", seed=number,
                         compact=True, students=Students(authors=(f"s{number}",)))  # fmt: skip
    command = [sys.executable, "-m", "pipeline", "grade", str(tmp_path / "c"), "--rubric",
               "throne-1dof", "--out", str(tmp_path / "out"), "--jobs", "1",
               "--no-figures"]  # fmt: skip
    with started(command, stderr=subprocess.PIPE, text=True, start_new_session=True,
                 cwd=ROOT) as process:  # fmt: skip
        until(lambda: n_graded(tmp_path / "out") or process.poll() is not None)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate()
    assert process.returncode == 130, said
    *progress, last = said.splitlines()  # a progress line appears if grading took over two seconds
    assert all(f" of {_LEFT + 1}" in line for line in progress)
    assert last == (
        f"stopped; finished grades are kept in {tmp_path / 'out'}; repeat the command to continue"
    )
    before = n_graded(tmp_path / "out")
    again = cartlab_here(*command[3:], cwd=ROOT)
    assert f"{_LEFT + 1} of {_LEFT + 1} graded" in again.stderr
    assert 1 <= before < n_graded(tmp_path / "out") == _LEFT + 1
