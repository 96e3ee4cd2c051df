"""Files of other programs are imported into a submission as they appear in a folder."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.bench.importing import Importer
from pipeline.cli import app
from pipeline.errors import ConfigError
from pipeline.experiments.plan import Recording
from pipeline.ingest.read import read_data
from pipeline.submission import load_submission
from tests.helpers.acquisitions import Notes, sine, write_work

T = np.arange(0.0, 4.0, 0.00884)


def ecp(u: np.ndarray, *, gain: float = 400.0) -> str:
    """Return an export of the ECP program: two encoders that follow the input."""
    rows = "".join(
        f"{i} {t:.5f} 0 {round(gain * v)} {round(gain / 2 * v)} {v:.4f};\n"
        for i, (t, v) in enumerate(zip(T, u, strict=True))
    )
    heading = "Sample Time Commanded Pos Encoder 1 Pos Encoder 2 Pos Control Effort"
    return f"{heading}\n[\n{rows}]\n"


def dwell(frequency: float) -> str:
    """Return the export of a dwell."""
    return ecp(0.5 * np.sin(2 * np.pi * frequency * T))


STEP = ecp(np.where((T > 1) & (T < 3), 0.5, 0.0))
SCALES = 'input = { unit = "V", sign = 1 }\n'


@pytest.fixture
def work(tmp_path):
    """Return a submission whose plan asks for a step and two dwells."""
    step = Recording(
        id="step-1", kind="step", carts=(1, 2), wave="square", amplitude=0.02, frequency=0.1
    )
    plan = [step, sine("sine-01", seconds=4, frequency=2.0), sine("sine-02", seconds=4)]
    folder = write_work(tmp_path / "work", plan, scales=SCALES)
    toml = folder / "submission.toml"
    text = toml.read_text(encoding="utf-8").replace('"cm"', '"cm", per_count = 0.00227')
    toml.write_text(text, encoding="utf-8")
    return folder


@pytest.fixture
def source(tmp_path):
    """Return the folder that the other program exports to."""
    folder = tmp_path / "exports"
    folder.mkdir()
    return folder


def put(folder, name: str, text: str | bytes, *, at: int) -> None:
    """Write a file with a given modification time."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    os.utime(path, (at, at))


def take(work, source) -> tuple[list, Notes]:
    """Import the files that are there now."""
    notes = Notes()
    return list(Importer(work, source, observer=notes).watch(once=True)), notes


def test_files_become_the_recordings_that_the_plan_asks_for(work, source):
    """In the order written, each exported file becomes the next recording of the plan.

    A second session recognises a file that was imported before, even under another name.
    """
    put(source, "B.txt", dwell(2.0), at=200)
    put(source, "A.txt", STEP, at=100)
    put(source, "extra run!.txt", dwell(5.0), at=150)
    taken, notes = take(work, source)
    assert [(i.file, i.experiment, i.planned) for i in taken] == [
        ("A.txt", "step-1", True), ("extra run!.txt", "extra-run", False),
        ("B.txt", "sine-01", True),
    ]  # fmt: skip
    assert notes.remarks[0].startswith("next: step-1")
    submission = load_submission(work)
    assert [e.kind for e in submission.experiments] == ["step", "sine", "sine"]
    assert [e.frequency for e in submission.experiments] == [None, pytest.approx(5, rel=1e-2), 2.0]
    record = read_data(submission).records[0]
    # 0.5 V, and 400 counts per volt at 0.00227 cm per count.
    assert record.y[0].max() == pytest.approx(200 * 0.00227)
    assert "# ours" in (work / "submission.toml").read_text(encoding="utf-8")
    put(source, "A again.txt", STEP, at=300)
    assert take(work, source)[0] == []
    assert load_submission(work) == submission


@pytest.mark.parametrize("form", ["bare", "matlab"])
def test_a_table_without_headings_and_one_for_matlab_are_imported(work, source, form):
    """The columns of a table without headings are guessed, and a message asks to check them.

    A MATLAB file `NAME.m` with a matrix in brackets is imported like any export.
    """
    heading, matrix = STEP.split("\n", 1)
    u = np.where((T > 1) & (T < 3), 0.5, 0.0)
    rows = "".join(
        f"{t:.5f}\t{round(400 * v)}\t{round(200 * v + i % 2)}\t{v:.4f}\n"
        for i, (t, v) in enumerate(zip(T, u, strict=True))
    )
    name, text = {
        "bare": ("bare.txt", rows),
        "matlab": ("run.m", f"% {heading}\ndata = {matrix.rstrip()};\n"),
    }[form]
    put(source, name, text, at=1)
    (imported,) = take(work, source)[0]
    assert imported.experiment == "step-1"
    (record,) = read_data(load_submission(work)).records
    if form == "matlab":
        assert record.y[0].max() == pytest.approx(200 * 0.00227)
    else:
        assert any("no names" in remark for remark in imported.remarks)
        columns = load_submission(work).experiments[0].columns
        assert columns == {"time": 1, "input": 4, "x1": 2, "x2": 3}


