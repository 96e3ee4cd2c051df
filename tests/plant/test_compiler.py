"""Compiled functions are stored on disk, and a change in a file that they use is noticed."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.plant.simulator import compiler
from tests.helpers.places import ROOT

SIMULATOR = Path("pipeline/plant/simulator")
CALLER = """
from pipeline.plant.simulator.compiler import jit
from pipeline.plant.simulator.called import inner

@jit
def outer(x):
    return inner(x) + 1
"""
CALLED = """
from pipeline.plant.simulator.compiler import inlined

@inlined
def inner(x):
    return {factor} * x
"""


@pytest.fixture
def package(tmp_path):
    """Return a copy of the package with two more compiled functions; one calls the other."""
    shutil.copytree(
        ROOT / "pipeline", tmp_path / "pipeline", ignore=shutil.ignore_patterns("__pycache__")
    )
    (tmp_path / SIMULATOR / "caller.py").write_text(CALLER)
    (tmp_path / SIMULATOR / "called.py").write_text(CALLED.format(factor=2))
    return tmp_path


def _outer(package: Path, **environment: str) -> tuple[str, str]:
    """Return the result of `outer(10)` in a new process, and its stderr."""
    script = "from pipeline.plant.simulator.caller import outer; print(outer(10))"
    environment = {**os.environ, "PYTHONPATH": str(package), **environment}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-B", "-c", script]
    done = subprocess.run(
        command, cwd=package, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip(), done.stderr


@pytest.mark.slow
@pytest.mark.sample
def test_a_change_in_another_file_is_noticed_and_the_old_folder_removed(package):
    """If a called function's file changes, the caller is compiled again.

    The previously compiled code is removed.
    """
    first = _outer(package)
    again = _outer(package)
    (package / SIMULATOR / "called.py").write_text(CALLED.format(factor=3))
    changed = _outer(package)

    assert (first[0], again[0], changed[0]) == ("21", "21", "31")
    word = "compiling the simulator, once on this computer: this takes about 20 s\n"
    assert (first[1], again[1], changed[1]) == (word, "", word)
    assert len(list((package / "pipeline/__pycache__/compiled").iterdir())) == 1


@pytest.mark.slow
@pytest.mark.sample
def test_in_a_read_only_package_the_users_cache_is_used(package):
    """If the package's folder is read-only, compiled code is stored in the user's cache."""
    (package / "pipeline" / "__pycache__").write_text("a file where the folder would be")
    home = package / "home"

    first = _outer(package, XDG_CACHE_HOME=str(home))
    again = _outer(package, XDG_CACHE_HOME=str(home))
    nowhere = _outer(package, XDG_CACHE_HOME="/dev/null")

    assert first[0] == again[0] == "21"
    assert "on this computer" in first[1]
    assert again[1] == ""
    assert list(home.glob("cartlab/compiled-*/simulator-*/*/caller.outer*.nbc"))
    assert nowhere[0] == "21"
    assert "cannot be stored" in nowhere[1]


def test_the_folders_name_covers_each_file_that_a_compiled_function_uses():
    """If a file changes that a compiled function uses, the name of its folder changes."""
    types_only = ROOT / "pipeline/arrays.py"
    rooms = set()
    for path in (ROOT / "pipeline").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        generates = path.name == "codegen.py"  # its own functions are not compiled
        if generates or not re.search(r"simulator\.compiler import (inlined|jit)", text):
            continue
        rooms.add(path.parent.name)
        covered = {*compiler.ROOM.glob("*.py"), *path.parent.glob("*.py"), types_only}
        nodes = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ImportFrom)]
        for name in (f"{node.module}" for node in nodes):
            if name.startswith("pipeline."):
                assert (ROOT / f"{name.replace('.', '/')}.py") in covered, (path, name)
    assert {"simulator", "pem"} <= rooms
