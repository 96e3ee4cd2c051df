"""A file that is made to cost hours or gigabytes costs only its own recording."""

import gc
import re
import shutil
import subprocess
import sys
import time
import zlib
from io import BytesIO
from itertools import product

import h5py
import numpy as np
import pytest

from pipeline.errors import SubmissionError
from pipeline.ingest import columns, files, text, workbook
from pipeline.ingest.files import parse_table, read_table
from pipeline.ingest.read import read_data
from pipeline.resources import EXAMPLES
from pipeline.submission import load_submission, toml
from pipeline.submission.load import NAME
from tests.helpers.recordings import package


def in_matlab(fill) -> bytes:
    """Return a `.mat` file of version 7.3 whose content `fill` writes."""
    buffer = BytesIO()
    with h5py.File(buffer, "w", userblock_size=512) as file:
        fill(file)
    return b"MATLAB 7.3".ljust(512, b"\0") + buffer.getvalue()[512:]


def inflating(file: h5py.File) -> None:
    """Write one chunk that unpacks to 4 GB."""
    zeros = np.zeros((1, 100_000))
    signal = file.create_dataset("x1", data=zeros, chunks=zeros.shape, compression="gzip")
    signal.attrs["MATLAB_class"] = np.bytes_("double")
    packer = zlib.compressobj(9)
    first, again = (
        packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2)
    )
    signal.id.write_direct_chunk((0, 0), first + 4_000 * again + packer.flush())


def with_many_names(file: h5py.File) -> None:
    """Write structs with a million fields, which are all the same number."""
    group = file.create_group("s0")
    number = group.create_dataset("f0", data=np.zeros((1, 1)))
    for i in range(1, 1000):
        group[f"f{i}"] = number
        file[f"s{i}"] = group


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize("fill", [inflating, with_many_names])
@pytest.mark.parametrize("apart", [False, True])
def test_a_bomb_costs_its_recording(fill, apart, tmp_path):
    """A `.mat` file that unpacks to gigabytes, or has a million names, is refused.

    It makes no difference whether it is read in a process of its own.
    """
    shutil.copytree(EXAMPLES / "one-cart", tmp_path / "team")
    toml = (tmp_path / "team" / NAME).read_text(encoding="utf-8")
    (tmp_path / "team" / "data" / "bomb.mat").write_bytes(in_matlab(fill))
    named = toml.replace("data/step-1.csv", "data/bomb.mat")
    assert named != toml
    (tmp_path / "team" / NAME).write_text(named, encoding="utf-8")
    begin = time.process_time()
    before = files.OF_STRANGERS.set(apart)
    try:
        data = read_data(load_submission(tmp_path / "team"))
    finally:
        files.OF_STRANGERS.reset(before)
    assert len(data.unreadable) == 1
    reason = next(iter(data.unreadable.values()))
    assert re.search("damaged|memory|processor", reason)
    assert time.process_time() - begin < 20  # s; it takes 2. The names alone took 400


def test_the_time_to_read_one_file_is_limited(tmp_path, monkeypatch):
    """A file that takes too long is refused by itself, and the next one is read."""
    (tmp_path / "long.csv").write_text("time,x1\n" + "0.001,12\n" * 400_000, encoding="utf-8")
    (tmp_path / "short.csv").write_text("time,x1\n0,1\n1,2\n", encoding="utf-8")
    monkeypatch.setattr(files, "MOST_SECONDS", 0.02)  # s; the long file takes ten times that
    gc.disable()  # an exception in one of its callbacks would be dropped, and be raised a second on
    try:
        with pytest.raises(SubmissionError, match=r"^long\.csv:.*\b0\.02\b"):
            read_table(tmp_path, "long.csv")
    finally:
        gc.enable()
    monkeypatch.undo()
    assert read_table(tmp_path, "short.csv")[0].values.shape == (2, 2)
    assert read_table(tmp_path, "long.csv")[0].values.shape == (2, 400_000)


# A process that has read other files keeps freed memory, which a limit of growth leaves to it.
_MEMORY_TO_READ = r"""
from pathlib import Path
import sys
import pytest
from pipeline.errors import SubmissionError
from pipeline.ingest import files
from pipeline.ingest.files import read_table
from pipeline.processes import limited_memory

folder = Path(sys.argv[1])
enough = files.MOST_MEMORY
# Here is the limit of a whole submission.
with limited_memory(20_000_000), pytest.raises(MemoryError):
    read_table(folder, "long.csv")

files.MOST_MEMORY = 10_000_000
with pytest.raises(SubmissionError, match=r"^long\.csv:.*\b0\.01\b"):
    read_table(folder, "long.csv")
assert read_table(folder, "short.csv")[0].values.shape == (2, 2)
files.MOST_MEMORY = enough
assert read_table(folder, "long.csv")[0].values.shape == (2, 2_000_000)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits address space")
def test_the_memory_to_read_one_file_is_limited(tmp_path):
    """A file that takes too much memory is refused by itself, and the next one is read."""
    (tmp_path / "long.csv").write_text("time,x1\n" + "0.001,12\n" * 2_000_000, encoding="utf-8")
    (tmp_path / "short.csv").write_text("time,x1\n0,1\n1,2\n", encoding="utf-8")
    subprocess.run([sys.executable, "-c", _MEMORY_TO_READ, tmp_path], check=True)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits address space")
def test_a_workbook_that_inflates_is_refused_by_itself(tmp_path, monkeypatch):
    """A workbook that unpacks to much more than its size needs too much memory, whoever sent it."""
    (tmp_path / "a.xlsx").write_bytes(package("<worksheet>" + " " * 300_000_000 + "</worksheet>"))
    monkeypatch.setattr(files, "MOST_MEMORY", 20_000_000)
    with pytest.raises(SubmissionError, match=r"^a\.xlsx:.*\b0\.02\b"):
        read_table(tmp_path, "a.xlsx")


# The patterns that are applied to text of any length, and how.
PATTERNS = {
    f"{module.__name__}.{name}": pattern
    for module in (text, workbook, columns, toml)
    for name, pattern in vars(module).items()
    if isinstance(pattern, re.Pattern)
    and isinstance(pattern.pattern, str)
    and name != "_HEADING"  # it is for lines of 300 characters
}
LONG = 50_000  # characters; a pattern that takes time with their square needs minutes


@pytest.mark.parametrize("name", PATTERNS)
def test_patterns_take_time_in_proportion_to_the_text(name):
    """No pattern that reads a student's text takes much longer for long repetitions."""
    pattern = PATTERNS[name]
    find = pattern.search if name.endswith("OPENING") else pattern.match
    for unit in (",", " ", "[", "(", "x", "1", "\n", "a=", "[ ", "t", "] #", ";"):
        begin = time.process_time()
        for start, end in product(("", "x", "[", "a = "), ("", "!")):
            find(start + unit * (LONG // len(unit)) + end)
        assert time.process_time() - begin < 5, unit  # s; each takes a few ms


def test_a_line_of_commas_is_refused_at_once():
    """A text of one long line of delimiters is refused, in time proportional to its length."""
    begin = time.process_time()
    with pytest.raises(SubmissionError, match="line 1"):
        parse_table(b"x" + b"," * 1_000_000, source="a.csv")
    assert time.process_time() - begin < 20  # s; it takes 1. With a square it took hours
