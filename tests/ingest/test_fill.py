"""`cartlab fill` describes the files in `data/` in `submission.toml`, and keeps what is there."""

import json
import os
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.errors import ConfigError, SubmissionError
from pipeline.identify.springs import fill_folder
from pipeline.ingest.files import files_not_read, not_read_notes
from pipeline.ingest.fill import data_files, experiment_doubts, fill_submission
from pipeline.ingest.read import read_data
from pipeline.resources import EXAMPLES
from pipeline.submission import load_submission, new_submission
from pipeline.submission.edit import Stale, append_experiment, edit_submission, text_digest
from tests.helpers.commandline import cartlab_here
from tests.helpers.recordings import facts

T = np.arange(1200) / 150.0
RING = np.round(300 * np.exp(-0.5 * T) * np.cos(12 * T))
STEP = np.where((T > 1) & (T < 4), 0.5, 0.0)
SINE = 0.3 * np.sin(2 * np.pi * 4.0 * T)


def put(folder: Path, name: str, **columns: np.ndarray) -> None:
    """Write columns as a CSV file into `data/`."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    heads = [key.replace("__", " [") + ("]" if "__" in key else "") for key in columns]
    rows = "".join(",".join(f"{v:.7g}" for v in r) + "\n" for r in zip(*columns.values()))  # noqa: B905
    (folder / "data" / name).write_text(",".join(heads) + "\n" + rows, encoding="utf-8")


def states(folder: Path) -> dict[str, tuple[str, str, str | None]]:
    """Fill the submission; return state, id and kind by file."""
    return {f.file: (f.state, f.experiment, f.kind) for f in fill_submission(folder)}


def test_a_folder_of_files_becomes_a_submission(tmp_path):
    """`fill` finds carts, units, kinds and free carts, and writes what is unsure as comments."""
    still = 0 * T
    put(tmp_path, "run 10.csv", time=T, input=SINE, x1__cm=RING / 300, x2__cm=0.4 * RING / 300)
    put(tmp_path, "run 2.csv", time=T, input=STEP, x1__cm=RING / 300, x2__cm=0.4 * RING / 300)
    put(tmp_path, "pull.csv", time=T, input=still, x1__cm=RING / 300, x2__cm=still)
    put(tmp_path, "loop.csv", time=T, input=RING / 999, reference=STEP, x1__cm=RING / 300)
    assert data_files(tmp_path) == [f"data/{n}.csv" for n in ("loop", "pull", "run 2", "run 10")]
    assert states(tmp_path) == {
        "data/loop.csv": ("new", "loop", "closed_loop"),
        "data/pull.csv": ("new", "pull", "decay"),
        "data/run 2.csv": ("new", "run-2", "step"),
        "data/run 10.csv": ("new", "run-10", "sine"),
    }
    submission = load_submission(tmp_path)
    assert submission.system.carts == 2
    assert submission.system.position.unit == "cm"
    assert {e.id: e.carts for e in submission.experiments} == {
        "loop": (1,), "pull": (1,), "run-2": (1, 2), "run-10": (1, 2),
    }  # fmt: skip
    assert [len(doubts) for doubts in experiment_doubts(tmp_path)] == [1, 0, 0, 0]
    text = (tmp_path / "submission.toml").read_text(encoding="utf-8")
    assert "docs/submission.md" in text  # instead of the examples that `cartlab new` writes
    assert not re.search(r"^#\[(design|\[experiments|reported)", text, re.MULTILINE)
    assert len(read_data(submission).records) == 4


@pytest.mark.parametrize(
    ("heads", "unit", "doubtful"),
    [
        (["x1__cm", "x1__cm", "x1__cm"], "cm", False),
        (["x1__cm", "x1__cm", "x1"], "cm", False),
        (["x1", "x1__mm", "x1"], "mm", True),  # one heading does not speak for all recordings
        (["x1__cm", "x1__mm", "x1__cm"], "cm", True),
        (["x1__mm", "x1__cm", "x1__cm"], "cm", True),
    ],
)
def test_a_unit_that_few_headings_state_is_marked(heads, unit, doubtful, tmp_path):
    """`fill` writes the unit of most headings; it is unsure if few state one, or if they differ."""
    for i, head in enumerate(heads):
        put(tmp_path, f"run-{i}.csv", **{"time": T, "input": (1 + i) * STEP, head: RING / 300})
    doubts = fill_folder(tmp_path).doubts
    assert load_submission(tmp_path).system.position.unit == unit
    assert any(one.startswith("position: ") for one in doubts) == doubtful


def test_a_second_run_prints_as_much_as_the_first(tmp_path):
    """A second `fill` prints the same doubts, until a person removes the "unsure" comments."""
    still = 0 * T
    put(tmp_path, "pull.csv", time=T, input=still, x1=RING, x2=still)
    put(tmp_path, "loop.csv", time=T, input=RING / 999, reference=STEP, x1=RING, x2=RING)
    rows = np.column_stack([T, RING, STEP])
    np.savetxt(tmp_path / "data" / "numbers.txt", rows, fmt=["%.5f", "%.0f", "%.1f"])
    first, second = fill_submission(tmp_path), fill_submission(tmp_path)
    assert {found.state for found in first} == {"new"}
    assert {found.state for found in second} == {"there"}
    for one, again in zip(first, second, strict=True):
        assert (one.carts, one.unsure) == (again.carts, again.unsure)
    assert sum(bool(found.unsure) for found in second) == 1
    toml = tmp_path / "submission.toml"
    settled = [
        line for line in toml.read_text(encoding="utf-8").splitlines() if "unsure" not in line
    ]
    toml.write_text("\n".join(settled), encoding="utf-8")
    assert not any(found.unsure for found in fill_submission(tmp_path))


@pytest.mark.parametrize("command", ["inspect", "fill"])
def test_an_old_spreadsheet_is_named_as_not_read(tmp_path, command):
    """An old spreadsheet in `data/` is named as not read, whether alone or with other files."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    (tmp_path / "data" / "b.xls").write_bytes(b"PK")
    done = cartlab_here(command, tmp_path)
    assert done.returncode == 0
    assert re.findall(r"data/\S+\.xls\b", done.stderr) == ["data/b.xls"]
    (tmp_path / "data" / "a.csv").unlink()
    done = cartlab_here(command, tmp_path)
    assert done.returncode == 2
    assert re.findall(r"data/\S+\.xls\b", done.stderr) == ["data/b.xls"]


