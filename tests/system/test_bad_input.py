"""Each broken submission gives one clear line that names the file and the mistake."""

import gzip
import io
import os
import re
import shutil
import struct
import sys
import zlib
from contextlib import redirect_stderr
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import scipy.io

from pipeline.cli import main
from pipeline.errors import SubmissionError
from pipeline.ingest.read import read_data
from pipeline.submission import load_submission
from pipeline.submission.toml import MOST_LISTED

HEAD = """\
version = 1
[system]
carts = 2
position = { unit = "cm" }
"""
STEP = """\
[[experiments]]
id = "step-a"
kind = "step"
file = "data/step.csv"
"""
GOOD = HEAD + STEP


def good_rows(n: int = 40) -> list[str]:
    """Return a heading and a step response of two carts."""
    t = 0.01 * np.arange(n)
    x = 1 - np.exp(-5 * t)
    rows = zip(t, np.where(t > 0.05, 1.0, 0.0), x, 0.5 * x, strict=True)
    return ["time,input,x1,x2", *(",".join(f"{v:.6g}" for v in row) for row in rows)]


def write(folder: Path, toml: str | bytes = GOOD, **files: str | bytes) -> Path:
    """Write a submission, with a good `step.csv` unless another one is given."""
    (folder / "data").mkdir(parents=True)
    raw = toml if isinstance(toml, bytes) else toml.encode()
    (folder / "submission.toml").write_bytes(raw)
    contents: dict[str, str | bytes] = {"step.csv": "\n".join(good_rows()) + "\n", **files}
    for name, content in contents.items():
        raw = content if isinstance(content, bytes) else content.encode()
        (folder / "data" / name).write_bytes(raw)
    return folder


def one_line(folder: Path, pattern: str, *, most: int = 1) -> None:
    """Expect that loading fails with at most `most` matching lines; the command prints them too."""
    with pytest.raises(SubmissionError, match=pattern) as caught:
        read_data(load_submission(folder))
    message = str(caught.value)
    assert 1 <= len(message.splitlines()) <= most
    assert str(folder) not in message  # a message must not say in which folder the submission was
    said = io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["cartlab", "report", str(folder)]),
        redirect_stderr(said),
        pytest.raises(SystemExit) as left,
    ):
        main()
    assert (left.value.code, said.getvalue()) == (2, f"cartlab: {message}\n")
    assert not (folder / "report").exists()  # no half-written report is left


def test_the_unbroken_submission_is_read(tmp_path):
    """The good submission, from which the broken ones are made, is read without a complaint."""
    assert read_data(load_submission(write(tmp_path / "team-01"))).records[0].carts == (1, 2)


