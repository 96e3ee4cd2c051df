"""The search for effects uses their properties, never their names."""

import ast
from pathlib import Path

import pytest

import pipeline.gap
from pipeline.plant.catalogue import CATALOGUE

MODULES = sorted(Path(pipeline.gap.__path__[0]).rglob("*.py"))
NAMES = {name for effect in CATALOGUE for name in (effect.key, effect.family) if name}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_the_search_names_no_effect(path):
    """The code of the search names no effect and no family of effects."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    written = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert not NAMES & {text for text in written if isinstance(text, str)}
