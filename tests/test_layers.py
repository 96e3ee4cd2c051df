"""Imports go down only, no stage imports another stage, and outside packages stay in one place."""

import ast
from collections.abc import Sequence
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.helpers.places import ROOT

PIPELINE = ROOT / "pipeline"

# The packages and modules of `pipeline`, from the lowest level up. What is not listed counts to the
# package that contains it. A module imports only from its own level or from lower ones.
LEVELS = (
    (
        *("__init__", "arrays", "errors", "json_files", "lock", "names", "output"),
        *("processes", "protocol", "resources", "second_process", "setup", "startup", "web"),
        "words",
    ),
    ("plant",),
    ("results", "submission", "words.phrases"),
    ("estimation",),
    ("ingest",),
    ("identify", "workflow"),
    ("gap", "experiments"),
    (
        *("bench", "report", "simulated", "grading", "desk", "schemas", "cli", "notebook"),
        "__main__",
    ),
)
# The packages of the highest level that each of them may import; the others may import all.
OTHERS = {
    "bench": (),
    "simulated": (),
    "report": ("simulated", "grading"),
    "grading": ("report", "simulated", "grading"),
}
HOMES = {
    "matplotlib": ("report",),
    "jinja2": ("report.html", "submission", "desk", "plant.export"),
    "typst": ("report.pdf",),
    "markdown_it": ("report.sections",),
    "mdit_py_plugins": ("report.sections",),
    "latex2mathml": ("report.equations",),
    "typer": ("cli",),
    "rich": ("cli", "bench"),
    "serial": ("bench",),
    "tomlkit": ("submission", "ingest", "bench", "desk"),
    "starlette": ("web", "bench", "desk"),
    "uvicorn": ("web",),
    "control": ("plant", "notebook"),
    "sympy": ("plant.simulator.codegen",),
    "sqlalchemy": ("grading.gradebook",),
    "pandas": ("report", "grading", "notebook"),
}
MODULES = sorted(PIPELINE.rglob("*.py"))
# Modules of `estimation` that are no stages: stages share them, or they judge the fitted model.
HELPERS = {
    *("__init__", "decay_laws", "force_balance", "least_squares", "noise", "parametrisation"),
    "record_fit",
}
STAGES = sorted({path.stem for path in MODULES if path.parent.name == "estimation"} - HELPERS)


ROOMS = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}


def _level(parts: Sequence[str]) -> int:
    """Return the level of a module, given the parts of its path."""
    paths = (".".join(parts[:depth]) for depth in range(len(parts), 0, -1))
    return next(ROOMS[path] for path in paths if path in ROOMS)


@cache
def _imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            # If only modules are imported from a package, the package itself does not count.
            modules = all((ROOT / f"{name.replace('.', '/')}.py").exists() for name in names)
            found += names if modules else [node.module or "", *names]
    return found


def _inside(path: Path) -> list[tuple[str, ...]]:
    """Return the parts of the names that a module imports from `pipeline`."""
    split = [tuple(name.split(".")) for name in _imports(path)]
    return [p[1:] for p in split if p[0] == "pipeline" and len(p) > 1 and p[1][:2] != "__"]


def test_imports_go_down_only():
    """A module imports only from its own level or lower ones, and every module has a level."""
    upward = []
    for path in MODULES:
        me = path.relative_to(PIPELINE).with_suffix("").parts
        for other in _inside(path):
            apart = me[0] in OTHERS and other[0] not in (me[0], *OTHERS[me[0]])
            if _level(other) > _level(me) or (apart and _level(other) == _level(me)):
                upward.append(f"{path.relative_to(PIPELINE)} imports {'.'.join(other)}")
    assert upward == []


def test_no_module_imports_itself_through_others():
    """Imports at the top of modules have no cycles."""
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for path in MODULES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
        names = {f"{n.module}.{a.name}" for n in nodes for a in n.names} | {n.module for n in nodes}
        files = {ROOT / f"{name.replace('.', '/')}.py" for name in names if name}
        sorter.add(str(path), *(str(file) for file in files if file.exists()))
    sorter.prepare()  # raises `CycleError`


@pytest.mark.parametrize("stage", STAGES)
def test_stages_never_import_each_other(stage):
    """No stage imports another stage.

    Only the workflow knows their order; code that they share is in other modules.
    """
    others = {f"pipeline.estimation.{other}" for other in STAGES}
    assert not others & set(_imports(PIPELINE / "estimation" / f"{stage}.py"))


def test_each_outside_package_has_one_place():
    """Each outside package is imported only where `HOMES` allows, such as matplotlib in reports."""
    abroad = []
    for path in MODULES:
        place = ".".join(path.relative_to(PIPELINE).with_suffix("").parts) + "."
        for name in _imports(path):
            homes = HOMES.get(name.split(".")[0])
            if homes is not None and not any(place.startswith(f"{home}.") for home in homes):
                abroad.append(f"{path.relative_to(PIPELINE)} imports {name}")
    assert abroad == []


def test_no_module_is_long():
    """No module has over 600 lines of code, except the list of results."""
    assert [path.name for path in MODULES if _lines_of_code(path) > 600] == ["results.py"]


def _lines_of_code(path: Path) -> int:
    """Return the number of lines without docstrings, comments and blank lines."""
    text = path.read_text(encoding="utf-8")
    docstrings = {
        line
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node)
        for line in range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1)
    }
    lines = enumerate((line.strip() for line in text.splitlines()), start=1)
    return sum(bool(line) and line[0] != "#" and n not in docstrings for n, line in lines)


def test_test_folders_are_named_after_what_they_test():
    """Each test is in a folder named after what it tests.

    Exceptions are the tests of the whole program, statistics, benchmarks, and the helpers.
    """
    others = {"helpers", "truth", "system", "statistics", "benchmarks"}
    folders = {path.parent.relative_to(ROOT / "tests") for path in ROOT.glob("tests/**/test_*.py")}
    homeless = [str(f) for f in folders if f.parts and f.parts[0] not in others
                and not (PIPELINE / f).is_dir()]  # fmt: skip
    assert not homeless


def test_every_folder_is_a_package():
    """Each folder with modules has an `__init__.py`, by which the API pages find it."""
    folders = {path.parent for path in MODULES}
    assert [str(folder) for folder in folders if not (folder / "__init__.py").exists()] == []
