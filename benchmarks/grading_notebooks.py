"""The one-cart lab as a notebook assignment, graded by nbgrader and by otter-grader.

It is the smallest assignment that asks for the same six numbers. A team types them into one cell,
and each number is compared with that of `lab_reference.py` from the team's recordings. Both tools
run on their command lines: nbgrader with `generate_assignment`, `autograde` and
`generate_feedback`; otter with `generate` and, without containers, `run`, on a submission zipped as
by `otter.export`.
"""

import json
import math
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit

from benchmarks.grading_batch import Cost, grade, measured, write_class
from benchmarks.page import installed
from pipeline.grading.gradebook.gradebook import Gradebook

PRESET = "throne-1dof"
COPIED = "a recording of another team"
_REFERENCE = Path(__file__).with_name("lab_reference.py")
_ASKED = [(table, name) for table in ("initial", "final") for name in ("K", "omega_n", "zeta")]
_CHECK = "from lab_reference import check\ncheck({table!r}, {name!r}, reported, dwells)"
_OTTER_TEST = """OK_FORMAT = False
from otter.test_files import test_case
name, points = "{table} {name}", 1
@test_case()
def test_number(reported, dwells):
    from lab_reference import check
    check("{table}", "{name}", reported, dwells)
"""

Numbers = dict[str, dict[str, float]]


def _times(table: str, **factors: float) -> Callable[[Numbers], None]:
    def slip(reported: Numbers) -> None:
        for name, factor in factors.items():
            reported[table][name] *= factor

    return slip


def _hertz(reported: Numbers) -> None:
    for table in reported.values():
        table["omega_n"] /= 2 * math.pi


# each kind of mistake, with the flag that names it
SLIPS: dict[str, Callable[[Numbers], None]] = {
    "hz_for_rad_s": _hertz,
    "log10_for_ln": _times("initial", zeta=math.log10(math.e)),
    "peak_to_peak": _times("initial", K=2.0),
    "peak_count": _times("initial", omega_n=5 / 4, zeta=4 / 5),
    "final_off": _times("final", K=1.3),
}


@dataclass(frozen=True, kw_only=True)
class Graded:
    """One tool's result for the class: its cost, the teams that lost points, the mistakes it named.

    `named` has the codes of each team's flags; it is empty for a tool without flags.
    """

    cost: Cost
    lost: frozenset[str]
    named: Mapping[str, frozenset[str]]


def write_teams(folder: Path, *, honest: int, each: int) -> dict[str, str]:
    """Write a class with `each` teams for every mistake; return the mistake of each team, or ""."""
    slips = [""] * honest + [slip for slip in (*SLIPS, COPIED) for _ in range(each)]
    write_class(folder, len(slips), preset=PRESET)
    teams = sorted(folder.iterdir())
    for team, slip in zip(teams, slips, strict=True):
        if slip == COPIED:
            for file in ("decay-1a.csv", "decay-1b.csv"):
                shutil.copyfile(teams[0] / "data" / file, team / "data" / file)
        elif slip:
            _change(team / "submission.toml", SLIPS[slip])
    return {team.name: slip for team, slip in zip(teams, slips, strict=True)}


def _change(file: Path, slip: Callable[[Numbers], None]) -> None:
    document = tomlkit.parse(file.read_text(encoding="utf-8"))
    reported: Any = document["reported"]
    numbers = {table: dict(reported[table].unwrap()) for table in ("initial", "final")}
    slip(numbers)
    for table, values in numbers.items():
        for name, value in values.items():
            if value != reported[table][name]:
                reported[table][name] = float(f"{value:.3g}")
    file.write_text(tomlkit.dumps(document), encoding="utf-8", newline="\n")


# ------------------------------------------------------------------------------- graders


def cartlab(folder: Path, base: Path) -> Graded:
    """Grade as `cartlab grade --jobs 1` does, with feedback and its figures."""
    cost = grade(folder, base / "cartlab", preset=PRESET, figures=True)
    lost, named = set(), {}
    with Gradebook(base / "cartlab") as book:
        for entry in book.entries():
            about = [c for c in entry.grade.criteria if c.id.startswith(("initial-", "final-"))]
            named[entry.submission] = frozenset(flag.code for flag in entry.grade.flags)
            if any(c.points < c.out_of for c in about):
                lost.add(entry.submission)
    return Graded(cost=cost, lost=frozenset(lost), named=named)