def test_every_file_is_named_except_hidden_ones(tmp_path):
    """Files that are not recordings are named, except hidden ones; long lists are shortened."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    data = tmp_path / "data"
    for name in (".git/HEAD", ".cache/b.csv", "report/bode.svg", "plot.py", "Thumbs.db"):
        (data / name).parent.mkdir(exist_ok=True)
        (data / name).write_bytes(b"")
    assert data_files(tmp_path) == ["data/a.csv"]
    found = files_not_read(data, root=tmp_path)
    assert [(one.file, one.reason, one.advice) for one in found] == [
        ("data/plot.py", "no recording", ""),
        ("data/report/bode.svg", "no recording", ""),
    ]
    for number in range(20):
        (data / f"run {number}.ods").write_bytes(b"PK")
    found = files_not_read(data, root=tmp_path)
    sheets, _ = not_read_notes((one.file, one.reason, one.advice) for one in reversed(found))
    assert re.findall(r"run (\d+)\.ods", sheets) == ["19", "18", "17", "16"]
    assert "16 more" in sheets


def test_fill_says_whether_it_wrote(tmp_path):
    """`fill` says whether it wrote anything, even if it was only a comment on an unknown file."""
    said = []
    for name in ("a.csv", "b.csv", "b.csv"):
        put(tmp_path, name, p=RING, q=STEP)
        done = CliRunner().invoke(app, ["fill", str(tmp_path)], standalone_mode=False)
        said.append("wrote" in done.stderr and "nothing to add" not in done.stderr)
    assert said == [True, True, False]


def test_an_empty_column_does_not_count_as_a_cart(tmp_path):
    """An encoder that never moves in any file is not counted as a cart."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING, x2=0.5 * RING, x3=0 * T)
    fill_submission(tmp_path)
    assert load_submission(tmp_path).system.carts == 2


