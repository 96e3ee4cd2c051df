"""A submission gives the same results whatever program saved its recordings."""

import csv
import json
import shutil
from pathlib import Path

import pytest

from pipeline.ingest.files import read_table
from pipeline.json_files import json_text
from pipeline.resources import RUBRICS
from pipeline.simulated.submission import Students, write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.commandline import cartlab_here
from tests.helpers.recordings import lvm, tdms_of, xlsx

FORMS = {"xlsx": xlsx, "tdms": tdms_of, "lvm": lvm}


@pytest.fixture(scope="module")
def teams(tmp_path_factory) -> Path:
    """Write a class with one team's work in several copies, each in a different file format."""
    root = tmp_path_factory.mktemp("forms")
    folder = root / "csv"
    write_submission(
        folder, "throne-1dof", seed=5, compact=True, reported=True,
        students=Students(authors=("s1",)),
    )  # fmt: skip
    for form, write in FORMS.items():
        other = shutil.copytree(folder, root / form)
        for file in sorted((other / "data").iterdir()):
            table, _ = read_table(other, f"data/{file.name}")
            columns = dict(zip(table.names, table.values, strict=True))
            file.with_suffix(f".{form}").write_bytes(write(columns))
            file.unlink()
        toml = other / "submission.toml"
        text = toml.read_text(encoding="utf-8").replace('.csv"', f'.{form}"')
        toml.write_text(text.replace('"s1"', f'"s-{form}"'), encoding="utf-8")
    return root


@pytest.mark.slow
@pytest.mark.sample
def test_the_results_have_the_same_numbers(teams):
    """CSV, Excel and TDMS files of the same recordings give equal parameters and checks."""
    told = {}
    for one in ("csv", "xlsx", "tdms"):
        results = json.loads(json_text(analyse(load_submission(teams / one))))
        told[one] = {key: results[key] for key in ("parameters", "checks", "chain", "hardware")}
    assert told["xlsx"] == told["tdms"] == told["csv"]


@pytest.mark.slow
@pytest.mark.sample
def test_the_grade_has_the_same_points(teams, tmp_path):
    """All formats get the same points, even LabVIEW's with six decimals; copies are flagged."""
    out = tmp_path / "grades"
    rubric = RUBRICS / "throne-1dof.toml"
    done = cartlab_here("grade", teams, "--rubric", rubric, "--out", out, "--jobs", 1,
                        "--no-figures")  # fmt: skip
    assert done.returncode == 0, done.stderr
    with (out / "grades.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["submission"]: row for row in csv.DictReader(file)}
    assert sorted(rows) == ["csv", *sorted(FORMS)]
    assert {row["points"] for row in rows.values()} == {rows["csv"]["points"]}
    for name in ("csv", "xlsx", "tdms"):
        grade = json.loads((out / "feedback" / name / "grade.json").read_text(encoding="utf-8"))
        assert "shared_data" in [flag["code"] for flag in grade["flags"]], name


def test_inspect_and_fill_know_every_form(teams, tmp_path):
    """`inspect` and `fill` read a folder of recordings in every file format."""
    for form in FORMS:
        shutil.copytree(teams / form / "data", tmp_path / form / "data")
        done = cartlab_here("inspect", tmp_path / form, "--json")
        assert done.returncode == 0, done.stderr
        for row in json.loads(done.stdout):
            assert row["state"] == "read"
            assert row["unusable"] == []
        filled = cartlab_here("fill", tmp_path / form, "--json")
        assert filled.returncode == 0, filled.stderr
        assert {row["state"] for row in json.loads(filled.stdout)} == {"new"}
