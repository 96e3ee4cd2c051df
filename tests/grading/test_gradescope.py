"""The autograder's zip file runs in Gradescope's folders and writes the results for students."""

import json
import os
import re
import shutil
import site
import stat
import subprocess
import sys
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import ConfigError
from pipeline.grading import gradescope
from pipeline.grading.batch.runner import Grader
from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.grade import Grade, read_grade
from pipeline.grading.gradescope import pin_requirements, write_autograder
from pipeline.grading.gradings import Grading, HandIn
from pipeline.grading.rubric_file import load_rubric
from pipeline.resources import RUBRICS
from tests.helpers.commandline import cartlab_here
from tests.helpers.grades import in_this_process
from tests.helpers.grading_students import write_team
from tests.helpers.hostile import SECRET, write_hostile
from tests.helpers.waiting import PATIENCE

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Gradescope's machines run Linux")

RUBRIC = RUBRICS / "throne-1dof.toml"
TOP = {"score", "output", "output_format", "test_output_format", "test_name_format",
       "stdout_visibility", "tests", "extra_data"}  # fmt: skip
TEST = {"score", "max_score", "status", "name", "number", "output", "tags", "visibility"}
# Matches a computed number: at least one digit on each side of a decimal point.
NUMBER = re.compile(r"\d+\.\d+")


