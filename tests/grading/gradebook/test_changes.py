"""After a regrade, the summary says what changed in the rubric and whose points changed."""

import os
import signal
import subprocess
import sys

import pytest

from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradebook.history import points_changes, rubric_changes
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import finish, make_grade, n_graded, two_cart_rubric
from tests.helpers.grading_students import write_team
from tests.helpers.places import ROOT
from tests.helpers.waiting import started, until

RUBRIC = two_cart_rubric()


def test_a_rubric_is_compared_by_its_criteria():
    """Changed numbers, removed criteria, a new order and other changed keys are listed."""
    first, second, *rest = RUBRIC.criteria
    dearer = first.model_copy(update={"points": first.points + 1})
    late = RUBRIC.late.model_copy(update={"percent_per_day": 50.0})

    def told(**update) -> list[str]:
        changed = RUBRIC.model_copy(update=update)
        return rubric_changes(RUBRIC.model_dump_json(), changed.model_dump_json())

    assert told() == []
    (points,) = told(criteria=(dearer, second, *rest))
    assert points.split() == [
        f"{first.id}:",
        "points",
        f"{first.points:g}",
        "→",
        f"{dearer.points:g}",
    ]
    (removed,) = told(criteria=(second, *rest))
    assert first.id in removed
    (order,) = told(criteria=(second, first, *rest))
    assert "order" in order
    title, lateness = told(late=late, title="")
    assert title.startswith(f"title {RUBRIC.title[:39]}")
    assert lateness.split() == ["late.percent_per_day", "10", "→", "50"]
    (other,) = rubric_changes('{"version": 0}', RUBRIC.model_dump_json())
    assert "another version" in other


def test_points_are_compared_by_name():
    """Teams whose points changed, new teams and removed teams are listed by name."""
    changes = points_changes({"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 1.5, "b": 2.0, "d": 0.0})
    assert [change[0] for change in changes] == ["a", "d", "c"]
    assert changes[0].endswith("1 → 1.5")


def test_changes_are_printed_and_kept_in_the_history(tmp_path):
    """Neither the first class list nor a second run with the same result counts as a change."""
    grade, late = make_grade("a", share=0.5), RUBRIC.model_copy(update={"anonymous": True})
    with Gradebook(tmp_path, assignment="lab", create=True) as book:
        assert [finish(book, grade), finish(book, grade)] == [[], []]
        book.override("a", "laws", 1.0, why="w", by="b")
        rubric, points = finish(book, grade, rubric=late)
        assert rubric.endswith("anonymous False → True")
        assert f"10 → {book.entry('a').grade.points:g}" in points
        assert rubric.endswith(book.history("a")[1][-1].text.removeprefix("rubric: "))


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
        write_team(tmp_path / "c" / f"t{number}", number)
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
    assert str(tmp_path / "out") in last
    assert "repeat" in last
    before = n_graded(tmp_path / "out")
    again = cartlab_here(*command[3:], cwd=ROOT)
    assert again.returncode == 0, again.stderr
    assert 1 <= before < n_graded(tmp_path / "out") == _LEFT + 1
