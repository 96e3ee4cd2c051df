"""One status says how far the numbers of a report may be used; every face shows it."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from decimal import Decimal

import pytest

from pipeline.desk.last_report import read_findings
from pipeline.estimation.estimates import list_off
from pipeline.json_files import json_text
from pipeline.report.builder import Page
from pipeline.report.document import Tiles
from pipeline.report.sections.summary import summary
from pipeline.results import Check, Finding, Skipped, Stage
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.examples import EXAMPLES

GOOD = replace(
    make_analysis(1, repeats=1),
    checks=(Check(kind="step", run="a", outcome="pass", message="it settles"),),
)
assert GOOD.fit is not None
BAD = Check(kind="step", run="b", outcome="fail", message="it does not settle")


@pytest.mark.parametrize(
    ("changes", "state", "count"),
    [
        ({}, "ok", 0),
        ({"reported_off": ("K_1",)}, "numbers_disagree", 1),
        ({"reported_off": ("K_1",), "checks": (BAD, BAD)}, "checks_failed", 2),
        ({"reported_off": ("K_1",), "checks": (BAD,), "fit": None}, "no_model", 0),
        ({"fit": replace(GOOD.fit, converged=False)}, "no_model", 0),
    ],
)
def test_the_status_is_the_worst_that_holds(changes, state, count):
    """No model is worse than a failed check, and this is worse than a typed number."""
    status = replace(GOOD, **changes).status
    assert (status.state, status.count) == (state, count)


@pytest.mark.parametrize("changes", [{}, {"checks": (BAD,)}, {"fit": None}])
def test_a_tile_shows_the_status(changes):
    """The summary's tile has the words of the status, and its tone."""
    analysis = replace(GOOD, **changes)
    boards = [block for block in summary(Page(analysis)) if isinstance(block, Tiles)]
    tiles = {plain(tile.label): tile for board in boards for tile in board.tiles}
    assert plain(tiles["Status"].value) == analysis.status.words
    assert tiles["Status"].tone == ("good" if analysis.status.is_fine else "bad")


@pytest.mark.parametrize(("share", "off"), [(1.0, False), (1.01, False), (1.2, True), (6.28, True)])
def test_a_typed_number_is_off_beyond_its_rounding_and_the_error(share, off):
    """A number within a few percent is right; a frequency in another unit is off."""
    (row,) = (row for row in GOOD.rows if row.name == "omega_n")
    assert row.final is not None
    typed = {"initial": {}, "final": {"omega_n": Decimal(f"{share * row.final.value:.4f}")}}
    assert list_off(GOOD.rows, typed) == (("omega_n",) if off else ())


@pytest.mark.slow
@pytest.mark.sample
def test_terminal_exit_code_files_and_desk_agree(tmp_path):
    """A number typed in another unit shows in the last line, the exit code and every file."""
    folder = tmp_path / "lab"
    shutil.copytree(EXAMPLES / "one-cart", folder)
    file = folder / "submission.toml"
    text = file.read_text(encoding="utf-8")
    in_hertz = re.sub(r"(?m)^omega_n = .*$", "omega_n = 2.1", text)
    for typed, state in ((text, "ok"), (in_hertz, "numbers_disagree")):
        file.write_text(typed, encoding="utf-8")
        done = subprocess.run(
            [sys.executable, "-m", "pipeline", "report", str(folder)],
            capture_output=True, encoding="utf-8", check=False,
        )  # fmt: skip
        results = json.loads((folder / "report" / "results.json").read_text(encoding="utf-8"))
        status = read_findings(folder)["status"]
        assert results["status"] == status.state == state
        assert done.returncode == (state != "ok")
        assert done.stderr.splitlines()[-1] == f"status: {status.words}"


def test_the_file_lists_every_finding():
    """A failed check, a skipped stage and a warning are each one entry, with code and subject."""
    skipped = Skipped(stage=Stage.BODE_FIT, cart=2, reason="no dwells")
    odd = Finding(code="quoted", run="b", details={"reason": "it differs"}, excludes="odd")
    bad = replace(BAD, value=3.0, limit=1.0, code="quoted")
    noted = replace(
        GOOD, checks=(bad,), skipped=(skipped,), warnings=("mind the gap",), left_out=(odd,),
        reported_off=("K",),
    )  # fmt: skip
    listed = json.loads(json_text(noted))["findings"]
    nobody = {"experiment": None, "cart": None, "parameter": None}
    assert [(one["code"], one["about"], one["value"], one["excludes"]) for one in listed] == [
        ("quoted", nobody | {"experiment": "b"}, 3.0, "odd"),
        ("number_off", nobody | {"parameter": "K"}, None, "no"),
        ("skipped", nobody | {"cart": 2}, None, "no"),
        ("warning", nobody, None, "no"),
    ]
