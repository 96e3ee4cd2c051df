"""A batch gives each submission one row, whatever the order of work, and grades none twice."""

import json
import random
import shutil
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from pipeline.grading.batch.runner import Grader, code_version, grade_batch, run_here
from pipeline.grading.batch.worker import grade_hand_in, named_authors, read_authors
from pipeline.grading.grade import grade_text, read_grade
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Example, HandIn, Setup
from pipeline.grading.intake.files import digest, packed, unpacked
from pipeline.grading.intake.find import find_hand_ins
from pipeline.grading.platforms import PLATFORMS
from pipeline.grading.publish import feedback_figures
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.publish.roster import students_of
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.ingest.read import read_data
from pipeline.processes import LineProcess
from pipeline.submission import load_submission
from tests.helpers.grades import in_this_process, n_graded
from tests.helpers.grading_students import copy_step, write_team
from tests.helpers.spoilt import change
from tests.helpers.waiting import PATIENCE, started, until

RUBRIC = load_rubric(Path("throne-1dof"))


@pytest.fixture(scope="module")
def school(tmp_path_factory):
    """Return a class of three teams, one of which copied a step, and a broken submission."""
    folder = tmp_path_factory.mktemp("class")
    teams = [write_team(folder / f"team-{number}", number) for number in range(3)]
    copy_step(teams[0], teams[2])
    (folder / "team-3").mkdir()
    (folder / "team-3" / "submission.toml").write_text("version = [", encoding="utf-8")
    return folder


def run(
    paths, out, *, jobs=1, time_limit=PATIENCE, execute=None, progress=lambda *_: None, finish=False
):
    """Grade into a new gradebook; return the batch, and each submission's outcome and grade."""
    scratch = out / "scratch"
    scratch.mkdir(parents=True, exist_ok=True)
    with Gradebook(out, create=True) as book:
        batch = grade_batch(
            find_hand_ins(paths, scratch=scratch),
            setup=Setup(rubric=RUBRIC, scratch=scratch, time_limit=time_limit),
            book=book,
            execute=execute or run_here(jobs=jobs),
            progress=progress,
        )
        if finish:
            book.finish(batch, rubric=RUBRIC)
        rows = {}
        for outcome in filter(None, (book.known(key, figures=False) for key in batch.keys)):
            flag, grade = batch.shared.get(outcome.submission), read_grade(outcome.grade)
            text = grade_text(grade.with_flags(flag) if flag else grade)
            rows[outcome.submission] = (outcome, text)
        return batch, rows


@pytest.fixture(scope="module")
def graded(school, tmp_path_factory):
    """Grade the class with two processes; return folder, batch, rows and messages."""
    out, seen = tmp_path_factory.mktemp("graded"), []
    batch, rows = run([school], out, jobs=2, progress=lambda *what: seen.append(what[0]))
    return out, batch, rows, seen


def test_a_class_is_graded_and_sharing_is_flagged(graded):
    """Every submission gets a row, and both teams that have a copied step are flagged."""
    _, batch, rows, seen = graded
    assert list(rows) == ["team-0", "team-1", "team-2", "team-3"]
    assert [outcome.status for outcome, _ in rows.values()] == ["graded"] * 3 + ["failed"]
    assert "TOML" in rows["team-3"][0].reason
    assert set(batch.shared) == {"team-0", "team-2"}
    (flag,) = [f for f in json.loads(rows["team-2"][1])["flags"] if f["code"] == "shared_data"]
    assert flag["parameters"] == ["step-2"]
    assert flag["evidence"]["recordings"][0]["other_experiment"] == "step-1"
    assert seen == [0, 1, 2, 3, 4, 4]


@pytest.mark.slow
@pytest.mark.sample
def test_the_number_of_processes_changes_no_row(school, graded, tmp_path):
    """A class graded with one process gets the same rows as with two."""
    _, _, rows, _ = graded
    _, alone = run([school], tmp_path, execute=in_this_process)
    assert alone == rows


def test_only_what_changed_is_graded_again(school, graded, tmp_path):
    """A second run of the same class starts no process.

    A changed file causes only its own submission to be graded.
    """

    def nobody(tasks, setup):
        raise AssertionError([task.id for task in tasks])

    out, _, first, _ = graded
    copy = shutil.copytree(school, tmp_path / "class")
    book = shutil.copytree(out, tmp_path / "out")
    _, second = run([copy], book, execute=nobody)
    assert second == first
    (copy / "team-1" / "notes.md").write_text("one more word", encoding="utf-8")
    with pytest.raises(AssertionError, match=r"\['team-1'\]"):
        run([copy], book, execute=nobody)


