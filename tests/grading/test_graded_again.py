"""A submission is graded again if anything on which its outcome depends has changed."""

import shutil
import sys
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest

from pipeline.grading.batch.runner import code_version, grade_batch
from pipeline.grading.batch.task import Setup, Task
from pipeline.grading.batch.worker import grade_task
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Example
from pipeline.grading.intake.files import digest, packed, unpacked
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.ingest.read import read_data
from pipeline.submission import load_submission
from tests.helpers.grades import in_this_process
from tests.helpers.grading_students import copy_step, write_team

RUBRIC = load_rubric(Path("throne-1dof"))


@pytest.fixture(scope="module")
def school(tmp_path_factory):
    """Write two teams, one of which copied a step of the other."""
    folder = tmp_path_factory.mktemp("class")
    teams = [write_team(folder / f"team-{number}", number) for number in (0, 2)]
    copy_step(*teams)
    return folder


@pytest.fixture
def task(school):
    return Task(id="team-0", key="k", sources=(str(school / "team-0"),))


def test_an_error_of_the_grader_is_tried_again(task, tmp_path):
    """If the grader itself fails, the traceback is kept, and the next run tries again."""
    broken = RUBRIC.model_copy(update={"system": None})  # stands for an invalid rubric
    outcome = grade_task(task, rubric=broken, scratch=tmp_path)
    assert (outcome.status, outcome.settled) == ("failed", False)
    assert "AttributeError" in outcome.reason
    assert "Traceback" in outcome.detail


@pytest.mark.parametrize(
    ("slip", "typed"),
    [("carts = 1", "carts = ?"), ("carts = 1", "cart = 1"), ("data/step-1.csv", "data/none.csv"),
     ("version = 1", "version = 1,0"), ('id = "s0"', "id = s0  # me"), ('"s0"', "“s0”")],
)  # fmt: skip
def test_an_unreadable_submission_keeps_its_authors(school, tmp_path, slip, typed):
    """The authors of an unreadable submission are still known, so points by hand reach them."""
    own = shutil.copytree(school / "team-0", tmp_path / "team-0")
    file = own / "submission.toml"
    text = file.read_text(encoding="utf-8")
    assert slip in text
    file.write_text(text.replace(slip, typed), encoding="utf-8")
    task = Task(id="team-0", key="k", sources=(str(own),))
    outcome = grade_task(task, rubric=RUBRIC, scratch=tmp_path)
    assert outcome.authors == ("s0",)


def test_files_that_change_during_the_grading_are_not_graded(task, tmp_path, school):
    """If a file changes between the hash and the copy, the submission is left for the next run."""
    own = shutil.copytree(school / "team-0", tmp_path / "team-0")
    if sys.platform == "linux":  # only Linux allows this file name
        (own / "n\udcff").write_text("no name in any encoding", encoding="utf-8")
    known = replace(task, sources=(str(own),), digest=digest([own]))
    assert grade_task(known, rubric=RUBRIC, scratch=tmp_path).status == "graded"
    unpacked(packed([own]), tmp_path / "travelled")  # as on a cluster
    there = replace(known, sources=(str(tmp_path / "travelled"),))
    assert grade_task(there, rubric=RUBRIC, scratch=tmp_path).status == "graded"
    (own / "notes.md").write_text("one more word", encoding="utf-8")
    outcome = grade_task(known, rubric=RUBRIC, scratch=tmp_path)
    assert (outcome.status, outcome.settled) == ("failed", False)
    assert "changed" in outcome.reason


def test_another_version_of_numpy_grades_everything_again(monkeypatch):
    """If numpy or scipy has another version, everything is graded again."""
    before = code_version()
    assert code_version() == before
    for name in ("numpy", "scipy"):
        with monkeypatch.context() as other:
            other.setattr(
                "pipeline.grading.batch.runner.version",
                lambda asked, name=name: "0" if asked == name else version(asked),
            )
            assert code_version() != before


def test_a_handed_out_recording_is_not_flagged(school, tmp_path):
    """A recording that was handed out to everybody is not flagged in two submissions."""
    records = read_data(load_submission(school / "team-0")).records
    given = Example(fingerprints=fingerprint(records))
    shared = []
    for examples in ((), (given,)):
        with Gradebook(tmp_path, create=True) as book:
            batch = grade_batch(
                find_hand_ins([school], scratch=tmp_path),
                setup=Setup(rubric=RUBRIC, scratch=tmp_path),
                book=book,
                execute=in_this_process,
                examples=lambda examples=examples: examples,
            )
        shared.append(set(batch.shared))
    assert shared == [{"team-0", "team-2"}, set()]
