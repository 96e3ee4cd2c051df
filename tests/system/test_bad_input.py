"""Each broken submission gives one clear line that names the file and the mistake."""

import gzip
import io
import os
import re
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


BAD_TOML = {
    "syntax": (
        HEAD + "title = two carts\n",
        r"team-01/submission\.toml line 5: put text in quotes",
    ),
    "ends in the middle": (GOOD + "[[experiments", r"line 9: .*; found \[\[experiments$"),
    "long title": (f'title = "{"t" * 201}"\n' + GOOD, r"title: expected at most 200 characters"),
    "many authors": (
        GOOD + '[[authors]]\nid = "a"\n' * 51,
        r"authors: expected at most 50 values, found a list of 51",
    ),
    "many experiments": (
        HEAD + "".join(STEP.replace("step-a", f"s{i}") for i in range(1001)),
        r"experiments: expected at most 1000 values",
    ),
    "a unit of two lines": (
        GOOD.replace('unit = "cm"', r'unit = "c\nm"'),
        r"unit: expected one line of printable characters",
    ),
    "no slip we know": (HEAD + "carts = &2\n", r"line 5: not valid TOML: Invalid value; found "),
    "empty": ("", r"version: is required"),
    "no system": ("version = 1\n", r"system: is required"),
    "no carts": ("version = 1\n[system]\n", r"system\.carts: is required"),
    "version": (GOOD.replace("version = 1", "version = 2"), r"version: expected 1, found 2"),
    "unknown table": (GOOD + "[sytem]\n", r"sytem: unknown key; did you mean 'system'\?"),
    "unknown key": (
        GOOD.replace("kind =", "knid ="),
        r"experiments\[1\]\.knid \(step-a\): unknown key; did you mean 'kind'\?",
    ),
    "unknown key, nested": (
        GOOD.replace("unit =", "units ="),
        r"system\.position\.units: unknown key; did you mean 'unit'\?",
    ),
    "unknown key, controller": (
        GOOD + 'controller = { type = "pid", kpp = 1 }\n',
        r"experiments\[1\]\.controller\.kpp \(step-a\): unknown key; did you mean 'kp'\?",
    ),
    "unknown controller": (
        GOOD + 'controller = { type = "pidd", kp = 1 }\n',
        r"found 'pidd'; did you mean 'pid'\?",
    ),
    "key with a line end": (GOOD + '"a\\nb" = 1\n', r"unknown key"),
    "folder is no key": ('folder = "/etc"\n' + GOOD, r"folder: unknown key"),
    "text for a number": (
        GOOD.replace("carts = 2", 'carts = "2"'),
        r"system\.carts: expected a whole number, found '2'",
    ),
    "decimal carts": (GOOD.replace("carts = 2", "carts = 2.0"), r"expected a whole number"),
    "number for a text": (GOOD.replace('"step-a"', "7"), r"experiments\[1\]\.id: expected text"),
    "table for a list": (GOOD + "carts = { a = 1 }\n", r"expected a list .* found a table"),
    "list for a table": (
        GOOD.replace('{ unit = "cm" }', "[1]"),
        r"system\.position: expected a table",
    ),
    "date for a number": (GOOD + "frequency = 1979-05-27\n", r"frequency .*expected a number"),
    "true for a number": (GOOD + "frequency = true\n", r"expected a number, found True"),
    "too many carts": (
        GOOD.replace("carts = 2", "carts = 7"),
        r"system\.carts: expected at most 4",
    ),
    "no cart": (GOOD.replace("carts = 2", "carts = 0"), r"system\.carts: expected at least 1"),
    "cart out of range": (
        GOOD + "carts = [1, 3]\n",
        r"experiments\[1\]\.carts\[2\] \(step-a\): there is no cart 3, the system has carts 1 to 2",
    ),
    "cart twice": (GOOD + "carts = [1, 1]\n", r"a cart is named twice"),
    "controlled cart": (GOOD + "controlled_cart = 0\n", r"controlled_cart .*there is no cart 0"),
    "pid cart": (GOOD + 'controller = { type = "pid", cart = 9 }\n', r"there is no cart 9"),
    "design cart": (GOOD + "[design]\ncart = 3\n", r"design\.cart: there is no cart 3"),
    "springs": (
        GOOD.replace("carts = 2", "carts = 2\nsprings = [true, true]"),
        r"system\.springs: expected 3 values \(wall-1, 1-2, 2-wall\), found 2",
    ),
    "springs as numbers": (
        GOOD.replace("carts = 2", "carts = 2\nsprings = [1, 1, 1]"),
        r"system\.springs\[1\]: expected true or false, found 1",
    ),
    "kind": (
        GOOD.replace('kind = "step"', 'kind = "stpe"'),
        r"experiments\[1\]\.kind \(step-a\): expected .*found 'stpe'; did you mean 'step'\?",
    ),
    "id twice": (GOOD + STEP, r"experiments\[2\]\.id \(step-a\): used before, by experiments\[1\]"),
    "id with a line end": (GOOD.replace("step-a", "a\\nb"), r"expected 1 to 100 printable"),
    "controller type": (GOOD + 'controller = { type = "lqg" }\n', r"'state_feedback', 'pid'"),
    "controller without type": (GOOD + "controller = { kp = 1 }\n", r"\"state_feedback\" or"),
    "gains": (
        GOOD + 'controller = { type = "state_feedback", gains = [1, 2, 3] }\n',
        r"controller\.gains .*expected 4 gains .*found 3",
    ),
    "window reversed": (GOOD + "window = [2.0, 1.0]\n", r"window .*start before end"),
    "window of one": (GOOD + "window = [2.0]\n", r"window\[2\] .*is required"),
    "window outside": (
        GOOD + "window = [100, 200]\n",
        r"step-a: .*window = \[100, 200\] lies outside",
    ),
    "window too long": (GOOD + "window = [0, 60]\n", r"run from 0 s to 0\.39 s"),
    "window too short": (GOOD + "window = [0.1, 0.11]\n", r"holds 2 samples"),
    "nan": (GOOD + "frequency = nan\n", r"frequency .*finite number, found NaN"),
    "infinity": (GOOD + "window = [0, inf]\n", r"window\[2\] .*finite number"),
    "huge number": (GOOD + "frequency = 1e400\n", r"frequency .*1e-30 and 1e\+30"),
    "huge whole number": (GOOD + f"frequency = 1{'0' * 200}\n", r"1e-30 and 1e\+30"),
    "thousands of digits": (GOOD + f"frequency = {'1' * 5000}\n", r"too many digits"),
    "negative frequency": (GOOD + "frequency = -1.0\n", r"expected more than 0"),
    "deep list": (GOOD + "window = " + "[" * 5000 + "\n", r"nest too deeply"),
    "deep key": (GOOD + "a" + ".a" * 60_000 + " = 1\n", r"line 9: keys nest too deeply"),
    "column role": (GOOD + 'columns = { x3 = "x2" }\n', r"columns\.x3 .*unknown column"),
    "column number": (GOOD + "columns = { x1 = 0 }\n", r"columns count from 1"),
    "column missing": (
        GOOD + 'columns = { x1 = "x9" }\n',
        r"no column 'x9'; it has time, input, x1, x2",
    ),
    "column too far": (GOOD + "columns = { x1 = 5 }\n", r"no column 5, the file has 4"),
    "no experiments": (HEAD, r"no \[\[experiments\]\] table yet"),
    "not UTF-8": (GOOD.encode() + b'note = "\xe9t\xe9"\n', r"line 9: not UTF-8 text"),
    "UTF-16": (GOOD.encode("utf-16"), r"line 1: not UTF-8 text"),
    "too large": (GOOD + "# " + "x" * 1_000_000, r"1,000,\d+ bytes, the limit is 1,000,000"),
    "file missing": (
        GOOD.replace("step.csv", "stepp.csv"),
        r"step-a: there is no file 'data/stepp\.csv'; "
        r"did you mean 'data/step\.csv'\?",
    ),
    "file without its folder": (
        GOOD.replace("data/step.csv", "Step.csv"),
        r"there is no file 'Step\.csv'; did you mean 'data/step\.csv'\?",
    ),
    "file with an escape": (
        GOOD.replace("data/step.csv", "data\\next.csv"),
        r"expected a file name, found .*backslash",
    ),
    "experiments in single brackets": (
        GOOD.replace("[[experiments]]", "[experiments]"),
        r"experiments: expected a list .*; start each with \[\[experiments\]\]",
    ),
    "file above": (
        GOOD.replace("data/step.csv", "../step.csv"),
        r"is outside the submission folder",
    ),
    "file above, Windows": (GOOD.replace("data/step.csv", "..\\\\step.csv"), r"is outside the sub"),
    "file absolute": (
        GOOD.replace("data/step.csv", "/etc/passwd"),
        r"is outside the submission folder",
    ),
    "file absolute, Windows": (GOOD.replace("data/step.csv", "C:/step.csv"), r"is outside the sub"),
    "file on a share": (GOOD.replace("data/step.csv", "//host/s/a.csv"), r"is outside the sub"),
    "file is a folder": (GOOD.replace("data/step.csv", "data"), r"'data' is a folder"),
    "file without a name": (GOOD.replace("data/step.csv", ""), r"expected a file name"),
    "file with a null": (GOOD.replace("step.csv", "a\\u0000b"), r"expected a file name"),
    "file name too long": (GOOD.replace("step.csv", "s" * 5000), r"cannot be read|no file"),
}