def test_typed_entries_are_kept_and_missing_ones_added(tmp_path):
    """`fill` keeps kinds, ids and comments that a person typed, and adds what is missing."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    put(tmp_path, "b.csv", time=T, input=SINE, x1=RING)
    put(tmp_path, "c.csv", time=T, input=0 * T, x1=RING)
    text = (
        "version = 1  # ours\n[system]\ncarts = 1\n\n"
        '[[experiments]]\nid = "mine"  # my own\nkind = "sweep"\nfile = "data\\\\a.csv"\n'
        '[[experiments]]\nfile = "data/b.csv"\n# for the report\n[reported.initial]\nK = 0.10\n'
    )
    (tmp_path / "submission.toml").write_bytes(text.replace("\n", "\r\n").encode())
    assert states(tmp_path) == {
        "data/a.csv": ("there", "mine", "sweep"),
        "data/b.csv": ("completed", "b", "sine"),
        "data/c.csv": ("new", "c", "decay"),
    }
    raw = (tmp_path / "submission.toml").read_bytes()
    assert raw.count(b"\r\n") == raw.count(b"\n")
    for line in text.splitlines():
        assert line in raw.decode().splitlines()
    assert {f.state for f in fill_submission(tmp_path)} == {"there"}
    assert (tmp_path / "submission.toml").read_bytes() == raw


def test_only_recordings_get_a_table(tmp_path):
    """Copies, texts and unknown files get no table; an unknown file gets one comment."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    put(tmp_path, "b.csv", time=T, input=STEP, x1=RING)
    put(tmp_path, "riddle.csv", foo=RING, bar=STEP)
    (tmp_path / "data" / "text.txt").write_text("zero the encoders\n")
    for _ in range(2):
        assert [v[0] for v in states(tmp_path).values()][1:] == ["copy", "unknown", "broken"]
        text = (tmp_path / "submission.toml").read_text(encoding="utf-8")
        assert text.count('"data/riddle.csv"') == 1
        assert [e.id for e in load_submission(tmp_path).experiments] == ["a"]


def test_the_same_samples_in_two_formats_get_one_table(tmp_path):
    """The same recording saved as .csv and .mat gets one table.

    A recording that only has the same ranges gets its own table.
    """
    (tmp_path / "data").mkdir()
    whole = {"time": T, "input": STEP, "x1": RING}
    put(tmp_path, "a.csv", **whole)
    put(tmp_path, "b.csv", **(whole | {"x1": RING[::-1]}))
    table = np.loadtxt(tmp_path / "data" / "a.csv", delimiter=",", skiprows=1).T
    scipy.io.savemat(tmp_path / "data" / "a.mat", dict(zip(whole, table, strict=True)))
    assert [state for state, *_ in states(tmp_path).values()] == ["new", "copy", "new"]


def test_a_matrix_without_headings_is_a_copy_of_the_recording_that_has_them(tmp_path):
    """The commanded position in an ECP export does not make its .mat file another recording."""
    (tmp_path / "data").mkdir()
    put(tmp_path, "a.csv", time=T, commanded_pos=RING, encoder_1_pos=RING, control_effort=STEP)
    table = np.loadtxt(tmp_path / "data" / "a.csv", delimiter=",", skiprows=1)
    scipy.io.savemat(tmp_path / "data" / "a.mat", {"log": table})
    assert [state for state, *_ in states(tmp_path).values()] == ["new", "copy"]


def test_a_bare_matrix_gets_its_columns(tmp_path):
    """For a matrix without headings, `fill` writes the columns that the signals reveal."""
    (tmp_path / "data").mkdir()
    rows = [f"{t:.5f}\t{x:.0f}\t{u}" for t, x, u in zip(T, RING, STEP, strict=True)]
    (tmp_path / "data" / "bare.txt").write_text("\n".join(rows) + "\n")
    (found,) = fill_submission(tmp_path)
    assert (found.state, found.kind) == ("new", "step")
    (experiment,) = load_submission(tmp_path).experiments
    assert experiment.columns == {"time": 1, "input": 3, "x1": 2}
    assert found.unsure == ()


def test_unclear_columns_are_asked_about(tmp_path):
    """In a steady sine either column may be the input: `fill` proposes one and asks to check it."""
    (tmp_path / "data").mkdir()
    sines = np.round(300 * np.sin(20 * T)), np.round(200 * np.sin(20 * T - 1))
    rows = [f"{t:.5f}\t{x:.0f}\t{u:.0f}" for t, x, u in zip(T, *sines, strict=True)]
    (tmp_path / "data" / "bare.txt").write_text("\n".join(rows) + "\n")
    (found,) = fill_submission(tmp_path)
    assert found.state == "new"
    assert found.inspection
    assert len(found.inspection.doubts) == len(found.unsure) == 1
    assert experiment_doubts(tmp_path) == [found.unsure]