@pytest.fixture(scope="module")
def team(tmp_path_factory) -> Path:
    """Return a submission with one wrong number among its reported ones."""
    folder = tmp_path_factory.mktemp("team") / "lab"
    toml = write_team(folder, 5) / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    final = text.index("[reported.final]")
    wrong, n = re.subn(r"(?m)^K = .*$", "K = 12.3", text[final:], count=1)
    assert n == 1
    toml.write_text(text[:final] + wrong, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """Return Gradescope's folders after `setup.sh` was run, with the packages installed here."""
    root = tmp_path_factory.mktemp("autograder")
    write_autograder(RUBRIC, root / "autograder.zip")
    source = root / "source"
    with zipfile.ZipFile(root / "autograder.zip") as archive:
        archive.extractall(source)
    # `setup.sh` also calls pip, which finds every pinned version installed and downloads nothing.
    venv.create(source / "venv", symlinks=True)
    (own,) = (source / "venv").glob("lib/python*/site-packages")
    (own / "here.pth").write_text("\n".join(site.getsitepackages()), encoding="utf-8")
    done = start("bash", source / "setup.sh", PIP_NO_INDEX="1")
    assert done.returncode == 0, done.stderr
    shutil.copy(source / "run_autograder", root)
    (root / "run_autograder").chmod(0o755)
    return root


def start(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Start a program in another folder, so that it cannot import from this checkout."""
    return subprocess.run(
        list(map(str, command)),
        capture_output=True,
        text=True,
        encoding="utf-8",
        cwd="/",
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | environment,
        timeout=PATIENCE,
        check=False,
    )


@pytest.fixture(scope="module")
def shown(root, team) -> dict[str, Any]:
    """Return the autograder's result for the team's submission."""
    return upload(root, team)


def upload(root: Path, submission: Path) -> dict[str, Any]:
    """Upload a student's files, run the autograder as a program, and return its result."""
    put(root, submission)
    done = start(root / "run_autograder")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr + done.stdout
    return read_results(root)


def upload_here(root: Path, submission: Path, *, rubric: str = "") -> dict[str, Any]:
    """Grade the upload in this process, because starting a new process takes a second."""

    def grade(grader: Grader, task: HandIn) -> Grading:
        return next(in_this_process([task], grader._setup))

    put(root, submission, rubric=rubric)
    (root / "results").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Grader, "run", grade)
        assert gradescope.grade_upload(root) == ""
    return read_results(root)


def put(root: Path, submission: Path, *, rubric: str = "") -> None:
    """Put a student's files, and a rubric if one is given, into Gradescope's folders."""
    shutil.rmtree(root / "submission", ignore_errors=True)
    shutil.rmtree(root / "results", ignore_errors=True)
    if submission.is_dir() and not submission.is_symlink():
        shutil.copytree(submission, root / "submission", symlinks=True)
    else:
        (root / "submission").mkdir()
        shutil.copy(submission, root / "submission", follow_symlinks=False)
    (root / "submission_metadata.json").write_text(
        json.dumps({"created_at": "2030-01-09T10:00:00-07:00",
                    "assignment": {"due_date": "2030-01-01T10:00:00-07:00"}})
    )  # fmt: skip
    text = RUBRIC.read_text(encoding="utf-8")
    (root / "source" / "rubric.toml").write_text(rubric or text, encoding="utf-8")


def read_results(root: Path) -> dict[str, Any]:
    """Return `results.json` after checking it against Gradescope's specification."""
    results = json.loads((root / "results" / "results.json").read_text(encoding="utf-8"))
    assert set(results) == TOP
    assert isinstance(results["score"], float)
    assert results["stdout_visibility"] == "hidden"
    for test in results["tests"]:
        assert set(test) == TEST
        assert test["status"] in ("passed", "failed")
        assert test["visibility"] in ("visible", "after_due_date")
        assert 0 <= test["score"] <= test["max_score"]
    return results


def grade_here(submission: Path, scratch: Path) -> Grade:
    """Return the grade that `cartlab grade` gives."""
    task = HandIn(id="team", key="", sources=(submission,))
    return read_grade(grade_hand_in(task, rubric=load_rubric(RUBRIC), scratch=scratch).grade)


@pytest.mark.slow
@pytest.mark.sample
def test_a_submission_gets_the_points_of_cartlab_grade(shown, team, tmp_path):
    """Points and total equal those of `cartlab grade`, and lateness costs nothing.

    Each criterion is visible and has a message. Gradescope itself deducts points for late work.
    """
    results, grade = shown, grade_here(team, tmp_path)

    assert 0 < grade.points < grade.out_of
    assert results["score"] == grade.points
    assert results["score"] == pytest.approx(sum(test["score"] for test in results["tests"]))
    for test, criterion in zip(results["tests"], grade.criteria, strict=True):
        assert (test["score"], test["max_score"]) == (criterion.points, criterion.out_of)
        assert test["name"] == criterion.title
        assert test["visibility"] == "visible"
        assert test["output"]
    (wrong,) = [t for t in results["tests"] if t["tags"] == ["final-gains"]]
    assert (wrong["status"], wrong["score"]) == ("failed", 0.0)
    assert "12.3" in wrong["output"]
    assert "final_off" in results["extra_data"]["flags"]


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("form", ["one folder", "zip in the folder", "loose files"])
def test_all_ways_to_upload_have_the_same_result(root, team, shown, tmp_path, form):
    """A folder, an archive and loose files (without their folders) all give the same result."""
    given = tmp_path / "given"
    given.mkdir()
    if form == "one folder":
        shutil.copytree(team, given / "lab")
    elif form == "zip in the folder":
        shutil.make_archive(str(given / "lab"), "zip", team)
    else:
        for path in team.rglob("*.*"):
            shutil.copy(path, given)
    assert upload_here(root, given) == shown


def test_results_hide_computed_numbers_if_the_rubric_says_so(root, team, shown):
    """If the rubric says `see = "check"`, the results show no computed number.

    Points stay hidden until the due date.
    """
    hidden = upload_here(
        root, team, rubric=RUBRIC.read_text(encoding="utf-8") + '\n[students]\nsee = "check"\n'
    )

    assert hidden["score"] == shown["score"]
    assert any(NUMBER.search(test["output"]) for test in shown["tests"])
    assert not NUMBER.search(hidden["output"])
    assert not any(NUMBER.search(test["output"]) for test in hidden["tests"])
    assert {test["visibility"] for test in hidden["tests"]} == {"after_due_date"}
    assert "cartlab check" in hidden["output"]
    (wrong,) = [t for t in hidden["tests"] if t["tags"] == ["final-gains"]]
    assert "final value" in wrong["output"]


HOSTILE = (  # one archive of each kind; `tests/system/test_hostile.py` grades all of them
    "zip-00-a link.zip", "zip-05-escape 0.zip", "zip-14-ratio.zip", "zip-32-two.zip",
    "place-04-linked folder", "linked.zip",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.sample
def test_a_hostile_upload_gets_a_reason_and_reaches_no_other_file(root, team, tmp_path):
    """A hostile upload, such as a zip bomb or a link, gets a result that names the reason.

    No file outside the upload is read or written.
    """
    school = tmp_path / "school"
    school.mkdir()
    good = {p.relative_to(team).as_posix(): p.read_bytes() for p in team.rglob("*.*")}
    assert set(HOSTILE) <= set(write_hostile(school, good, seed=1, every=1))
    for name in HOSTILE:
        results = upload_here(root, school / name)
        assert results["score"] == 0.0, name
        assert results["tests"] == [], name
        assert SECRET not in json.dumps(results), name
    assert not list(tmp_path.rglob("escaped"))
    assert sorted(p.name for p in root.iterdir()) == [
        "autograder.zip", "results", "run_autograder", "source", "submission",
        "submission_metadata.json",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ((), "empty"),
        (("notes.md", "report.pdf"), "'notes.md', 'report.pdf'"),
        (("a/submission.toml", "b/submission.toml"), "'b/submission.toml'"),
    ],
)
def test_an_upload_without_a_submission_gets_the_reason(root, tmp_path, files, said):
    """An upload without `submission.toml`, or with two of them, gets 0 points and the reason."""
    for name in files:
        (tmp_path / "given" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "given" / name).touch()
    (tmp_path / "given").mkdir(exist_ok=True)
    results = upload_here(root, tmp_path / "given")
    assert (results["score"], results["tests"]) == (0.0, [])
    assert said in results["output"]


@pytest.mark.slow
@pytest.mark.sample
def test_code_in_an_upload_is_not_run(root, team, shown, tmp_path):
    """No code in an upload is run, even if its file is named like one that the grader uses."""
    given, mark = tmp_path / "given", tmp_path / "was-run"
    shutil.copytree(team, given)
    code = f"open({str(mark)!r}, 'w')\n"
    for name in ("sitecustomize.py", "numpy.py", "pipeline/__init__.py", "conftest.py"):
        (given / name).parent.mkdir(exist_ok=True)
        (given / name).write_text(code, encoding="utf-8")
    for name in ("setup.sh", "run_autograder", "venv/bin/python"):
        (given / name).parent.mkdir(parents=True, exist_ok=True)
        (given / name).write_text(f"#!/bin/sh\ntouch {mark}\n", encoding="utf-8")
        (given / name).chmod(0o755)
    (given / "results.json").write_text('{"score": 1000}', encoding="utf-8")
    assert upload(root, given) == shown
    assert not mark.exists()


def test_a_grader_that_is_killed_leaves_a_result(root, team):
    """If the grader is killed, the result has 0 points and says to submit again.

    In the test, the grader is killed because it has too little memory even to start.
    """
    put(root, team)
    done = start("bash", "-c", f"ulimit -v 100000; '{root}/run_autograder'")
    assert done.returncode != 0
    results = read_results(root)
    assert results["score"] == 0.0
    assert "submit again" in results["output"]


@pytest.mark.slow
@pytest.mark.sample
def test_a_grading_that_takes_too_long_is_stopped(root, team, monkeypatch):
    """If grading takes longer than cartlab's time limit, the result says so.

    Gradescope's own limit is longer; a grader that exceeds it leaves no result.
    """
    put(root, team)
    (root / "results").mkdir()
    monkeypatch.setattr(gradescope, "_TIME_LIMIT", 0.0)
    gradescope.grade_upload(root)
    results = read_results(root)
    assert results["score"] == 0.0
    assert "0 s" in results["output"]


# -------------------------------------------------------------------------------- the zip


def test_the_zip_is_reproducible_and_its_scripts_are_executable(tmp_path):
    """Two zip files for one rubric are equal byte by byte, and both scripts in them are executable.

    A rubric that ships with cartlab may be given by its name.
    """
    done = cartlab_here("export", "--autograder", "throne-1dof", cwd=tmp_path)
    assert done.returncode == 0
    points, late, wrote = done.stderr.splitlines()
    assert (points[-2:], "late" in late, wrote.split()[-1]) == ("20", True, "autograder.zip")
    write_autograder(RUBRIC, tmp_path / "again" / "a.zip")
    first = (tmp_path / "autograder.zip").read_bytes()
    assert (tmp_path / "again" / "a.zip").read_bytes() == first
    with zipfile.ZipFile(tmp_path / "autograder.zip") as archive:
        modes = {info.filename: info.external_attr >> 16 for info in archive.infolist()}
        assert archive.read("rubric.toml") == RUBRIC.read_bytes()
        pins = archive.read("requirements.txt").decode().splitlines()
        python = archive.read("python-version").decode().strip()
    for script in ("setup.sh", "run_autograder"):
        assert stat.S_IMODE(modes[script]) == 0o755
    assert pins[1:] == pin_requirements()
    assert python == f"{sys.version_info.major}.{sys.version_info.minor}"


def test_every_needed_package_is_pinned_to_its_installed_version():
    """Every package that grading needs, directly or indirectly, is pinned to its installed version.

    Packages that only the tests need are left out.
    """
    pins = dict(pin.split("==") for pin in pin_requirements())
    for name in ("numpy", "scipy", "h5py", "pydantic-core", "python-dateutil"):
        assert pins[name] == version(name)
    assert not {"cartlab", "pytest", "ruff", "colorama"} & set(pins)
    with pytest.raises(ConfigError, match="no-such-package"):  # its version is unknown
        pin_requirements("no-such-package-as-this")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("", "GRADES"),
        ("grades", "GRADES"),
        ("grades --autograder throne-1dof", "--out"),
        ("--autograder throne-1dof --lms canvas", "--out"),
        ("--autograder throne-9dof", "no such rubric"),
        ("--autograder throne-1dof --out folder", "zip"),
    ],
)
def test_export_refuses_arguments_that_do_not_go_together(tmp_path, arguments, said):
    """`export` accepts grades and a platform, or a rubric and a zip file, but no mixture."""
    done = cartlab_here("export", *arguments.split(), cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert not list(tmp_path.iterdir())