# In the good file the first text is replaced by the second, which is appended if there is no first;
# the message has to match the third.
BAD_TOML = [
    ("", "[[experiments", r"line 9: .*; found \[\[experiments$"),
    ("version = 1", f'title = "{"t" * 201}"\nversion = 1', r"title: .* 200 characters"),
    ("", '[[authors]]\nid = "a"\n' * 51, r"authors: .* 50 .* 51"),
    (STEP, "".join(STEP.replace("step-a", f"s{i}") for i in range(1001)), r"experiments: .* 1000 "),
    ('unit = "cm"', r'unit = "c\nm"', r"unit: expected one line"),
    (STEP, "title = two carts\n", r"team-01/submission\.toml line 5: put text in quotes"),
    (STEP, "carts = &2\n", r"line 5: .*Invalid value; found "),
    (GOOD, "", r"version: is required"),
    (GOOD, "version = 1\n", r"system: is required"),
    (GOOD, "version = 1\n[system]\n", r"system\.carts: is required"),
    ("version = 1", "version = 2", r"version: expected 1, found 2"),
    ("", "[sytem]\n", r"sytem: unknown .*'system'"),
    ("kind =", "knid =", r"experiments\[1\]\.knid \(step-a\): unknown .*'kind'"),
    ("unit =", "units =", r"system\.position\.units: unknown .*'unit'"),
    ("", 'controller = { type = "pid", kpp = 1 }\n', r"controller\.kpp \(step-a\): .*'kp'"),
    ("", 'controller = { type = "pidd", kp = 1 }\n', r"found 'pidd'; .*'pid'"),
    ("", '"a\\nb" = 1\n', r"unknown key"),
    ("version = 1", 'folder = "/etc"\nversion = 1', r"folder: unknown key"),
    ("version = 1", 'discussion = "well done"\nversion = 1', r"discussion: unknown key"),
    ("carts = 2", 'carts = "2"', r"system\.carts: .*, found '2'"),
    ("carts = 2", "carts = 2.0", r"carts: expected a whole"),
    ('"step-a"', "7", r"experiments\[1\]\.id: expected text"),
    ("", "carts = { a = 1 }\n", r"carts .* a list .* a table"),
    ('{ unit = "cm" }', "[1]", r"system\.position: expected a table"),
    ("", "frequency = 1979-05-27\n", r"frequency .* a number"),
    ("", "frequency = true\n", r"a number, found True"),
    ("carts = 2", "carts = 7", r"system\.carts: .*most 4"),
    ("carts = 2", "carts = 0", r"system\.carts: .*least 1"),
    ("", "controlled_cart = 0\n", r"controlled_cart .* cart 0"),
    ("", "[design]\ncart = 3\n", r"design\.cart: .*cart 3"),
    ("carts = 2", "carts = 2\nsprings = [true, true]", r"springs: .* 3 .*1-2.*, found 2"),
    ("carts = 2", "carts = 2\nsprings = [1, 1, 1]", r"springs\[1\]: .*, found 1"),
    ('kind = "step"', 'kind = "stpe"', r"kind \(step-a\): .*'stpe'; .*'step'"),
    ("step-a", "a\\nb", r"id.*: expected 1 to 100"),
    ("", 'controller = { type = "lqg" }\n', r"'state_feedback', 'pid'"),
    ("", "controller = { kp = 1 }\n", r'"state_feedback" or'),
    ("", "window = [2.0]\n", r"window\[2\] .*required"),
    ("", "window = [100, 200]\n", r"step-a: .*window = \[100, 200\].* outside"),
    ("", "window = [0, 60]\n", r"0 s to 0\.39 s"),
    ("", "window = [0.1, 0.11]\n", r"2 samples"),
    ("", "frequency = nan\n", r"frequency .*finite .*NaN"),
    ("", "window = [0, inf]\n", r"window\[2\] .*finite"),
    ("", "frequency = 1e400\n", r"frequency .*1e-30 and 1e\+30"),
    ("", f"frequency = 1{'0' * 200}\n", r"1e-30 and 1e\+30"),
    ("", f"frequency = {'1' * 5000}\n", r"too many digits"),
    ("", "frequency = -1.0\n", r"more than 0"),
    ("", "window = " + "[" * 5000 + "\n", r"too deeply"),
    ("", "a" + ".a" * 60_000 + " = 1\n", r"line 9: .*too deeply"),
    ("", 'columns = { x1 = "x9" }\n', r"'x9'; it has time, input, x1, x2"),
    ("", "columns = { x1 = 5 }\n", r"column 5, .* 4"),
    (STEP, "", r"\[\[experiments\]\]"),
    ("", "# " + "x" * 1_000_000, r"1,000,\d+ bytes, .* 1,000,000"),
    ("step.csv", "stepp.csv", r"step-a: .*'data/stepp\.csv'; .*'data/step\.csv'"),
    ("data/step.csv", "Step.csv", r"'Step\.csv'; .*'data/step\.csv'"),
    ("data/step.csv", "data\\next.csv", r"file name, found .*backslash"),
    ("[[experiments]]", "[experiments]", r"experiments: .* a list .*\[\[experiments\]\]"),
    *(("data/step.csv", name, r"is outside the sub")
      for name in ("../step.csv", "..\\\\step.csv", "/etc/passwd", "C:/step.csv", "//host/s/a")),
    ("data/step.csv", "data", r"'data' is a folder"),
    ("data/step.csv", "", r"a file name"),
    ("step.csv", "a\\u0000b", r"a file name"),
    ("step.csv", "s" * 5000, r"cannot be read|no file"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "pattern"), BAD_TOML, ids=range(len(BAD_TOML)))