def test_an_encoder_without_a_cart_gets_no_column(tmp_path):
    """An encoder without a cart gets no column, and all files still get their tables."""
    new_submission(tmp_path, carts=1)
    rows = [
        f"{t:.5f}\t{x:.0f}\t{y:.0f}\t{u}"
        for t, x, y, u in zip(T, RING, np.roll(RING, 30), STEP, strict=True)
    ]
    (tmp_path / "data" / "bare.txt").write_text("\n".join(rows) + "\n")
    put(tmp_path, "run.csv", time=T, input=SINE, x1=0.5 * RING)
    assert set(states(tmp_path)) == {"data/bare.txt", "data/run.csv"}
    columns = [set(e.columns or ()) for e in load_submission(tmp_path).experiments]
    assert sorted(columns, key=len) == [set(), {"time", "input", "x1"}]


@pytest.mark.parametrize(("carts", "asked"), [(1, "x1 = …"), (2, "more carts")])
def test_a_moving_column_without_a_cart_is_asked_about(tmp_path, carts, asked):
    """If a moving column belongs to none of the stated carts, `fill` asks about it.

    The file gets a table without `carts`.
    """
    new_submission(tmp_path, carts=carts)
    put(tmp_path, "pull.csv", time=T, input=0 * T, x1=0 * T, x2=0 * T, x3=RING)
    (found,) = fill_submission(tmp_path)
    (unsure,) = found.unsure
    assert "'x3'" in unsure
    assert asked in unsure
    (experiment,) = load_submission(tmp_path).experiments
    assert experiment.carts == tuple(range(1, carts + 1))


def test_a_stated_held_cart_is_not_questioned(tmp_path):
    """`fill` says once that it wrote a cart as held; if a person removes that line, it asks."""
    put(tmp_path, "run.csv", time=T, input=STEP, x1=RING, x2=0.4 * RING)
    put(tmp_path, "pull.csv", time=T, input=0 * T, x1=RING, x2=0 * T)
    first, second = fill_submission(tmp_path), fill_submission(tmp_path)
    assert [(note.code, note.about) for note in facts(first[0].remarks).values()] == [
        ("written_as_held", "x2")
    ]
    assert second[0].remarks == ()
    toml = tmp_path / "submission.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace("carts = [1]\n", "", 1), "utf-8")
    assert facts(fill_submission(tmp_path)[0].remarks)["never_changes"].about == "x2"


def test_a_table_without_its_file_is_reported(tmp_path):
    """A renamed file gets a new table, and the message on the old table names the renamed file."""
    put(tmp_path, "step-1.csv", time=T, input=STEP, x1=RING)
    fill_submission(tmp_path)
    (tmp_path / "data" / "step-1.csv").rename(tmp_path / "data" / "step1.csv")
    new, lost = fill_submission(tmp_path)
    assert (new.state, new.file) == ("new", "data/step1.csv")
    assert (lost.state, lost.experiment, lost.kind) == ("missing", "step-1", "step")
    assert "'data/step1.csv'" in lost.remarks[0]


def test_links_out_of_the_folder_are_not_followed(tmp_path):
    """A link that points outside the submission is refused, and the error names it."""
    put(tmp_path / "theirs", "a.csv", time=T, input=STEP, x1=RING)
    put(tmp_path / "mine", "b.csv", time=T, input=STEP, x1=RING)
    (tmp_path / "mine" / "data" / "a.csv").symlink_to(tmp_path / "theirs" / "data" / "a.csv")
    found = {one.file: one for one in fill_submission(tmp_path / "mine")}
    assert {file: one.state for file, one in found.items()} == {
        "data/b.csv": "new", "data/a.csv": "refused",
    }  # fmt: skip
    refused = found["data/a.csv"]
    assert refused.inspection is None
    assert refused.remarks
    assert refused.advice


def test_a_linked_data_folder_reveals_no_file_name(tmp_path):
    """If `data` is a link to outside the submission, no name of a file in it is shown."""
    put(tmp_path / "theirs", "a.csv", time=T, input=STEP, x1=RING)
    (tmp_path / "theirs" / "data" / "grades.xls").write_bytes(b"PK")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "data").symlink_to(tmp_path / "theirs" / "data")
    with pytest.raises(ConfigError, match=r"\bdata\b") as told:
        fill_submission(tmp_path / "mine")
    assert "grades" not in str(told.value)
    assert "a.csv" not in str(told.value)


