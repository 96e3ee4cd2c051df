"""results.json has the documented form, plain numbers only, and the same bytes every time."""

import json
import re

import pytest

from pipeline.json_files import json_text
from pipeline.resources import EXAMPLES
from tests.helpers.examples import analysed
from tests.helpers.places import ROOT


@pytest.fixture(scope="module")
def results():
    def refuse(token):
        raise AssertionError(f"{token} is not JSON")

    text = json_text(analysed("two-cart"))
    return json.loads(text, parse_constant=refuse)


def test_results_json_has_every_documented_key(results):
    """results.json has all top-level keys in the documented order, and the schema's name."""
    assert results["schema"] == "cartlab-results/1"
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8").split("\n## ")[0]
    assert list(results) == re.findall(r"^- \*\*`(\w+)`\*\*:", page, re.MULTILINE)


def test_every_data_file_has_its_hash(results):
    """results.json lists each file named in the submission with its SHA-256."""
    files = results["provenance"]["files"]
    assert {p.name for p in (EXAMPLES / "two-cart" / "data").iterdir()} == {
        name.rpartition("/")[2] for name in files
    }
    assert all(len(digest) == 64 for digest in files.values())
