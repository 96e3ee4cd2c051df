"""Imports go down only, stages stay apart, and each package has a home."""

import ast
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import pytest

from tests.helpers.places import ROOT

PIPELINE = ROOT / "pipeline"

# From the ground up, rooms and the rooms within them; a module imports from its own room or below.
LEVELS = (
    ("__init__", "arrays", "errors", "names", "resources", "plant.limits"),
    ("output", "results_of_runs", "schemas"),
    ("lock", "processes", "web"),
    ("plant.linear",),
    ("plant.loop", "plant.nonlinear.tables"),
    ("plant.nonlinear.effects", "plant.nonlinear.simulator"),
    ("plant", "plant.nonlinear"),
    ("results", "submission"),
    ("ingest.formats", "estimation.limits", "identify.limits", "stages.limits"),
    ("ingest", "estimation"),
    ("estimation.decay", "estimation.chain"),
    ("stages",),
    ("checks",),
    ("identify.soundness",),
    ("identify",),
    ("workflow", "synthesis", "results_json"),
    ("gap.types", "gap.limits", "gap.data"),
    ("gap.fit",),
    ("gap.search",),
    ("gap.verdict",),
    ("gap",),
    ("exchange", "report.math", "bench"),
    ("report",),
    ("report.figures", "report.equations"),
    ("report.render",),
    ("report.sections",),
    ("report.gap", "report.effects"),
    ("report.draft",),
    ("report.solution",),
    ("grading", "bench.protocol"),
    ("bench.planning", "bench.emulator"),
    ("bench.live",),
    ("bench.host", "grading.intake", "grading.references"),
    ("bench.design", "grading.mistakes", "grading.similarity"),
    ("grading.judge", "grading.gradebook"),
    ("grading.publish",),
    ("grading.batch",),
    ("desk",),
    ("desk.student", "desk.bench", "desk.grades", "desk.instructor"),
    ("desk.app",),
    ("cli", "notebook"),
    ("__main__",),
)
HOMES = {
    "matplotlib": ("report",),
    "jinja2": ("report.render", "submission", "desk"),
    "typst": ("report.render",),
    "markdown_it": ("report.sections",),
    "typer": ("cli",),
    "rich": ("cli", "bench.live"),
    "serial": ("bench.host",),
    "tomlkit": ("submission", "ingest", "bench.host", "desk.student"),
    "starlette": ("web", "bench.live", "desk"),
    "uvicorn": ("web",),
    "control": ("plant.linear", "plant.loop", "checks", "notebook"),
    "sqlalchemy": ("grading.gradebook",),
    "pandas": ("exchange", "grading", "notebook"),
}
MODULES = sorted(PIPELINE.rglob("*.py"))


ROOMS = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}


def _room(parts: Sequence[str]) -> str:
    """Return the innermost room of a module given by its path below `pipeline`."""
    paths = (".".join(parts[:depth]) for depth in range(len(parts), 0, -1))
    return next(path for path in paths if path in ROOMS)


@cache
def _imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.append(node.module or "")
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PIPELINE)))
def test_imports_go_down_only(path):
    """A module imports from lower rooms or its own; every room has a level."""
    room = _room(path.relative_to(PIPELINE).with_suffix("").parts)
    names = _imports(path)
    for name in names:
        parts = name.split(".")
        if any(other.startswith(f"{name}.") for other in names):
            continue  # `from package import module`: the module has a room
        if parts[0] != "pipeline" or len(parts) < 2 or parts[1].startswith("__"):
            continue
        other = _room(parts[1:])
        below = ROOMS[other] < ROOMS[room]
        assert below or other == room, f"{path.name} imports {name}, which is not below it"


# The ten, in the order of the pipeline; what they share lives in `estimation`.
STAGES = (
    "log_decrement",
    "step_gain",
    "sine",
    "frequency_response",
    "initial",
    "bode_fit",
    "time_fit",
    "compare",
    "state_feedback",
    "hardware_check",
)


def test_the_stages_have_their_folder_to_themselves():
    """One file each, and nothing else but the table of their limits."""
    found = {path.stem for path in (PIPELINE / "stages").rglob("*.py")}
    assert found - {"__init__", "limits"} == set(STAGES)


@pytest.mark.parametrize("stage", STAGES)
def test_stages_never_import_each_other(stage):
    """Only the workflow knows the order of the stages."""
    others = {f"pipeline.stages.{other}" for other in STAGES if other != stage}
    assert not others & set(_imports(PIPELINE / "stages" / f"{stage}.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PIPELINE)))
def test_each_package_has_a_home(path):
    """Matplotlib is imported by the report, typer by the command line, and so on."""
    place = ".".join(path.relative_to(PIPELINE).with_suffix("").parts) + "."
    for name in _imports(path):
        homes = HOMES.get(name.split(".")[0])
        at_home = homes is None or any(place.startswith(f"{home}.") for home in homes)
        assert at_home, f"{path.name} imports {name}"


def test_tests_stand_in_folders_named_as_what_they_test():
    """Beside those of the whole system, of statistics, and what tests are made with."""
    others = {"helpers", "truth", "system", "statistics"}
    folders = {path.parent.relative_to(ROOT / "tests") for path in ROOT.glob("tests/**/test_*.py")}
    homeless = [str(f) for f in folders if f.parts and f.parts[0] not in others
                and not (PIPELINE / f).is_dir()]  # fmt: skip
    assert not homeless