def test_nothing_to_fill_in_is_one_line(tmp_path):
    """Without a folder or recordings, or with a broken `submission.toml`, nothing is written."""
    with pytest.raises(ConfigError, match="nowhere"):
        fill_submission(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"\.csv"):
        fill_submission(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("carts = 1", 'carts = "2"', "system.carts"),
        ("carts = 1", "carts = 9", "system.carts"),
        ("[system]", "system = 3\n[other]", "system"),
        ("version = 1", "version = 1\nexperiments = [1]", "experiments[1]"),
        ("version = 1", "version = 1\nexperiments = 3", "experiments"),
    ],
)
def test_a_wrong_type_is_one_line(old, new, where, tmp_path):
    """A wrong type in `submission.toml` gives one line that names the key; nothing is written."""
    put(tmp_path, "pull.csv", time=T, input=0 * T, x1=RING, x2=0.4 * RING)
    typed = "version = 1\n[system]\ncarts = 1\n".replace(old, new).replace("[other]\ncarts = 1", "")
    (tmp_path / "submission.toml").write_text(typed, encoding="utf-8")
    done = CliRunner().invoke(app, ["fill", str(tmp_path)])
    assert isinstance(done.exception, SubmissionError)  # the command turns this into exit status 2
    assert f"submission.toml: {where}: expected" in str(done.exception)
    assert (tmp_path / "submission.toml").read_text(encoding="utf-8") == typed


def test_the_command_says_what_it_did(tmp_path):
    """`fill` prints a table or JSON, and its exit status is 1 if a file cannot be used yet."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    result = CliRunner().invoke(app, ["fill", str(tmp_path)], catch_exceptions=False)
    assert result.exit_code == 0
    assert result.stdout.split() == ["data/a.csv", "new", "step", "cart", "1", "a"]
    put(tmp_path, "riddle.csv", foo=RING)
    result = CliRunner().invoke(app, ["fill", str(tmp_path), "--json"], catch_exceptions=False)
    assert result.exit_code == 1
    assert [row["state"] for row in json.loads(result.stdout)] == ["there", "unknown"]


@pytest.mark.parametrize(("name", "carts"), [("one-cart", 1), ("two-cart", 2), ("three-cart", 3)])
def test_kinds_and_carts_of_an_example_are_found(name, carts, tmp_path):
    """Without an example's tables, `fill` finds kinds and free carts of all its files."""
    true = load_submission(EXAMPLES / name)
    shutil.copytree(true.folder / "data", tmp_path / "bare" / "data")
    found = {f.file: f for f in fill_submission(tmp_path / "bare")}
    told = {f.file: (f.kind, f.carts) for f in found.values()}
    assert told == {e.file: (e.kind, e.carts) for e in true.experiments}
    assert load_submission(tmp_path / "bare").system.carts == carts


# ----------------------------------------------------------------- changes in place

_WORDS = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), max_size=8)
_COMMENTS = st.lists(_WORDS.map(lambda word: f"# {word}"), min_size=8, max_size=8)
_TABLES = st.permutations(["system", "experiments", "reported.initial", "design"])


@given(_COMMENTS, _TABLES, st.integers(0, 3), st.booleans())
def test_existing_text_stays(tmp_path_factory, comments, tables, n, blank):
    """Whatever tables are added to the file, every comment, key and digit in it stays."""
    bodies = {
        "system": "[system] {}\ncarts = 1\ninput = {{ unit = 'V' }} {}\n",
        "experiments": "".join(
            f"[[experiments]]\n{{}}\nid = 'e{i}'\nkind = 'step'\nfile = 'a.csv'\n" for i in range(n)
        ),
        "reported.initial": "[reported.initial]\n{}\nK = 0.10 {}\n",
        "design": "{}\n[design]\nreference = 1e0\n",
    }
    folder = tmp_path_factory.mktemp("any")
    parts = ["version = 1", *(bodies[table] for table in tables)]
    text = ("\n\n" if blank else "\n").join(parts) + "\n"
    for comment in comments:
        text = text.replace("{}", comment, 1)
    text = text.replace("{{", "{").replace("}}", "}")
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    entry = {"id": "new", "kind": "bode", "file": "data/b.csv", "columns": {"frequency": 1}}

    edit_submission(folder, lambda d: append_experiment(d, entry, remarks=["what\x00?\n[x]"]))

    now = (folder / "submission.toml").read_text(encoding="utf-8")
    before = tomllib.loads(text)
    before.setdefault("experiments", []).append(entry)
    assert tomllib.loads(now) == before
    lines = [line.rstrip() for line in now.splitlines()]  # tomlkit drops blanks at a line's end
    assert [line for line in text.splitlines() if line.strip() and line.rstrip() not in lines] == []