# Mistakes in the reported numbers, which cost only the number or list concerned.
BAD_NUMBERS = {
    "many digits": (
        GOOD + f"[reported.final]\nK_1 = 1.{'3' * 500_000}\n",
        r"K_1: expected a number of at most 1000 digits",
    ),
    "no physical number": (
        GOOD + "[reported.final]\nK_1 = 1e31\n",
        r"K_1: expected a number between",
    ),
    "nan reported": (GOOD + "[reported.final]\nK_1 = nan\n", r"reported\.final\.K_1: .*finite"),
    "parameter": (
        GOOD + "[reported.final]\nK1 = 2.0\n",
        r"reported\.final\.K1: unknown parameter; did you mean 'K_1'\?",
    ),
    "parameter, fewer carts": (
        GOOD + "[reported.initial]\nomega_x = 2.0\n",
        r"reported\.initial\.omega_x: unknown parameter",
    ),
    "reported text": (GOOD + '[reported.final]\nK_1 = "2"\n', r"K_1: expected a number, found '2'"),
    "A": (GOOD + "[reported.state_space]\nA = [[1, 2]]\n", r"expected 4 rows of 4 numbers"),
    "B": (GOOD + "[reported.state_space]\nB = [[1], [2]]\n", r"expected 4 numbers, found 2"),
    "reported gains": (GOOD + "[reported.feedback]\ngains = [1]\n", r"expected 4 gains"),
}


