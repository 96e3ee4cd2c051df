"""Every finding has one sentence, and its check and its entry among the left-out agree."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.json_files import json_text, plain, read_json
from pipeline.results import Check, Finding
from pipeline.words.phrases import phrases
from tests.helpers.places import ROOT

RESULTS = ROOT / "pipeline" / "results.py"
WRITERS = [
    *sorted((ROOT / "pipeline" / "identify").glob("*.py")),
    ROOT / "pipeline" / "grading" / "true_bench.py",
]


def keys_in(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the keys of sentences in a module, each with its table: codes, and parts for `say`.

    A string that is not an argument of `say` may be a code.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    said: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            is_say = getattr(node.func, "id", "") == "say"
            values = [("findings", word.value) for word in node.keywords if word.arg == "code"]
            values += [("parts", value) for value in node.args if is_say]
            said |= {one for _, value in values if is_say for one in ast.walk(value)}
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "code":
            values = [("findings", node.value)]
        else:
            continue
        for table, value in values:
            ends = [value.body, value.orelse] if isinstance(value, ast.IfExp) else [value]
            yield from ((table, str(e.value)) for e in ends if isinstance(e, ast.Constant))
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in said:
            yield "perhaps", node.value


def test_every_code_has_a_sentence_and_every_sentence_a_code():
    """Codes and parts are keys of their tables; no sentence of a finding is without its code."""
    found = {key for path in (*WRITERS, RESULTS) for key in keys_in(path)}
    for table, fewest in (("findings", 40), ("parts", 15)):
        sentences = phrases("findings", table).by_key
        # Entries of `Analysis.findings` without a sentence here.
        listed = {"skipped", "warning", "number_off"}
        keys = {key for of, key in found if of == table and key} - listed
        assert keys <= sentences.keys()
        assert len(keys) > fewest  # so that this test cannot pass by finding no keys
    assert phrases("findings", "findings").by_key.keys() <= {
        k for of, k in found if of == "perhaps"
    }


@pytest.mark.parametrize("excludes", ["odd", "wrong"])
def test_a_finding_is_seen_the_same_everywhere(excludes):
    """A finding about a cart of a recording gives a failed check and an entry with its reason."""
    finding = Finding(code="never_changes", run="step-1", cart=2, value=3.0, excludes=excludes)
    check = finding.check
    assert (check.id, check.outcome, check.value) == ("record.step-1.cart_2", "fail", 3.0)
    assert check.message == f"step-1: {finding.reason}"
    entry = {"experiment": "step-1", "reason": finding.reason, "is_wrong": excludes == "wrong"}
    assert plain(finding) == entry
    again = read_json(Finding, json_text(finding))
    assert (plain(again), again.excludes) == (entry, excludes)


def test_a_finding_about_the_set_up_names_no_recording():
    """Without a recording, the message is the sentence alone."""
    finding = Finding(code="tied", kind="springs", parameter="k_3", details={"last": "2-wall"})
    assert finding.check.id == "springs.k_3"
    assert finding.check.message == finding.reason


def test_a_check_of_a_file_is_the_same_check():
    """A check keeps its id, numbers and message when its file is read and written again."""
    finding = Finding(code="tied", kind="springs", parameter="k_3", details={"last": "2-wall"})
    again = read_json(Check, text := json_text(finding.check))
    assert json_text(again) == text
    assert (again.kind, again.is_cause) == ("springs", True)