def test_an_outdated_change_is_refused(tmp_path):
    """A change made from an outdated text is refused, and the caller gets the current text."""
    new_submission(tmp_path / "team", carts=1)
    toml = tmp_path / "team" / "submission.toml"
    seen = text_digest(toml.read_text(encoding="utf-8"))
    now = toml.read_text(encoding="utf-8") + "# from outside\n"
    toml.write_text(now, encoding="utf-8")
    with pytest.raises(Stale) as refused:
        edit_submission(tmp_path / "team", lambda d: d.update(title="x"), version=seen)
    assert refused.value.text == toml.read_text(encoding="utf-8") == now


def test_stated_columns_identify_a_file(tmp_path):
    """`columns` in `[system]` apply to any file, and those in an experiment to its file alone."""
    put(tmp_path, "a.csv", clock=T, volts=STEP, sled=2 * RING)
    put(tmp_path, "b.csv", time=T, input=SINE, x1=RING)
    put(tmp_path, "c.csv", clock=T, volts=STEP, other=RING)
    (tmp_path / "submission.toml").write_text(
        "version = 1\n[system]\ncarts = 1\n"
        'columns = { time = "clock", input = "volts", x1 = "sled" }\n'
        '[[experiments]]\nfile = "data/c.csv"\ncolumns = { x1 = "other" }\n',
        encoding="utf-8",
    )
    assert states(tmp_path) == {
        "data/a.csv": ("new", "a", "step"),
        "data/b.csv": ("new", "b", "sine"),
        "data/c.csv": ("completed", "c", "step"),
    }
    assert len(read_data(load_submission(tmp_path)).records) == 3