@pytest.mark.parametrize(("toml", "pattern"), BAD_TOML.values(), ids=BAD_TOML.keys())
def test_each_mistake_in_the_submission_file_is_one_line(toml, pattern, tmp_path):
    """Each mistake in submission.toml gives one line, which names its key or line."""
    one_line(write(tmp_path / "team-01", toml), pattern, most=MOST_LISTED)


@pytest.mark.parametrize(("toml", "pattern"), BAD_NUMBERS.values(), ids=BAD_NUMBERS.keys())
def test_each_mistake_in_a_reported_number_costs_this_number(toml, pattern, tmp_path):
    """Each mistake in a reported number leaves the number out, with one line that names it."""
    folder = write(tmp_path / "team-01", toml)
    (part,) = load_submission(folder).unread
    assert "\n" not in part.message
    assert re.search(pattern, part.message)


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


BAD_DATA = {
    "empty": ("", r"step-a: data/step\.csv: the file is empty"),
    "blank lines": ("\n \n\n", r"the file is empty"),
    "heading only": ("time,input,x1\n", r"data/step\.csv line 1: headings, but no rows"),
    "comments only": ("# nothing\n# here\n", r"holds no rows of numbers"),
    "prose": ("Dear TA,\nour data got lost.\nSorry.\n", r"line \d: not a table of numbers"),
    "a word": (_replaced(12, "0.1,1,bad,0.2"), r"step\.csv line 12: 'x1' is not a number: 'bad'"),
    "an empty field": (_replaced(12, "0.1,1,,0.2"), r"line 12: 'x1' is empty"),
    "a column short": (_replaced(12, "0.1,1,0.4"), r"line 12: expected 4 columns, found 3"),
    "a column more": (_replaced(12, "0.1,1,0.4,1,1"), r"line 12: expected 4 columns, found 5"),
    "nan": (_replaced(12, "0.1,1,nan,0.2"), r"line 12: 'x1' is not a finite number"),
    "infinity": (_replaced(12, "0.1,1,-inf,0.2"), r"line 12: 'x1' is not a finite number"),
    "overflow": (_replaced(12, "0.1,1,1e999,0.2"), r"line 12: 'x1' is not a finite number"),
    "too large": (_replaced(12, "0.1,1,1e60,0.2"), r"line 12: 'x1' is too large"),
    "long heading": (
        "\n".join(f"{r},{0 if i else 'h' * 5_000_000}" for i, r in enumerate(good_rows())),
        r"line 1: a heading of 5,000,000 characters; the limit is 100",
    ),
    "beyond any bench": (
        "\n".join([good_rows()[0], *(f"0.{i:03d},1e-30,{i},0" for i in range(50))]),
        r"the input reaches 1e-30; expected 1e-12 to",
    ),
    "many empty cells": (
        "\n".join(re.sub(r"[^,]*$", "", r) if i % 4 == 3 else r for i, r in enumerate(good_rows())),
        r"'x2' has 30 of 40 values, missing in line 4, 8, 12, 16 and 6 more; fill",
    ),
    "decimal commas": (
        "time,x1\n" + "".join(f"0,0{i},1,5\n" for i in range(20)),
        r"line 2: expected 2 columns, found 4",
    ),
    "time goes back": (
        "\n".join([*good_rows(), *good_rows()[1:]]) + "\n",
        r"line 42: time goes back, from 0\.39 s to 0 s; were two recordings pasted together\?",
    ),
    "time stands still": (_replaced(12, "0.09,1,0.4,0.2"), r"line 12: time stands still"),
    "second heading": (
        "\n".join(good_rows() * 2) + "\n",
        r"holds several recordings",
    ),
    "heading twice": ("time,x1,x1\n0,1,2\n1,2,3\n", r"line 1: the heading 'x1' appears twice"),
    "no time": ("\n".join(r.split(",", 1)[1] for r in good_rows()), r"no time column"),
    "no position": (
        "\n".join(",".join(r.split(",")[:2]) for r in good_rows()),
        r"no column is a cart's position; it has time, input",
    ),
    "no input": (
        "\n".join(",".join(r.split(",")[0::2]) for r in good_rows()),
        r"a step needs the input, and no column is one",
    ),
    "two inputs": (
        "\n".join(f"{r},{'force' if not i else 0}" for i, r in enumerate(good_rows())),
        r"'input' and 'force' both look like input",
    ),
    "few samples": ("\n".join(good_rows()[:4]) + "\n", r"at least 8 samples, found 3"),
    "time in metres": ("\n".join(good_rows()).replace("time", "time [m]"), r"not a unit of time"),
    "counts without a scale": (
        _ecp(ECP_ROWS + "]\n"),
        r"'Encoder 1 Pos' holds encoder counts; state how many cm one count is.*or use counts",
    ),
    "ECP cut in a row": (_ecp(ECP_ROWS + ";\n 20  0.2"), r"line \d+: .*truncated"),
    "ECP without the bracket": (_ecp(ECP_ROWS + ";\n"), r"line 22: the closing bracket is missing"),
    "ECP nothing inside": (_ecp("]\n"), r"line 3: no rows after the opening bracket"),
    "ECP other heading": (
        _ecp("0 0 0;\n1 1 1]\n"),
        r"line 3: expected 5 columns as in the heading",
    ),
    "ECP twice": (_ecp(ECP_ROWS + "];\n") * 2, r"two recordings were pasted"),
    "archive": (
        b"PK\x03\x04" + bytes(200),
        r"a zip archive, or .*: save the sheet as .xlsx or CSV",
    ),
    "workbook": (
        b"PK\x03\x04" + bytes(26) + b"[Content_Types].xml" + bytes(200),
        r"the workbook is broken or cut short",
    ),
    "old workbook": (b"\xd0\xcf\x11\xe0" + bytes(99), r"an old Excel workbook, or a locked one"),
    "LabVIEW cut short": (b"LabVIEW Measurement\t\nSeparator\tTab\n", r"line 1: .* cut short"),
    "TDMS cut short": (b"TDSm" + bytes(10), r"broken at byte 0"),
    "gzip": (gzip.compress(b"time,x1\n"), r"a gzip archive; unpack it"),
    "HDF5": (b"\x89HDF\r\n\x1a\n" + bytes(100), r"an HDF5 file that MATLAB did not write"),
    "MATLAB 7.3": (b"MATLAB 7.3 MAT-file" + bytes(600), r"the \.mat file is damaged or truncated"),
    "picture": (b"\x89PNG\r\n" + bytes(100), r"a picture; export the recording as CSV"),
    "binary": (bytes(range(256)) * 10, r"neither text nor a \.mat file"),
    "broken UTF-16": (b"\xff\xfea", r"broken UTF-16 text"),
    ".mat header only": (b"MATLAB 5.0 MAT-file".ljust(100), r"the \.mat file is damaged"),
    ".mat cut short": (_mat(time=np.arange(99.0), x1=np.ones(99))[:-40], r"damaged or truncated"),
    ".mat bomb": (_bomb(), r"damaged or truncated"),
    ".mat struct": (
        _mat(run={"t": 1.0}),
        r"but run \(1 × 1, struct\)",
    ),
    ".mat cell": (_mat(c=np.array([1, "a"], dtype=object)), r"but c \(1 × 2, cell\)"),
    ".mat text": (_mat(name="bench"), r"but name \(1 × 5, text\)"),
    ".mat complex": (_mat(z=np.ones(20) * 1j), r"but z \(1 × 20, complex\)"),
    ".mat lengths": (
        _mat(time=np.arange(9.0), x1=np.ones(8)),
        r"time \(1 × 9, .*x1 \(1 × 8",
    ),
    ".mat nan": (
        _mat(time=np.arange(9.0), x1=np.r_[np.ones(8), np.nan]),
        r"sample 9: 'x1' is not a finite number",
    ),
    ".mat matrices": (
        _mat(a=np.ones((9, 2)), b=np.ones((9, 2))),
        r"matrices \(a \(9 × 2, .*b \(",
    ),
    ".mat bare": (_mat(data=np.random.default_rng(1).random((50, 3))), r"no column is a cart's"),
}


