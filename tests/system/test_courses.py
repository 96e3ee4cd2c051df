"""The example assignments for notebook courses, from the teacher's notebook to the points."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from pipeline.grading.self_check.answers import read_answers
from pipeline.simulated.submission import write_submission
from tests.helpers.places import ROOT
from tests.helpers.waiting import PATIENCE

NEEDED = {"nbgrader": "nbgrader", "otter": "otter-grader"}
ANSWERS = {
    "right": """
initial = {"K": 29.0, "omega_n": 13.3, "zeta": 0.0913}
final = {"K": 28.9, "omega_n": 13.2, "zeta": 0.101}
""",
    "in-hertz": """
initial = {"K": 29.0, "omega_n": 2.12}
final = {"K": 28.9, "omega_n": 2.1, "zeta": 0.101}
""",
}
# One point per right number. The second answer has wrong frequencies and lacks one damping ratio.
POINTS = {"right": 6.0, "in-hertz": 3.0}
# The text that the tools put in place of a solution.
_PLACE = re.compile(
    r"# YOUR CODE HERE\nraise NotImplementedError\(\)|initial = \.\.\.\nfinal = \.\.\."
)


def need(tool: str) -> None:
    """Skip the test if a tool is not installed."""
    if find_spec(tool) is None:
        pytest.skip(f"{NEEDED[tool]} is not installed")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory) -> Path:
    """Return a student's recordings, for which the numbers in ANSWERS["right"] are correct."""
    folder = tmp_path_factory.mktemp("bench") / "recordings"
    write_submission(folder, "throne-1dof", seed=7, compact=True)
    return folder


@pytest.fixture
def run(tmp_path, monkeypatch) -> Callable[..., str]:
    """Return a function that runs a program of this environment with a home folder of its own."""
    jupyter = (f"JUPYTER_{what}_DIR" for what in ("CONFIG", "DATA", "RUNTIME"))
    for name in ("HOME", "IPYTHONDIR", *jupyter):
        monkeypatch.setenv(name, str(tmp_path / "home"))
    path = (str(Path(sys.executable).parent), os.environ["PATH"])
    monkeypatch.setenv("PATH", os.pathsep.join(path))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))

    def run_module(module: str, *arguments: str | Path, cwd: Path) -> str:
        done = subprocess.run(
            [sys.executable, "-m", module, *map(str, arguments)],
            capture_output=True,
            text=True,
            cwd=cwd,
            timeout=PATIENCE,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run_module


def fill_in(released: Path, handed_in: Path, answers: str) -> None:
    """Write the notebook that a student hands in: the released one, with answers filled in."""
    notebook = json.loads(released.read_text(encoding="utf-8"))
    (own,) = [one for one in notebook["cells"] if _PLACE.search("".join(one["source"]))]
    own["source"] = _PLACE.sub(answers, "".join(own["source"]))
    handed_in.parent.mkdir(parents=True, exist_ok=True)
    handed_in.write_text(json.dumps(notebook), encoding="utf-8")


@pytest.mark.slow
@pytest.mark.sample
def test_nbgrader_gives_a_point_per_right_number(recordings, run, tmp_path):
    """Nbgrader hides the solution and scores each number against the student's own recordings."""
    need("nbgrader")
    course = tmp_path / "course"
    (course / "source" / "lab").mkdir(parents=True)
    shutil.copy(ROOT / "docs" / "course-nbgrader.ipynb", course / "source" / "lab" / "lab.ipynb")
    (course / "nbgrader_config.py").write_text(
        'c = get_config()\nc.CourseDirectory.course_id = "controls"\n', encoding="utf-8"
    )
    run("nbgrader", "generate_assignment", "lab", cwd=course)
    released = course / "release" / "lab" / "lab.ipynb"
    assert "13.3" not in released.read_text(encoding="utf-8")
    for student, answers in ANSWERS.items():
        handed_in = course / "submitted" / student / "lab"
        fill_in(released, handed_in / "lab.ipynb", answers)
        shutil.copytree(recordings, handed_in / "recordings")

    run("nbgrader", "autograde", "lab", cwd=course)

    run("nbgrader", "export", "--to", "grades.csv", cwd=course)
    with (course / "grades.csv").open(encoding="utf-8", newline="") as file:
        scores = {row["student_id"]: float(row["score"]) for row in csv.DictReader(file)}
    assert scores == POINTS
    graded = course / "autograded" / "in-hertz" / "lab"
    shown = (graded / "lab.ipynb").read_text(encoding="utf-8")
    assert "2 of 5" in shown
    assert "13.3" not in shown  # the value that the student should have found
    assert [answer.disagree for answer in read_answers(graded / "recordings")] == [
        ("initial.omega_n", "final.omega_n")
    ]


@pytest.mark.slow
@pytest.mark.sample
def test_otter_gives_a_point_per_right_number(recordings, run, tmp_path):
    """Otter hides the solution and scores each number of the zip that a notebook exports."""
    need("otter")
    shutil.copy(ROOT / "docs" / "course-otter.ipynb", tmp_path / "lab.ipynb")
    run("otter", "assign", "lab.ipynb", "dist", cwd=tmp_path)
    released = tmp_path / "dist" / "student" / "lab.ipynb"
    (autograder,) = (tmp_path / "dist" / "autograder").glob("*.zip")
    assert "13.3" not in released.read_text(encoding="utf-8")
    for student, answers in ANSWERS.items():
        own = tmp_path / student
        fill_in(released, own / "lab.ipynb", answers)
        shutil.copytree(recordings, own / "recordings")
        run("nbconvert", "--execute", "--allow-errors", "--to", "notebook", "--inplace",
            "lab.ipynb", cwd=own)  # fmt: skip
        (exported,) = own.glob("lab_*.zip")
        with zipfile.ZipFile(exported) as archive:
            assert "recordings/submission.toml" in archive.namelist()

        run("otter", "run", "--no-logo", "-a", autograder, "-o", own, exported, cwd=own)

        results = json.loads((own / "results.json").read_text(encoding="utf-8"))
        (numbers,) = [test for test in results["tests"] if test["name"] == "numbers"]
        assert (numbers["score"], numbers["max_score"]) == (POINTS[student], 6.0)