def test_the_usb_logger_is_known(tmp_path, source):
    """A file headed `Time [us],Displacement [mm]` is imported as a decay of cart 1, in s and cm."""
    work = write_work(tmp_path / "one", [])
    toml = work / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace("carts = 2", "carts = 1"), encoding="utf-8")
    t = np.arange(0, 5_000_000, 2000)
    x = 8 * np.exp(-1e-6 * t) * np.cos(12e-6 * t)
    rows = "".join(f"{a},{b:.4f}\n" for a, b in zip(t, x, strict=True))
    put(source, "log.csv", "Time [us],Displacement [mm]\n" + rows, at=1)
    (imported,) = take(work, source)[0]
    assert (imported.experiment, imported.kind) == ("log", "decay")
    (record,) = read_data(load_submission(work)).records
    assert record.y[0, 0] == pytest.approx(0.8)  # cm
    assert record.t[-1] == pytest.approx(4.998)


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [("notes.txt", "Remember to zero the encoders\n", "not a table"),
     ("cut.txt", STEP[: len(STEP) // 2], "truncated"), ("sheet.csv", b"PK\x03\x04rest", "zip")],
)  # fmt: skip
def test_an_unusable_file_is_refused_with_a_reason(work, source, name, content, why):
    """A file that cannot be used stays where it is and gets one line; nothing else changes."""
    before = (work / "submission.toml").read_bytes()
    put(source, name, content, at=1)
    taken, notes = take(work, source)
    assert taken == []
    assert any(why in remark for remark in notes.remarks), notes.remarks
    assert (work / "submission.toml").read_bytes() == before
    assert not (work / "data").exists()


def test_other_things_in_the_folder_are_named_once(work, source):
    """A script, a picture and a folder are each named once, with the reason for not importing them.

    Hidden files are ignored.
    """
    put(source, "plot.m", "x = load('run.txt');\nplot(x(:, 1))\n", at=1)
    put(source, "photo.JPG", b"\xff\xd8", at=2)
    put(source, "~run.txt", STEP, at=3)
    (source / "monday").mkdir()
    looks, notes = [], Notes()

    def wait(seconds: float) -> None:
        looks.append(seconds)
        if len(looks) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(Importer(work, source, observer=notes).watch(once=False, wait=wait))
    said = sorted(remark for remark in notes.remarks if "not imported" in remark)
    assert [remark.split(":")[0] for remark in said] == ["monday", "not imported", "photo.JPG"]
    assert "plot.m" in said[1]
    assert load_submission(work).experiments == ()


def test_a_file_is_waited_for_until_it_is_complete(work, source):
    """A file that is still being written is imported only when it is complete."""
    half = len(STEP) // 2
    looks = iter(range(100))

    def export(seconds: float) -> None:
        look = next(looks)
        if look in (2, 8):  # the importer looks again and again meanwhile
            with (source / "A.txt").open("a", encoding="utf-8") as file:
                file.write(STEP[:half] if look == 2 else STEP[half:])
        elif look == 9:
            (source / "B.txt").write_text(dwell(2.0), encoding="utf-8")
            (source / "C.txt").write_text(dwell(2.0) + "\n", encoding="utf-8")

    watch = Importer(work, source, observer=Notes()).watch(once=False, wait=export)
    assert [imported.experiment for imported in watch] == ["step-1", "sine-01", "sine-02"]
    assert len(read_data(load_submission(work)).records) == 3


class Tidy(Notes):
    """An observer that deletes a file as soon as a message about it appears."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def remark(self, sentence: str) -> None:
        """Keep the sentence; delete the file."""
        super().remark(sentence)
        if "not imported" in sentence:
            self._path.unlink(missing_ok=True)


def test_a_file_that_disappears_is_skipped(work, source):
    """A file that disappears before it is read is skipped, and the others are imported."""
    put(source, "A.txt", "no table\n", at=1)
    put(source, "B.txt", STEP, at=2)
    put(source, "C.txt", STEP, at=3)
    watch = Importer(work, source, observer=Tidy(source / "B.txt")).watch(once=True)
    assert [imported.file for imported in watch] == ["C.txt"]


@pytest.mark.skipif(
    sys.platform == "win32" or os.geteuid() == 0, reason="locks differ for root and on Windows"
)
def test_a_locked_file_is_imported_once_it_is_free(work, source):
    """A file that its program locks is reported once, and imported when the lock is gone."""
    put(source, "A.txt", STEP, at=1)
    (source / "A.txt").chmod(0)
    waits = iter(range(9))

    def wait(seconds: float) -> None:
        if next(waits) == 3:
            (source / "A.txt").chmod(0o600)

    notes = Notes()
    imported = next(Importer(work, source, observer=notes).watch(once=False, wait=wait))
    assert imported.experiment == "step-1"
    (told,) = [r for r in notes.remarks if "Permission denied" in r]
    assert told.startswith("A.txt: ")


def test_the_command_imports_the_files_of_the_folder(work, source):
    """`cartlab acquire DIR --import FOLDER --once` lists what it imported, if there is a folder."""
    put(source, "A.txt", STEP, at=100)
    command = ["acquire", str(work), "--import", str(source), "--once"]
    result = CliRunner().invoke(app, command, catch_exceptions=False)
    assert result.exit_code == 0
    assert "A.txt: step-1" in result.stderr
    with pytest.raises(ConfigError, match="nowhere: "):
        Importer(work, source / "nowhere", observer=Notes())