@pytest.fixture
def task(school):
    return HandIn(id="team-0", key="k", sources=(school / "team-0",))


@pytest.fixture
def setup(tmp_path):
    return Setup(rubric=RUBRIC, scratch=tmp_path, time_limit=PATIENCE)


@pytest.fixture
def kill_next(monkeypatch):
    """Return a function that kills the next process when it gets a task."""
    send, doomed = LineProcess.send, []

    def send_and_kill(process, line):
        send(process, line)
        if doomed:
            doomed.pop()
            process._process.kill()

    monkeypatch.setattr(LineProcess, "send", send_and_kill)
    return lambda: doomed.append(True)


@pytest.mark.slow
@pytest.mark.sample
def test_a_crash_costs_one_row_and_the_worker_is_replaced(task, setup, kill_next):
    """If a worker dies during a task, its row says so and the next task is graded.

    If it is killed while it starts, another one grades its submission.
    """
    kill_next()
    with closing(Grader(setup)) as worker:
        assert worker.run(task).status == "graded"
        kill_next()
        outcome = worker.run(task)
        assert (outcome.status, outcome.settled) == ("failed", False)
        assert "crashed" in outcome.reason
        assert worker.run(task).status == "graded"


def test_a_grade_is_kept_if_its_figures_fail(task, tmp_path, monkeypatch):
    """If figures cannot be drawn, the submission still gets its points.

    The next run grades the submission again.
    """

    def undrawable(*_):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(feedback_figures, "draw_figures", undrawable)
    outcome = grade_hand_in(task, rubric=RUBRIC, scratch=tmp_path, figures=True)

    assert (outcome.status, outcome.figures, outcome.settled) == ("graded", (), False)
    assert json.loads(outcome.grade)["points"] > 0
    assert "LinAlgError" in outcome.detail


def test_a_fault_of_this_machine_is_tried_again(task, tmp_path):
    """If the scratch folder cannot be written, the row says so and the next run tries again."""
    (tmp_path / "scratch").touch()  # no folder can be made in a file
    outcome = grade_hand_in(task, rubric=RUBRIC, scratch=tmp_path / "scratch")
    assert (outcome.status, outcome.settled) == ("failed", False)
    assert "be read" in outcome.reason


@pytest.mark.slow
@pytest.mark.sample
def test_memory_is_limited(school, setup, tmp_path):
    """A submission that needs more memory than the limit gets a row that says so.

    The next submission is graded.
    """
    large = shutil.copytree(school / "team-0", tmp_path / "large")
    rows = "".join(f"{i / 1000:.3f},1,{i % 7}\n" for i in range(1_500_000))
    (large / "data" / "step-1.csv").write_text("time,input,x1\n" + rows, encoding="utf-8")
    small = replace(setup, memory_limit=100_000_000)
    with closing(Grader(small)) as worker:
        outcome = worker.run(HandIn(id="large", key="k", sources=(large,)))
        assert not outcome.settled
        assert "0.1 GB" in outcome.reason
        again = worker.run(HandIn(id="t", key="k", sources=(school / "team-0",)))
        assert again.status == "graded"


@pytest.mark.slow
@pytest.mark.sample
def test_a_hang_is_stopped_and_tried_again(school, tmp_path):
    """A submission that takes too long gets a row that says so; a run with more time grades it."""
    _, hung = run([school / "team-0"], tmp_path, time_limit=0.01)
    (outcome, text) = hung["team-0"]
    grade = read_grade(text)
    assert "0.01 s" in outcome.reason
    assert (outcome.authors, grade.authors, grade.unsettled) == (("s0",), ("s0",), True)
    _, graded = run([school / "team-0"], tmp_path, execute=in_this_process)
    assert graded["team-0"][0].status == "graded"


@pytest.mark.slow
@pytest.mark.sample
def test_the_files_of_a_stopped_submission_name_its_authors(school, tmp_path):
    """If a submission is stopped, its authors are in every table, and no mark is shown.

    Its feedback blames the submission for nothing.
    """
    run([school / "team-0"], tmp_path, time_limit=0.01, finish=True)
    with Gradebook(tmp_path) as book:
        write_outputs(book, tmp_path)
        ((student,), remarks) = students_of(list(book.entries()), platform=PLATFORMS["canvas"])
    assert (student.id, student.points, remarks) == ("s0", "", [])
    pages = {name: (tmp_path / name).read_text(encoding="utf-8")
             for name in ("grades.csv", "class.html", "feedback/team-0/feedback.html")}  # fmt: skip
    table, class_, page = pages.values()
    assert '"team-0","s0","failed",' in table
    assert "not graded yet" in class_
    assert "nothing is wrong" in page
    assert not [words for words in ("hand it in", f"0 of {RUBRIC.out_of:g}") if words in page]