def test_each_mistake_in_the_submission_file_is_one_line(old, new, pattern, tmp_path):
    """Each mistake in submission.toml gives one line, which names its key or line."""
    toml = GOOD.replace(old, new) if old else GOOD + new
    assert toml != GOOD
    one_line(write(tmp_path / "team-01", toml), pattern, most=MOST_LISTED)


@pytest.mark.parametrize(
    ("toml", "line"), [(GOOD.encode() + b'note = "\xe9t\xe9"\n', 9), (GOOD.encode("utf-16"), 1)]
)
def test_a_submission_file_that_is_no_text_is_one_line(toml, line, tmp_path):
    """A file that is not UTF-8 gives one line, which names the line of the first wrong byte."""
    one_line(write(tmp_path / "team-01", toml), rf"line {line}: not UTF-8")


def _replaced(line: int, text: str) -> str:
    rows = good_rows()
    rows[line - 1] = text
    return "\n".join(rows) + "\n"


def _ecp(body: str) -> str:
    return " Sample   Time   Commanded Pos   Encoder 1 Pos   Control Effort\n\n[" + body


ECP_ROWS = ";\n".join(f"  {i}  {0.01 * i:.3f}  0  {i}  0.5000" for i in range(20))


def _mat(**variables: object) -> bytes:
    from io import BytesIO

    stream = BytesIO()
    scipy.io.savemat(stream, variables)
    return stream.getvalue()


def _bomb() -> bytes:
    """Return a small MATLAB file with a compressed element of 300 MB of zeros."""
    compressor = zlib.compressobj(1)
    packed = compressor.compress(struct.pack("<II", 14, 300_000_000))
    packed += b"".join(compressor.compress(bytes(10_000_000)) for _ in range(30))
    packed += compressor.flush()
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    return header + struct.pack("<II", 15, len(packed)) + packed


