"""Imports go down only, stages stay apart, and each package has a home."""

import ast
from pathlib import Path

import pytest

PIPELINE = Path(__file__).parents[1] / "pipeline"

# From the ground up; a module imports from its own level (same package only) or below.
LEVELS = (
    ("__init__", "errors", "resources"),
    ("output", "schemas"),
    ("lock",),
    ("plant",),
    ("results", "submission"),
    ("ingest", "stages"),
    ("identify",),
    ("workflow", "synthesis", "results_json"),
    ("gap",),
    ("exchange", "report"),
    ("grading", "bench"),
    ("cli", "notebook"),
    ("__main__",),
)
HOMES = {
    "matplotlib": ("report",),
    "jinja2": ("report", "submission"),
    "typst": ("report",),
    "markdown_it": ("report",),
    "typer": ("cli",),
    "rich": ("cli", "bench"),
    "serial": ("bench",),
    "tomlkit": ("bench",),
    "starlette": ("bench",),
    "uvicorn": ("bench",),
    "control": ("plant", "stages", "notebook"),
    "sqlalchemy": ("grading",),
    "pandas": ("exchange", "grading", "notebook"),
}
MODULES = sorted(PIPELINE.rglob("*.py"))


def _top(path: Path) -> str:
    return path.relative_to(PIPELINE).parts[0].removesuffix(".py")


def _level(name: str) -> int:
    return next(i for i, names in enumerate(LEVELS) if name in names)


def _imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.append(node.module or "")
            if node.module in ("pipeline", "pipeline.stages"):
                found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PIPELINE)))
def test_imports_go_down_only(path):
    """A module imports from lower levels or its own package; every top name has a level."""
    level, package = _level(_top(path)), _top(path)
    for name in _imports(path):
        parts = name.split(".")
        if parts[0] != "pipeline" or len(parts) < 2 or parts[1].startswith("__"):
            continue
        below = _level(parts[1]) < level
        assert below or parts[1] == package, f"{path.name} imports {name}, which is not below it"


# A stage may share maths with others only through modules that are no stage.
STAGES = {
    "sine",
    "log_decrement",
    "step_gain",
    "frequency_response",
    "bode_fit",
    "time_fit",
    "compare",
    "initial",
    "state_feedback",
    "hardware_check",
    "faults",
    "repeats",
    "repeated_numbers",
}


@pytest.mark.parametrize("stage", sorted(STAGES))
def test_stages_never_import_each_other(stage):
    """Only the workflow knows the order of the stages."""
    others = {f"pipeline.stages.{other}" for other in STAGES - {stage}}
    assert not others & set(_imports(PIPELINE / "stages" / f"{stage}.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PIPELINE)))
def test_each_package_has_a_home(path):
    """Matplotlib is imported by the report, typer by the command line, and so on."""
    for name in _imports(path):
        homes = HOMES.get(name.split(".")[0])
        assert homes is None or _top(path) in homes, f"{path.name} imports {name}"
