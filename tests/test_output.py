"""An output file is written whole, in its own folder, and never through a link."""

import csv
import errno
import io
import os
import re
import unicodedata
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import ConfigError
from pipeline.output import (
    check_folder,
    csv_text,
    escape_formula,
    new_folder,
    own_folder,
    write_file,
)


def test_a_file_is_replaced_whole(tmp_path):
    """An existing file is replaced by its new content, and no temporary file is left."""
    path = tmp_path / "results.json"
    write_file(path, "old")
    write_file(path, "ω\n")
    assert path.read_bytes() == "ω\n".encode()
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


@pytest.mark.parametrize("failures", [3, 99])
def test_a_file_that_is_being_read_on_windows_is_replaced(tmp_path, failures, monkeypatch):
    """Windows replaces no open file: a write tries again for a while, and then fails cleanly."""
    path, move, left = tmp_path / "results.json", Path.replace, [failures]
    write_file(path, "old")

    def refused(part: Path, target: Path) -> Path:
        left[0] -= 1
        if left[0] >= 0:
            raise PermissionError(errno.EACCES, "Access is denied", str(part))
        return move(part, target)

    monkeypatch.setattr(Path, "replace", refused)
    monkeypatch.setattr("pipeline.output.sys.platform", "linux")
    with pytest.raises(PermissionError):  # other systems replace open files: this is final there
        write_file(path, "new")
    assert left == [failures - 1]
    monkeypatch.setattr("pipeline.output.sys.platform", "win32")
    monkeypatch.setattr("pipeline.output.time.sleep", lambda _: None)
    with pytest.raises(PermissionError) if failures == 99 else nullcontext():
        write_file(path, "new")
    assert path.read_text() == ("old" if failures == 99 else "new")
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


def test_simultaneous_writes_leave_one_whole_file(tmp_path):
    """If many threads write a file, it holds the text of one; a failed write leaves no file."""
    path, texts = tmp_path / "notes.md", [str(i) * 300_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda text: write_file(path, text), 5 * texts))
    assert path.read_text() in texts
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError, match="folder"):
        write_file(tmp_path / "folder", "x")
    assert {p.name for p in tmp_path.iterdir()} == {"notes.md", "folder"}


def test_a_write_removes_old_temporary_files(tmp_path):
    """A write removes the old temporary files of writes that were killed, and no other files.

    Newer temporary files may still be in use, and a student may have a file with a similar name.
    """
    names = [f".{16 * '0'}.part", f".{16 * '1'}.part", ".mine.part", "left.part"]
    for name in names:
        (tmp_path / name).write_text("half")
    for name in (names[0], *names[2:]):
        os.utime(tmp_path / name, (0, 0))
    write_file(tmp_path / "notes.md", "whole")
    assert {p.name for p in tmp_path.iterdir()} == {"notes.md", *names[1:]}


def test_a_link_is_replaced_not_followed(tmp_path):
    """A link in a submission is replaced by the output file; the link's target is unchanged."""
    victim = tmp_path / "victim"
    victim.write_text("precious")
    link = tmp_path / "report.html"
    link.symlink_to(victim)
    write_file(link, "ours")
    assert victim.read_text() == "precious"
    assert (link.read_text(), link.is_symlink()) == ("ours", False)


def test_a_folder_that_may_not_be_used_is_refused(tmp_path):
    """A link to elsewhere, a file in the way and a submission's full folder are refused."""
    elsewhere, link, file = (tmp_path / name for name in ("elsewhere", "report", "out"))
    elsewhere.mkdir()
    link.symlink_to(elsewhere)
    file.write_text("")
    with pytest.raises(ConfigError, match=r"link.*--out"):
        own_folder(tmp_path, "report")
    assert check_folder(link).is_dir()  # allowed if the user names it
    with pytest.raises(ConfigError, match=r"out: .*file"):
        check_folder(file)
    assert new_folder(tmp_path / "fresh") == tmp_path / "fresh"
    assert new_folder(elsewhere) == elsewhere
    with pytest.raises(ConfigError, match="not empty"):
        new_folder(tmp_path)


# ------------------------------------------------------------------------------- CSV


_SIGNS = ["=1+1", "+cmd", "-2+3", "@SUM(A1)", "-1-1", "＝1", "﹦1", "-１"]
_HIDING = [
    "", " ", "\t", "\r", "\n", "\v", "\0", "\x85", "\u00a0", "\u00ad", "\u200b", "\u200e", "\u202e",
    "\u2028", "\u3000", "\ufeff", "\ud800", "\U000e0020", "\r\n \u3000",
]  # fmt: skip


@pytest.mark.parametrize("sign", _SIGNS)
@pytest.mark.parametrize("hidden", _HIDING)
@pytest.mark.parametrize("before", ["", "x;", 'x;"', "x; '"])
def test_formulas_are_neutralised(before, hidden, sign):
    """A formula is quoted at a cell's start or after a semicolon, even behind hidden characters."""
    text = escape_formula(before + hidden + sign)
    assert text.isprintable()
    assert re.match(r"(x;)?'[ \"']*" + re.escape(sign), text)


_MEANT = st.text(st.sampled_from("=+-@;,\"'\r\n\t \u3000\u00ad\u200eab1")) | st.text()


@given(st.lists(st.lists(_MEANT, min_size=2, max_size=2), max_size=4))
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_texts_add_no_rows_and_no_formulas(separator, rows):
    """With any separator, a spreadsheet sees exactly the rows that were written, and no formula."""
    text = csv_text(("a", "b"), rows)
    assert not [c for c in text if unicodedata.category(c).startswith("C") and c != "\n"]
    assert text.count("\n") == len(rows) + 1
    back = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator))
    if separator == ",":
        assert back == [["a", "b"], *([escape_formula(cell) for cell in row] for row in rows)]
    cells = [cell for row in back for cell in row]
    # A dash for a missing value is not quoted. A program that joins it with the next comma sees no
    # formula.
    number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?|-(,.*)?", re.IGNORECASE | re.DOTALL)
    assert not [c for c in cells if c.lstrip()[:1] in [*"=+-@"] and not number.fullmatch(c)]


def test_numbers_stay_bare_and_texts_are_quoted():
    """In a table numbers are bare and texts quoted; a missing number is an empty cell."""
    rows = [("1024", 17.50, np.float64(1 / 3), np.int64(3), float("nan"), None, 'a "b"')]
    assert csv_text("abcdefg", rows).splitlines()[1] == '"1024",17.5,0.3333333333,3,,,"a ""b"""'