ROWS = good_rows()
# The content of a recording, and what the message has to match.
BAD_DATA = [
    ("", r"step-a: data/step\.csv: the file is empty"),
    ("\n \n\n", r"is empty"),
    ("time,input,x1\n", r"data/step\.csv line 1: .*no rows"),
    ("# nothing\n# here\n", r"no rows of numbers"),
    ("Dear TA,\nour data got lost.\nSorry.\n", r"line \d: not a table"),
    (_replaced(12, "0.1,1,bad,0.2"), r"step\.csv line 12: 'x1' .*: 'bad'"),
    (_replaced(12, "0.1,1,,0.2"), r"line 12: 'x1' is empty"),
    (_replaced(12, "0.1,1,0.4"), r"line 12: expected 4 columns, found 3"),
    (_replaced(12, "0.1,1,0.4,1,1"), r"line 12: expected 4 columns, found 5"),
    *((_replaced(12, f"0.1,1,{cell},0.2"), r"line 12: 'x1' is not a finite")
      for cell in ("nan", "-inf", "1e999")),
    (_replaced(12, "0.1,1,1e60,0.2"), r"line 12: 'x1' is too large"),
    ("\n".join(f"{r},{0 if i else 'h' * 5_000_000}" for i, r in enumerate(ROWS)),
     r"line 1: .* 5,000,000 .* 100"),
    ("\n".join([ROWS[0], *(f"0.{i:03d},1e-30,{i},0" for i in range(50))]), r"1e-30; .*1e-12"),
    ("\n".join(re.sub(r"[^,]*$", "", r) if i % 4 == 3 else r for i, r in enumerate(ROWS)),
     r"'x2' has 30 of 40 .*line 4, 8, 12, 16 and 6 more"),
    ("time,x1\n" + "".join(f"0,0{i},1,5\n" for i in range(20)), r"line 2: expected 2 .* 4"),
    ("\n".join([*ROWS, *ROWS[1:]]), r"line 42: time goes back, from 0\.39 s to 0 s"),
    (_replaced(12, "0.09,1,0.4,0.2"), r"line 12: time stands still"),
    ("\n".join(ROWS * 2), r"several recordings"),
    ("time,x1,x1\n0,1,2\n1,2,3\n", r"line 1: .*'x1' appears twice"),
    ("\n".join(r.split(",", 1)[1] for r in ROWS), r"no time column"),
    ("\n".join(",".join(r.split(",")[:2]) for r in ROWS), r"position; it has time, input"),
    ("\n".join(",".join(r.split(",")[0::2]) for r in ROWS), r"a step needs the input"),
    ("\n".join(f"{r},{'force' if not i else 0}" for i, r in enumerate(ROWS)), r"'input' and"),
    ("\n".join(ROWS[:4]), r"at least 8 samples, found 3"),
    ("\n".join(ROWS).replace("time", "time [m]"), r"not a unit of time"),
    (_ecp(ECP_ROWS + "]\n"), r"'Encoder 1 Pos' .* counts; .* cm"),
    (_ecp(ECP_ROWS + ";\n 20  0.2"), r"line \d+: .*truncated"),
    (_ecp(ECP_ROWS + ";\n"), r"line 22: .*bracket is missing"),
    (_ecp("]\n"), r"line 3: no rows"),
    (_ecp("0 0 0;\n1 1 1]\n"), r"line 3: expected 5 columns"),
    (_ecp(ECP_ROWS + "];\n") * 2, r"two recordings"),
    (b"PK\x03\x04" + bytes(200), r"a zip archive, or .*\.xlsx"),
    (b"PK\x03\x04" + bytes(26) + b"[Content_Types].xml" + bytes(200), r"workbook is broken"),
    (b"\xd0\xcf\x11\xe0" + bytes(99), r"an old Excel"),
    (b"LabVIEW Measurement\t\nSeparator\tTab\n", r"line 1: .* cut short"),
    (b"TDSm" + bytes(10), r"broken at byte 0"),
    (gzip.compress(b"time,x1\n"), r"a gzip archive"),
    (b"\x89HDF\r\n\x1a\n" + bytes(100), r"HDF5 file"),
    (b"\x89PNG\r\n" + bytes(100), r"a picture"),
    (bytes(range(256)) * 10, r"neither text nor"),
    (b"\xff\xfea", r"broken UTF-16"),
    *((raw, r"\.mat file is damaged|damaged or truncated")
      for raw in (b"MATLAB 7.3 MAT-file" + bytes(600), b"MATLAB 5.0 MAT-file".ljust(100), _bomb(),
                  _mat(time=np.arange(99.0), x1=np.ones(99))[:-40])),
    (_mat(run={"t": 1.0}), r"run \(1 × 1, struct\)"),
    (_mat(c=np.array([1, "a"], dtype=object)), r"c \(1 × 2, cell\)"),
    (_mat(name="bench"), r"name \(1 × 5, text\)"),
    (_mat(z=np.ones(20) * 1j), r"z \(1 × 20, complex\)"),
    (_mat(time=np.arange(9.0), x1=np.ones(8)), r"time \(1 × 9, .*x1 \(1 × 8"),
    (_mat(time=np.arange(9.0), x1=np.r_[np.ones(8), np.nan]), r"sample 9: 'x1' is not a finite"),
    (_mat(a=np.ones((9, 2)), b=np.ones((9, 2))), r"\(a \(9 × 2, .*b \("),
    (_mat(data=np.random.default_rng(1).random((50, 3))), r"no column is a cart's"),
]  # fmt: skip
BAD_TABLES = [
    ("x1,x2\n1,2\n3,4\n", r"'frequency' \(Hz\); it has x1, x2"),
    ("frequency,phase\n1,2\n2,3\n", r"ratios in 'x1'"),
    ("frequency,x1\n0,1\n1,2\n", r"line 2: 'frequency' .*, found 0"),
    ("frequency,x1\n1,1\n2,-3\n", r"line 3: 'x1' .*, found -3"),
    ("frequency [m],x1\n1,1\n2,3\n", r"is in m, expected Hz"),
]