@pytest.mark.parametrize(
    "text",
    [
        '[[authors]]\nid = "s1"\n[[authors]]\nname = "B"\nid = "s2"\n',
        'authors = [{id = "s1"}, {name = "B", id = "s2"}]\n',
        '[[authors]]\nid = "s1"\n[[authors]]\nid = “s2”\nversion = [',
    ],
)
def test_authors_are_read_however_they_are_written(text, tmp_path):
    """Authors are found in tables, in a list, and in a file that is not valid TOML."""
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    task = HandIn(id="team", key="k", sources=(tmp_path,))
    assert read_authors(task, scratch=tmp_path.parent) == ("s1", "s2")


@pytest.mark.parametrize(
    "text",
    [
        "authors = 3",
        "authors = [1, {id = ''}, {id = []}]",
        "a = " + "[" * 5000,
        "a = 1" + "0" * 5000,
    ],
)
def test_strange_authors_are_no_authors(text, tmp_path):
    """If `authors` is no list of tables with ids, nobody is named and nothing fails."""
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    assert named_authors(tmp_path) == ()


def test_an_error_of_the_grader_is_tried_again(task, tmp_path):
    """If the grader itself fails, the traceback is kept, and the next run tries again."""
    broken = RUBRIC.model_copy(update={"system": None})  # stands for an invalid rubric
    outcome = grade_hand_in(task, rubric=broken, scratch=tmp_path)
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
    change(own, slip, typed)
    task = HandIn(id="team-0", key="k", sources=(own,))
    outcome = grade_hand_in(task, rubric=RUBRIC, scratch=tmp_path)
    assert outcome.authors == ("s0",)


def test_files_that_change_during_the_grading_are_not_graded(task, tmp_path, school):
    """If a file changes between the hash and the copy, the submission is left for the next run."""
    own = shutil.copytree(school / "team-0", tmp_path / "team-0")
    if sys.platform == "linux":  # only Linux allows this file name
        (own / "n\udcff").write_text("no name in any encoding", encoding="utf-8")
    known = replace(task, sources=(own,), digest=digest([own]))
    assert grade_hand_in(known, rubric=RUBRIC, scratch=tmp_path).status == "graded"
    unpacked(packed([own]), tmp_path / "travelled")  # as on a cluster
    there = replace(known, sources=(tmp_path / "travelled",))
    assert grade_hand_in(there, rubric=RUBRIC, scratch=tmp_path).status == "graded"
    (own / "notes.md").write_text("one more word", encoding="utf-8")
    outcome = grade_hand_in(known, rubric=RUBRIC, scratch=tmp_path)
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


@pytest.mark.slow
@pytest.mark.sample
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


def killed_within(rng, book, command):
    """Run a command and kill it, with its children, at a random point of its work.

    The point is chosen by the number of submissions graded, since machines differ in speed.
    """
    enough = n_graded(book) + rng.randrange(3)
    with started(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        until(lambda: process.poll() is not None or n_graded(book) >= enough)
        time.sleep(rng.uniform(0.0, 0.5))


@pytest.mark.slow
@pytest.mark.sample
def test_a_run_that_is_killed_can_be_continued(school, graded, tmp_path):
    """A run that is killed at random times and started again ends like an undisturbed one."""
    killed = tmp_path / "killed"
    command = [sys.executable, "-m", "pipeline", "grade", school, "--rubric", "throne-1dof",
               "--no-figures", "--out", killed]  # fmt: skip
    rng = random.Random(30)
    for _ in range(30):
        killed_within(rng, killed, [*command, "--jobs", "2"])
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr  # because team-3 cannot be graded
    assert "team-3/submission.toml" in done.stderr
    out, batch, rows, _ = graded
    with Gradebook(killed) as book:
        assert {e.submission: grade_text(e.grade) for e in book.entries()} == {
            name: text for name, (_, text) in rows.items()
        }
    with Gradebook(shutil.copytree(out, tmp_path / "whole")) as book:
        book.finish(batch, rubric=RUBRIC)
        write_outputs(book, tmp_path / "whole")
    for file in (p for p in (tmp_path / "whole").rglob("*") if p.is_file()):
        if file.suffix != ".sqlite":
            other = killed / file.relative_to(tmp_path / "whole")
            assert other.read_bytes() == file.read_bytes(), file.name
