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


def test_parameters_follow_the_papers_table(results):
    """The parameters are in the order of the paper's Table 2, with units and both estimates."""
    rows = results["parameters"]
    assert [row["name"] for row in rows] == [
        "K_1",
        "K_2",
        "omega_a",
        "omega_b",
        "zeta_a",
        "zeta_b",
        "omega_1",
        "omega_2",
        "zeta_1",
        "zeta_2",
    ]
    first = rows[0]
    assert (first["unit"], first["initial_from"], first["final_from"]) == (
        "cm/V",
        "step",
        "bode_fit",
    )
    expected = 100 * (first["final"] / first["initial"] - 1)
    assert first["change_percent"] == pytest.approx(expected, rel=1e-6)


def test_shapes_agree_with_the_number_of_carts(results):
    """Matrices, gains and poles have the right sizes for two carts."""
    space = results["state_space"]
    assert [len(space["A"]), len(space["A"][0]), len(space["B"]), len(space["B"][0])] == [
        4,
        4,
        4,
        1,
    ]
    assert len(results["feedback"]["gains"]) == 4
    assert all(len(pole) == 2 for pole in results["feedback"]["poles"])
    assert [len(results["chain"][key]) for key in "mck"] == [2, 2, 3]


def test_hardware_has_one_entry_per_run_and_cart(results):
    """`hardware` has one entry per closed-loop run and cart, each with an error below 5 %."""
    keys = [(entry["experiment"], entry["cart"]) for entry in results["hardware"]]
    assert len(keys) == len(set(keys)) == 2
    assert all(entry["loop"] == "closed" for entry in results["hardware"])
    assert all(entry["measured_input"]["nrmse"] < 0.05 for entry in results["hardware"])


def test_every_data_file_has_its_hash(results):
    """results.json lists each file named in the submission with its SHA-256."""
    files = results["provenance"]["files"]
    assert {p.name for p in (EXAMPLES / "two-cart" / "data").iterdir()} == {
        name.rpartition("/")[2] for name in files
    }
    assert all(len(digest) == 64 for digest in files.values())
