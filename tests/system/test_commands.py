"""The commands as people use them: exit status, one clear line, files in the right place."""

import html
import json
import re
import shutil
import subprocess
import sys

import pytest

from pipeline.resources import EXAMPLES
from tests.helpers.commandline import cartlab, cartlab_here

README = EXAMPLES.parent / "README.md"


def _commands():
    from typer.main import get_command

    from pipeline.cli import app

    return sorted(get_command(app).commands)  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("command", _commands())
def test_every_command_has_help_and_is_in_the_readme(command):
    """Each command has a `--help` text, and the README names the command."""
    done = cartlab_here(command, "--help")
    assert done.returncode == 0
    assert "Usage" in done.stdout
    if README.exists():  # the README is absent only if the tests run against an installed wheel
        assert f"`cartlab {command}" in README.read_text(encoding="utf-8")


def test_a_command_loads_only_what_it_needs():
    """`--help` loads no numpy, `report` no effects, and `grade` leaves the analysis to workers."""
    for module, unneeded in (
        ("cli", {"numpy"}),
        ("report.make_report", {"pipeline.plant.catalogue", "scipy.ndimage", "control"}),
        ("grading.batch.grade_class", {"pipeline.workflow", "scipy.linalg", "pandas"}),
    ):
        code = f"import sys, pipeline.{module}; print({unneeded} & set(sys.modules))"
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == "set()"