@pytest.mark.parametrize(("content", "pattern"), BAD_DATA.values(), ids=BAD_DATA.keys())
def test_a_broken_data_file_is_one_line(content, pattern, tmp_path):
    """A mistake in a data file gives one line of error, which names the line of the file."""
    one_line(write(tmp_path / "team-01", **{"step.csv": content}), pattern)


BAD_TABLES = {
    "no frequency": ("x1,x2\n1,2\n3,4\n", r"needs a column 'frequency' \(Hz\); it has x1, x2"),
    "no ratio": ("frequency,phase\n1,2\n2,3\n", r"needs amplitude ratios in 'x1'"),
    "zero frequency": ("frequency,x1\n0,1\n1,2\n", r"line 2: 'frequency' must be above 0, found 0"),
    "negative ratio": ("frequency,x1\n1,1\n2,-3\n", r"line 3: 'x1' must be above 0, found -3"),
    "frequency in metres": ("frequency [m],x1\n1,1\n2,3\n", r"is in m, expected Hz"),
}


@pytest.mark.parametrize(("content", "pattern"), BAD_TABLES.values(), ids=BAD_TABLES.keys())
def test_a_broken_bode_table_is_one_line(content, pattern, tmp_path):
    """A `bode` table without positive frequencies and amplitude ratios gives one line of error."""
    toml = GOOD.replace('kind = "step"', 'kind = "bode"')
    one_line(write(tmp_path / "team-01", toml, **{"step.csv": content}), pattern)