def test_each_unread_file_is_named_with_advice(tmp_path):
    """Each file that is not read is named with a reason and advice."""
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    data = tmp_path / "data"
    text = (data / "a.csv").read_text(encoding="utf-8")
    (data / "book.ods").write_bytes(b"PK")
    (data / "scope.rec").write_text(text, encoding="utf-8")
    (data / "film.mp4").write_bytes(b"\0" * 100)
    (tmp_path / "spare.csv").write_text(text.replace("0.5", "0.7"), encoding="utf-8")
    (tmp_path / "words.txt").write_text("to do: everything", encoding="utf-8")
    done = CliRunner().invoke(app, ["fill", str(tmp_path), "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    told = {row["file"]: (row["state"], row["advice"]) for row in json.loads(done.stdout)}
    advised = {file: (state, bool(advice)) for file, (state, advice) in told.items()}
    assert advised == {
        "data/a.csv": ("new", False),
        "data/book.ods": ("not_read", True),
        "data/scope.rec": ("not_read", True),
        "data/film.mp4": ("not_read", False),
        "spare.csv": ("not_read", True),
    }
    for file, (state, advice) in told.items():
        assert state == "new" or (file in done.stderr and advice in done.stderr)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
@pytest.mark.parametrize("mark", ["\u202f", "\u00a0", "\u200b", "\ufeff", "\u202e", b"\xff"])
def test_an_unprintable_name_is_refused(tmp_path, mark):
    """A recording whose name cannot be printed is refused and shown with escapes.

    Other files are filled in.
    """
    put(tmp_path, "a.csv", time=T, input=STEP, x1=RING)
    name = f"run{mark}1.csv" if isinstance(mark, str) else os.fsdecode(b"run" + mark + b"1.csv")
    shutil.copy(tmp_path / "data" / "a.csv", tmp_path / "data" / name)
    for command in (["fill"], ["inspect", "--json"]):
        done = cartlab_here(*command, tmp_path)
        assert done.returncode == 1, done.stderr
        assert name not in done.stdout + done.stderr or "--json" in command
        assert re.search(r"run\\{1,2}[ux]", done.stdout + done.stderr)
        assert "Traceback" not in done.stderr
    (other,) = [one for one in fill_submission(tmp_path) if one.file != "data/a.csv"]
    assert (other.state, other.file.isprintable()) == ("refused", True)
    assert [one.file for one in load_submission(tmp_path).experiments] == ["data/a.csv"]
    (tmp_path / "data" / "a.csv").unlink()
    with pytest.raises(ConfigError, match=r"run\\[ux]"):
        fill_submission(tmp_path)


def test_a_bare_matrix_without_a_clock_says_how_to_name_it(tmp_path):
    """For a matrix without a clock, `fill` shows the columns' ranges and the keys to fill in."""
    (tmp_path / "data").mkdir()
    scipy.io.savemat(tmp_path / "data" / "m.mat", {"log": np.column_stack([RING, STEP]), "K": 3.0})
    (found,) = fill_submission(tmp_path)
    assert found.state == "unknown"
    assert found.inspection is not None
    assert found.inspection.needs == ("columns", "sample_rate")
    ranges = f"1 ({RING.min():.4g} to {RING.max():.4g}), 2 ({STEP.min():.4g} to"
    assert any(ranges in remark for remark in found.remarks)
    toml = tmp_path / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    table = text[text.index('# [[experiments]]\n# id = "m"') :]
    table = re.sub("^# ", "", table, flags=re.MULTILINE)
    table = table.replace('kind = ""', 'kind = "step"').replace("{ }", "{ x1 = 1, input = 2 }")
    table = table.replace("sample_rate = 0", "sample_rate = 100")
    toml.write_text(f"{text}\n{table}", encoding="utf-8")
    (found,) = fill_submission(tmp_path)
    assert (found.state, found.kind) == ("there", "step")
    assert not any("sample_rate" in remark or "columns" in remark for remark in found.remarks)
    (record,) = read_data(load_submission(tmp_path)).records
    assert record.sample_time == pytest.approx(0.01)


def test_a_truncated_export_is_a_problem_for_inspect_and_fill(tmp_path):
    """An ECP export without its closing bracket ends `inspect` and `fill` with exit status 1."""
    new_submission(tmp_path / "bench", carts=1)
    rows = "".join(
        f"{i} {t:.3f} 0 {x:.0f};\n" for i, (t, x) in enumerate(zip(T, RING, strict=True))
    )
    text = f"Sample Time Commanded Pos Encoder 1 Pos\n[ {rows}"
    (tmp_path / "bench" / "data" / "cut.txt").write_text(text, encoding="utf-8")
    for command in ("inspect", "fill"):
        done = CliRunner().invoke(app, [command, str(tmp_path / "bench")])
        assert done.exit_code == 1
        assert "truncated" in done.stdout
    assert "data/cut.txt" in done.stderr


def test_each_run_of_a_file_gets_an_experiment(tmp_path):
    """A file with two runs gets two experiments, which read their own samples; again adds none."""
    (tmp_path / "data").mkdir()
    rows = "".join(f"{0.01 * i:.2f},{int(i > 20)},{i * i}\n" for i in range(60))
    heading = "time [s],input [V],x1 [cm]\n"
    (tmp_path / "data" / "a.csv").write_text(2 * (heading + rows + "\n"))
    found = fill_submission(tmp_path)
    assert [(one.state, one.experiment, one.run) for one in found] == [
        ("new", "a-1", "1"), ("new", "a-2", "2"),
    ]  # fmt: skip
    records = read_data(load_submission(tmp_path)).records
    assert [record.t.size for record in records] == [60, 60]
    assert [one.state for one in fill_submission(tmp_path)] == ["there", "there"]


def test_stated_columns_count_for_inspect_and_a_full_file_is_not_written_again(tmp_path):
    """`inspect` reads a folder with its stated columns; `fill` leaves a complete file untouched."""
    (tmp_path / "data").mkdir()
    t = np.arange(400) / 100
    rows = np.column_stack([t, np.round(5 * np.exp(-t) * np.cos(20 * t), 3)])
    np.savetxt(
        tmp_path / "data" / "swing.csv", rows, delimiter=",", header="t / s,carriage", comments=""
    )
    toml = tmp_path / "submission.toml"
    stated = 'columns = { time = "t / s", x1 = "carriage" }'
    toml.write_text(f"version = 1\n[system]\ncarts = 1\n{stated}\n", encoding="utf-8")

    (entry,) = json.loads(cartlab_here("inspect", tmp_path, "--json").stdout)
    assert entry["kind"] == "decay"
    assert cartlab_here("fill", tmp_path).returncode == 0
    before = toml.stat().st_mtime_ns
    assert cartlab_here("fill", tmp_path).returncode == 0
    assert toml.stat().st_mtime_ns == before