def test_only_the_second_process_of_a_report_draws(tmp_path):
    """The process of `report` itself loads no matplotlib: that would take time twice."""
    code = (
        "import sys; from typer.testing import CliRunner; from pipeline.cli import app; "
        f"done = CliRunner().invoke(app, ['report', {str(EXAMPLES / 'one-cart')!r}, "
        f"'--out', {str(tmp_path / 'out')!r}]); print(done.exit_code, 'matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "False"]


def test_report_writes_all_files(tmp_path):
    """For a consistent submission `report --json` writes all files and ends with status 0."""
    out = tmp_path / "out"
    done = cartlab("report", EXAMPLES / "one-cart", "--out", out, "--json")
    assert done.returncode == 0
    assert done.stdout == (out / "results.json").read_text(encoding="utf-8")
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    assert "<html" in (out / "report.html").read_text(encoding="utf-8")
    assert json.loads(done.stdout)["submission"]["carts"] == 1
    assert list((out / "figures").glob("*.svg"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["report", "no-such-folder"], "no-such-folder"),
        (["inspect", "no-such-file.csv"], "no-such-file.csv"),
        (["simulate", "--preset", "throne-9dof", "--out", "x"], "throne-3dof"),
        (["report", str(EXAMPLES / "one-cart"), "--out", "blocked"], "is a file"),
        (["new", "blocked", "--carts", "2"], "blocked"),
        (
            ["new", "team", "--carts", "9"],
            "'--carts': expected at most 4, found '9' (cartlab new -",
        ),
        (["report"], "DIR"),
        (["rport"], "rport"),
        (["report", "fresh"], "[[experiments]]"),  # a folder fresh from `new`
    ],
)
def test_a_command_that_cannot_run_is_one_line_and_status_two(tmp_path, arguments, expected):
    """A wrong name or a blocked path gives one line on stderr that names it, and exit status 2."""
    (tmp_path / "blocked").write_text("in the way")
    if "fresh" in arguments:
        assert cartlab_here("new", "fresh", "--carts", "2", cwd=tmp_path).returncode == 0
    done = cartlab_here(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_failed_checks_are_status_one(tmp_path):
    """If the steps have a wrong scale, the report is still written, but the exit status is 1."""
    folder = tmp_path / "scaled"
    shutil.copytree(EXAMPLES / "one-cart", folder)
    for file in (folder / "data").glob("step-*.csv"):
        lines = file.read_text(encoding="utf-8").splitlines()
        head = lines[0].split(",")
        column = head.index("x1")
        rows = [line.split(",") for line in lines[1:]]
        for row in rows:
            row[column] = f"{2 * float(row[column]):.5f}"
        file.write_text("\n".join([lines[0], *map(",".join, rows)]) + "\n", encoding="utf-8")
    done = cartlab_here("report", folder, "--no-pdf", "--json")
    checks = {check["id"]: check["outcome"] for check in json.loads(done.stdout)["checks"]}
    assert checks["record.step-1"] == "fail"
    assert done.returncode == 1


@pytest.mark.slow
@pytest.mark.sample
def test_an_unreadable_file_affects_only_its_run(tmp_path):
    """If one file is missing and one is broken, both are reported and everything else is computed.

    The exit status is 1. `solution` also ends with status 1, and prints each reason once. If no
    file can be read, there is no report and the status is 2.
    """
    folder = tmp_path / "team"
    shutil.copytree(EXAMPLES / "one-cart", folder)
    (folder / "data" / "decay-1a.csv").unlink()
    step = folder / "data" / "step-1.csv"
    lines = step.read_text(encoding="utf-8").splitlines()
    step.write_text("\n".join([*lines[:40], *20 * ["0.3,x,0.1"], *lines[40:]]), encoding="utf-8")
    done = cartlab_here("report", folder, "--no-pdf", "--json")
    found = json.loads(done.stdout)
    assert done.returncode == 1
    reasons = {"decay-1a": "data/decay-1a.csv", "step-1": "data/step-1.csv line 41: "}
    failed = {check["id"] for check in found["checks"] if check["outcome"] == "fail"}
    assert failed == {f"data.{name}" for name in reasons}
    skipped = {skip["stage"]: skip["reason"] for skip in found["skipped"]}
    page = html.unescape((folder / "report" / "report.html").read_text(encoding="utf-8"))
    for name, reason in reasons.items():
        assert re.search(f"- {name}: .*{reason}", " ".join(done.stderr.split()))
        assert reason in skipped[f"reading {name}"]
        assert reason in page
    assert all(parameter["initial"] and parameter["final"] for parameter in found["parameters"])

    done = cartlab_here("solution", folder, "--no-pdf", "--json")
    assert done.returncode == 1
    assert {doubt["id"] for doubt in json.loads(done.stdout)["doubts"]} == failed
    assert all(f"cartlab: {name} " in done.stderr for name in reasons)
    assert all(done.stderr.count(reason) == 1 for reason in reasons.values())

    for file in (folder / "data").iterdir():
        file.unlink()
    done = cartlab_here("report", folder, "--no-pdf")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert re.search(r"'data/decay-1a\.csv' \(and \d+ more\)$", line)


def test_a_damping_at_its_bound_is_reported_as_unknown(tmp_path):
    """Without a point near the peak the final ζ is missing, with a reason; figures are still drawn.

    The fitted ζ is 0, and one point of the fitted curve lies on the pole.
    """
    hertz = [0.5, 1.0, 1.5, 2.5, 3.0, 4.0]  # resonance at 2 Hz, K = 20 cm/V
    rows = [f"{f},{20 / abs(1 - (f / 2) ** 2):.6g}" for f in hertz]
    (tmp_path / "bode.csv").write_text("\n".join(["frequency,x1", *rows]), encoding="utf-8")
    (tmp_path / "submission.toml").write_text(
        "version = 1\n[system]\ncarts = 1\n"
        '[[experiments]]\nid = "bode"\nkind = "bode"\nfile = "bode.csv"\n',
        encoding="utf-8",
    )
    done = cartlab_here("report", tmp_path, "--no-pdf", "--json")
    found = json.loads(done.stdout)
    assert done.returncode in (0, 1)
    assert "Traceback" not in done.stderr
    zeta = {parameter["name"]: parameter for parameter in found["parameters"]}["zeta"]
    assert (zeta["final"], zeta["final_std"], zeta["consistent"]) == (None, None, None)
    assert "at zero" in {skip["stage"]: skip["reason"] for skip in found["skipped"]}["final zeta"]
    assert found["chain"]["c"] == [0.0]


@pytest.mark.slow
@pytest.mark.sample
def test_report_accepts_a_simulated_submission(tmp_path):
    """`report` reads a simulated submission, with its reported values, without any complaint."""
    folder = tmp_path / "bench"
    done = cartlab_here(
        "simulate", "--preset", "throne-1dof", "--seed", 5, "--reported", "--out", folder
    )
    assert done.returncode == 0
    assert "[reported.final]" in (folder / "submission.toml").read_text(encoding="utf-8")
    done = cartlab_here("report", folder, "--no-pdf")
    assert (done.returncode, done.stdout) == (0, "")
    assert not (folder / "report" / "report.pdf").exists()
    again = cartlab_here("simulate", "--preset", "throne-1dof", "--out", folder)
    assert (again.returncode, "is not empty" in again.stderr) == (2, True)


def test_inspect_shows_the_files_beside_a_broken_one(tmp_path):
    """If `inspect` meets one broken file, it still shows the other files and ends with status 1.

    If no file can be read, the status is 2.
    """
    broken = tmp_path / "broken.csv"
    rows = [f"{i},{i}" if i % 15 else f"{i},oops" for i in range(1, 40)]
    broken.write_text("\n".join(["time,x1", *rows]), encoding="utf-8")
    alone = cartlab_here("inspect", tmp_path)
    shutil.copyfile(EXAMPLES / "two-cart" / "data" / "sine-01.csv", tmp_path / "sound.csv")

    done = cartlab_here("inspect", tmp_path)

    assert (alone.returncode, alone.stdout) == (2, "")
    assert done.returncode == 1
    assert "sound.csv" in done.stdout
    assert "broken.csv line 16" in done.stderr