@pytest.mark.parametrize(
    ("kind", "content", "pattern"),
    [("step", *row) for row in BAD_DATA] + [("bode", *row) for row in BAD_TABLES],
    ids=range(len(BAD_DATA) + len(BAD_TABLES)),
)
def test_a_broken_data_file_is_one_line(kind, content, pattern, tmp_path):
    """A mistake in a recording or a `bode` table gives one line, which names the file's line."""
    toml = GOOD.replace('kind = "step"', f'kind = "{kind}"')
    one_line(write(tmp_path / "team-01", toml, **{"step.csv": content}), pattern)


def test_a_file_without_the_free_cart_is_one_line(tmp_path):
    """If a file measures no free cart, one line names the free carts and the measured ones."""
    folder = write(tmp_path / "team-01", GOOD + "carts = [2]\n")
    (folder / "data" / "step.csv").write_text(
        "\n".join(",".join(row.split(",")[:3]) for row in good_rows())
    )
    one_line(folder, r"step-a: .*the free carts are \[2\], but the file measures \[1\]")


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
@pytest.mark.parametrize(
    ("linked", "to"),
    [("data/step.csv", "data/step.csv"), ("data", "data"), ("submission.toml", "submission.toml"),
     ("notes.md", "submission.toml"), ("data/step.csv", ""), ("data/step.csv", "chain")],
)  # fmt: skip
def test_no_link_leads_out_of_the_submission(linked, to, tmp_path):
    """A link that leads out of the submission, or in a loop, is refused wherever it is."""
    folder, outside = write(tmp_path / "team-01"), write(tmp_path / "other")
    target = folder / linked
    if target.is_dir():
        shutil.rmtree(target)
    target.unlink(missing_ok=True)
    if to == "chain":
        (folder / "step").symlink_to(outside / linked)
        target.symlink_to(folder / "step")
    else:
        target.symlink_to(outside / to if to else target)
    one_line(folder, r"is outside the submission folder, through" if to else r"cannot be read")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize("name", ["submission.toml", "data/step.csv", "notes.md"])
def test_a_named_pipe_does_not_hang_the_reader(name, tmp_path):
    """A named pipe that nobody writes to is refused before it is opened."""
    folder = write(tmp_path / "team-01")
    (folder / name).unlink(missing_ok=True)
    os.mkfifo(folder / name)
    one_line(folder, r"is not a regular file")


SLIPS = {
    "K = 1,13": ("comma", "K = 1.13"),
    "K = -0,5 # cm/V": ("comma", "K = -0.5 # cm/V"),
    "title = “Two carts”": ("curly", 'title = "Two carts"'),
    "kind = ‘step’": ("curly", "kind = 'step'"),
    "frequency = two": ("in digits", None),
    "kind = decay": ("quotes", 'kind = "decay"'),
    "file = data/step.csv # ours": ("quotes", 'file = "data/step.csv" # ours'),
    "unit = { unit = V, sign = 1 }": ("quotes", 'unit = { unit = "V", sign = 1 }'),
    'file = "data\\step.csv"': ("backslash", 'file = "data/step.csv"'),
    'file = "C:\\Users\\me.csv"': ("backslash", 'file = "C:/Users/me.csv"'),
    "springs = [True, False]": ("lower case", "springs = [true, false]"),
    "K = −1.5": ("dash", "K = -1.5"),
    "kind\N{NO-BREAK SPACE}= 'step'": ("space", "kind = 'step'"),
    "K = 1.13 cm/V": ("unit", "K = 1.13"),
    "zeta = 5%": ("unit", ""),  # 5 % is 0.05, but cartlab does not guess
    "K = 1.2*10^-3": ("unit", "K = 1.2e-3"),
    "K = 1.2 * 3": ("unit", ""),
    "K = .5": ("point", "K = 0.5"),
    "K = 05": ("start with 0", "K = 5"),
    'kind: "step"': ("=", 'kind = "step"'),
    'kind "step"': ("=", 'kind = "step"'),
    "K =": ("after =", ""),
    "// ours": ("#", "# ours"),
    'title = "two': ("not closed", 'title = "two"'),
    "[experiments]\n[experiments]": (r"\[\[experiments\]\]", ""),
    "K = 1\nK = 2": ("already", ""),
    "springs = [true,\n[x]": ("not closed", ""),
    "input = { sign = 1": ("one line", ""),
}