def nbgrader(folder: Path, base: Path) -> Graded | None:
    """Grade with nbgrader, feedback pages included; return None if it is not installed."""
    if not installed("nbgrader"):
        return None
    from nbgrader.api import Gradebook as Book  # pyright: ignore[reportMissingImports]

    course = base / "course"
    _put(course / "source" / "lab", _notebook(None))
    (course / "nbgrader_config.py").write_text(
        'c = get_config()\nc.CourseDirectory.course_id="lab"'
    )
    for team in sorted(folder.iterdir()):
        _put(course / "submitted" / team.name / "lab", _notebook(team), data=team / "data")
    _run("nbgrader", "generate_assignment", "lab", cwd=course)
    costs: list[Cost] = []
    with measured(costs):
        _run("nbgrader", "autograde", "lab", cwd=course)
        _run("nbgrader", "generate_feedback", "lab", cwd=course)
    with Book(f"sqlite:///{course / 'gradebook.db'}") as book:
        graded: list[Any] = book.assignment_submissions("lab")
        assert len(graded) == len(list(folder.iterdir()))
        lost = frozenset(one.student.id for one in graded if one.score < one.max_score)
    return Graded(cost=costs[0], lost=lost, named={})


def otter(folder: Path, base: Path) -> Graded | None:
    """Grade with otter-grader, one submission after another; return None if it is not installed."""
    if not installed("otter-grader"):
        return None
    tests = base / "otter" / "tests"
    tests.mkdir(parents=True)
    for table, name in _ASKED:
        text = _OTTER_TEST.format(table=table, name=name)
        (tests / f"{table}_{name}.py").write_text(text, encoding="utf-8")
    shutil.copy(_REFERENCE, tests.parent)
    plain = ("--no-requirements", "--no-environment", "--no-config")
    _run("otter", "generate", "-t", "tests", *plain, _REFERENCE.name, cwd=tests.parent)
    for team in sorted(folder.iterdir()):
        with zipfile.ZipFile(tests.parent / f"{team.name}.zip", "w") as packed:
            packed.writestr("lab.ipynb", json.dumps(_notebook(team, tested=False)))
            for file in (team / "data").iterdir():
                packed.write(file, f"data/{file.name}")
    costs, lost = list[Cost](), set()
    with measured(costs):
        for team in sorted(folder.iterdir()):
            out = tests.parent / team.name
            out.mkdir()
            _run("otter", "run", "--no-logo", "-o", out, f"{team.name}.zip", cwd=tests.parent)
    for team in sorted(folder.iterdir()):
        results = json.loads((tests.parent / team.name / "results.json").read_text())
        asked = [t for t in results["tests"] if t.get("max_score")]
        assert len(asked) >= len(_ASKED), results
        if any(t["score"] < t["max_score"] for t in asked):
            lost.add(team.name)
    return Graded(cost=costs[0], lost=frozenset(lost), named={})


def _run(module: str, *arguments: str | Path, cwd: Path) -> None:
    command = [sys.executable, "-m", module, *map(str, arguments)]
    programs = Path(sys.executable).parent  # nbgrader starts alembic by its name
    environment = os.environ | {"PATH": os.pathsep.join((str(programs), os.environ["PATH"]))}
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(f"{module} {arguments[0]}: {done.stderr[-2000:]}")


# ------------------------------------------------------------------------- the assignment


def _put(folder: Path, notebook: dict[str, Any], *, data: Path | None = None) -> None:
    folder.mkdir(parents=True)
    (folder / "lab.ipynb").write_text(json.dumps(notebook), encoding="utf-8")
    shutil.copy(_REFERENCE, folder)
    if data:
        shutil.copytree(data, folder / "data")


def _notebook(team: Path | None, *, tested: bool = True) -> dict[str, Any]:
    """Return the assignment with a team's answers and with nbgrader's tests."""
    answer = "reported = dwells = {}"
    if team:
        handed_in = tomllib.loads((team / "submission.toml").read_text(encoding="utf-8"))
        numbers = {t: handed_in["reported"][t] for t in ("initial", "final")}
        sines = [e for e in handed_in["experiments"] if e["kind"] == "sine"]
        dwells = {Path(e["file"]).name: e["frequency"] for e in sines}
        answer = f"reported = {numbers!r}\ndwells = {dwells!r}  # Hz"
    cells = [_cell("answer", answer, solution=True)]
    if tested:
        cells += [
            _cell(f"{table}-{name}", _CHECK.format(table=table, name=name), points=1)
            for table, name in _ASKED
        ]
    else:
        cells = [_cell("init", 'import otter\ngrader = otter.Notebook("lab.ipynb")'), *cells]
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}


def _cell(name: str, source: str, *, solution: bool = False, points: int = 0) -> dict[str, Any]:
    own: dict[str, Any] = {
        "grade_id": name,
        "grade": points > 0,
        "solution": solution,
        "locked": not solution,
        "schema_version": 3,
        "task": False,
    }
    return {
        "cell_type": "code",
        "id": name.replace("_", "-"),
        "execution_count": None,
        "metadata": {"nbgrader": own | ({"points": points} if points else {})},
        "outputs": [],
        "source": source,
    }