def test_a_file_without_the_free_cart_is_one_line(tmp_path):
    """If a file measures no free cart, one line names the free carts and the measured ones."""
    folder = write(tmp_path / "team-01", GOOD + "carts = [2]\n")
    (folder / "data" / "step.csv").write_text(
        "\n".join(",".join(row.split(",")[:3]) for row in good_rows())
    )
    one_line(folder, r"step-a: .*the free carts are \[2\], but the file measures \[1\]")


@pytest.mark.skipif(os.name == "nt", reason="links need a privilege on Windows")
@pytest.mark.parametrize("place", ["file", "folder", "toml", "notes", "loop", "chain"])
def test_no_link_leads_out_of_the_submission(place, tmp_path):
    """A link that leads out of the submission, or in a loop, is refused wherever it is."""
    folder = write(tmp_path / "team-01")
    outside = write(tmp_path / "other")
    target, pattern = (
        folder / "data" / "step.csv",
        r"is outside the submission folder, through a link",
    )
    if place == "folder":
        target = folder / "data"
        (target / "step.csv").unlink()
        target.rmdir()
        target.symlink_to(outside / "data")
    elif place == "toml":
        target = folder / "submission.toml"
        target.unlink()
        target.symlink_to(outside / "submission.toml")
    elif place == "notes":
        (folder / "notes.md").symlink_to(outside / "submission.toml")
    else:
        target.unlink()
        if place == "loop":
            target.symlink_to(target)
            pattern = r"cannot be read"
        elif place == "chain":
            (folder / "step").symlink_to(outside / "data" / "step.csv")
            target.symlink_to(folder / "step")
        else:
            target.symlink_to(outside / "data" / "step.csv")
    one_line(folder, pattern)


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
    with pytest.raises(SubmissionError, match=rf"toml line [234]: .*{words}") as caught:
        load_submission(tmp_path / "team-01")
    said = str(caught.value)
    assert "not valid TOML" not in said
    assert re.findall(r": write (.*?); found", said) == [mended] * bool(mended)
    assert len(said.splitlines()) == 1


def test_a_file_of_another_experiment_is_not_proposed(tmp_path):
    """If a file is missing, a similar file that another experiment already uses is not proposed."""
    second = STEP.replace("step-a", "step-b").replace("step.csv", "step2.csv")
    folder = write(tmp_path / "team-01", GOOD + second)
    assert read_data(load_submission(folder)).unreadable == {
        "step-b": "there is no file 'data/step2.csv'"
    }
    (folder / "report" / "tables").mkdir(parents=True)
    (folder / "report" / "tables" / "steps.csv").write_text("record,gain\n")  # not a recording
    (said,) = read_data(load_submission(folder)).unreadable.values()
    assert "did you mean" not in said
    (folder / "data" / "Step2.csv.csv").write_text("\n".join(good_rows()))
    (said,) = read_data(load_submission(folder)).unreadable.values()
    assert said.endswith("; did you mean 'data/Step2.csv.csv'?")


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
