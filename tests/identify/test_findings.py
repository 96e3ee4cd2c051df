"""Every finding has one sentence, and its check and its entry among the left-out agree."""

import ast
from collections.abc import Iterator

import pytest

from pipeline.json_files import json_text, plain, read_json
from pipeline.results import Finding
from pipeline.words.phrases import phrases
from tests.helpers.places import ROOT


def codes() -> Iterator[tuple[str, str]]:
    """Yield each code of a finding in the source, with the module and line."""
    for path in (ROOT / "pipeline" / "identify").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            values: list[ast.expr] = []
            if isinstance(node, ast.Call):
                values = [word.value for word in node.keywords if word.arg == "code"]
                if getattr(node.func, "id", "") == "say":
                    values += node.args
            elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "code":
                values = [node.value]
            for value in values:
                ends = [value.body, value.orelse] if isinstance(value, ast.IfExp) else [value]
                for end in ends:
                    if isinstance(end, ast.Constant):
                        yield str(end.value), f"{path.name}:{end.lineno}"


def test_every_code_has_a_sentence():
    """Every code is a key of the catalogue; `test_every_sentence_is_used` tests the reverse."""
    sentences, found = phrases("findings").by_key, dict(codes())
    assert {code: where for code, where in found.items() if code not in sentences} == {}
    assert len(found) > 40  # so that this test cannot pass by finding no codes


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
