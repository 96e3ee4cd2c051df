"""No code extracts facts from sentences, ids or names that the program itself wrote."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.places import ROOT

PIPELINE = ROOT / "pipeline"
READERS = {
    "split",
    "rsplit",
    "partition",
    "rpartition",
    "startswith",
    "endswith",
    "removeprefix",
    "removesuffix",
}
# Attributes and variables that hold messages or ids.
MESSAGES = {"message", "reason", "stage", "id", "about", "note", "parameter", "warning",
        "partial"}  # fmt: skip
# In these packages the variables in PARAMETERS hold names of parameters, never names of files.
ROOMS = ("identify/", "report/equations/", "grading/mistakes/", "grading/judge/",
         "grading/reference.py", "grading/tolerance.py")  # fmt: skip
PARAMETERS = {"name", "omega", "zeta", "worst"}
# A reason may be split into lines, since each line is a separate fault.
ALLOWED = {'grade.reason.split("\\n")', 'reason.split("\\n")'}


def read_back(source: str, *, of_parameters: bool = False) -> list[str]:
    """Return the expressions in a module that extract a fact from a sentence, an id or a name."""
    names = MESSAGES - {"id"} | (PARAMETERS if of_parameters else set())
    found = (ast.unparse(node) for node in _readings(ast.parse(source), names))
    return [text for text in found if text.replace("'", '"') not in ALLOWED]


def _readings(tree: ast.Module, names: set[str]) -> Iterator[ast.expr]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            if node.func.attr in READERS and _is_message(node.func.value, names):
                yield node
        elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Load):
            if _is_part(node.slice) and _is_message(node.value, names):
                yield node
        elif isinstance(node, ast.Compare) and isinstance(node.ops[0], (ast.In, ast.NotIn)):
            text = isinstance(node.left, (ast.Constant, ast.JoinedStr))
            where = node.comparators[0]
            if text and isinstance(where, ast.Attribute) and where.attr in MESSAGES - {"id"}:
                yield node


def _is_message(node: ast.expr, names: set[str]) -> bool:
    if isinstance(node, ast.Attribute):
        return node.attr in MESSAGES
    return isinstance(node, ast.Name) and node.id in names


def _is_part(index: ast.expr) -> bool:
    """Return whether an index is a slice or a number, and so takes letters out of a text."""
    return isinstance(index, ast.Slice) or (
        isinstance(index, ast.Constant) and isinstance(index.value, int)
    )


MODULES = [path for path in sorted(PIPELINE.rglob("*.py")) if path != PIPELINE / "names.py"]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PIPELINE)))
def test_no_fact_is_extracted_from_words(path: Path):
    """Only `names.py` splits names; no module splits messages, ids or stage names."""
    place = path.relative_to(PIPELINE).as_posix()
    of_parameters = place.startswith(ROOMS)
    assert read_back(path.read_text(encoding="utf-8"), of_parameters=of_parameters) == []


@pytest.mark.parametrize(
    "slip",
    [
        'check.message.split(": ", 1)[-1]',
        'check.id.rpartition("-")[2]',
        'check.id.partition(".")[0] in kinds',
        '"estimates" in one.stage',
        's.stage.startswith("hardware")',
        'outcome.partial.endswith("by hand")',
        'omega.removesuffix("_n")',
        "kinds = {name[0] for name in names}",
        'looks.get(worst[0], "look")',
        'symbol = name.partition("_")[0]',
    ],
)
def test_earlier_slips_are_found(slip: str):
    """`read_back` finds each of these lines, which once were in the program."""
    assert read_back(slip, of_parameters=True)