@pytest.mark.parametrize("typed", SLIPS)
def test_a_typing_slip_gets_its_correction(typed, tmp_path):
    """A typing slip that breaks the TOML gives one line that says why, often with a correction."""
    write(tmp_path / "team-01", "version = 1\n" + typed + "\n")
    words, mended = SLIPS[typed]
    with pytest.raises(SubmissionError, match=rf"line [234]: .*{words}") as caught:
        load_submission(tmp_path / "team-01")
    said = str(caught.value)
    assert "not valid TOML" not in said
    assert re.findall(r": write (.*?); found", said) == [mended] * bool(mended)
    assert len(said.splitlines()) == 1


def test_a_file_of_another_experiment_is_not_proposed(tmp_path):
    """If a file is missing, a similar file that another experiment already uses is not proposed."""
    second = STEP.replace("step-a", "step-b").replace("step.csv", "step2.csv")
    folder = write(tmp_path / "team-01", GOOD + second)
    ((id, said),) = read_data(load_submission(folder)).unreadable.items()
    assert id == "step-b"
    assert said.endswith("no file 'data/step2.csv'")
    (folder / "report" / "tables").mkdir(parents=True)
    (folder / "report" / "tables" / "steps.csv").write_text("record,gain\n")  # not a recording
    (said,) = read_data(load_submission(folder)).unreadable.values()
    assert "did you mean" not in said
    (folder / "data" / "Step2.csv.csv").write_text("\n".join(good_rows()))
    (said,) = read_data(load_submission(folder)).unreadable.values()
    assert said.endswith(" mean 'data/Step2.csv.csv'?")


@pytest.mark.parametrize("path", ["nowhere", "team-01/data", "team-01/data/step.csv"])
def test_a_path_without_a_submission_is_one_line(path, tmp_path):
    """A path that is not a submission gives one line of error that says why.

    The paths are a missing folder, a folder without submission.toml, and a file of another kind.
    """
    write(tmp_path / "team-01")
    one_line_patterns = {
        "nowhere": r"no such folder",
        "team-01/data": r"contains no submission\.toml",
        "team-01/data/step.csv": r"line 1: .*; found time,input,x1,x2",
    }
    with pytest.raises(SubmissionError, match=one_line_patterns[path]) as caught:
        load_submission(tmp_path / path)
    assert "\n" not in str(caught.value)
    assert str(tmp_path)[:12] in str(caught.value)  # the full path is shown, as it was typed


def test_notes_must_be_short_text(tmp_path):
    """`notes.md` is refused unless it is UTF-8 text of at most a megabyte."""
    folder = write(tmp_path / "team-01")
    (folder / "notes.md").write_bytes(b"# \xff\xfe")
    one_line(folder, r"team-01/notes\.md line 1: not UTF-8 text")
    (folder / "notes.md").write_bytes(b"x" * 1_000_001)
    one_line(folder, r"notes\.md: 1,000,001 bytes, the limit is 1,000,000")


def test_a_huge_data_file_is_refused_before_it_is_read(tmp_path):
    """A data file that is too large is refused by its size, before any of it is read."""
    folder = write(tmp_path / "team-01")
    with (folder / "data" / "step.csv").open("wb") as stream:
        stream.truncate(10**9)
    one_line(folder, r"has 1,000,000,000 bytes, the limit is 100,000,000")
