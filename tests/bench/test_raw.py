"""The raw file describes itself, holds the bytes as they came, and survives interruptions."""

import pytest

from pipeline.bench.experiments import log_text, readings_of, save_record
from pipeline.bench.raw import RawHeader, RawWriter, read_raw
from pipeline.errors import DataError
from pipeline.ingest.read import read_data
from pipeline.protocol import Description, Reading, format_reading
from pipeline.submission import load_submission
from tests.helpers.acquisitions import LIMITS, sine

HEADER = RawHeader(
    recording=sine("sine-µ", seconds=0.5), limits=LIMITS, commands=("d;s;o;o;2;82;1;",),
    bench=Description(name="b", encoders=2, carts=2, commands=frozenset("sk")),
    begun="2026-01-01T10:00:00+01:00",
)  # fmt: skip
LINES = [
    Reading(counts=(i, -2 * i), target=i % 50, duty=i % 50, ms=round(1.0024 * i)) for i in range(40)
]
LUMPS = [b"".join(map(format_reading, LINES[start : start + 8])) for start in range(0, 40, 8)]


@pytest.fixture
def raw(tmp_path):
    """Return the path of a raw file of five chunks."""
    path = tmp_path / "raw" / "sine-1.raw"
    with RawWriter(path, HEADER) as writer:
        for lump in LUMPS:
            writer.write(lump)
    return path


def test_a_raw_file_is_read_as_written(raw):
    """Header, bytes and chunks of a raw file are read as written, with rising times."""
    run = read_raw(raw)
    assert run.header == HEADER
    assert run.content == b"".join(LUMPS)
    assert [lump for lump, _ in run.lumps()] == LUMPS
    times = [at for _, at in run.arrivals]
    assert times == sorted(times)
    assert readings_of(run) == tuple(LINES)


@pytest.mark.parametrize("which", [".raw", ".times"])
def test_a_file_cut_at_any_byte_is_read_up_to_there(raw, which):
    """A raw file cut anywhere gives every complete line before the cut, and no other line."""
    path = raw.with_suffix(which)
    whole = path.read_bytes()
    first = len(HEADER.to_json().encode()) + 1 if which == ".raw" else 0
    for end in range(first, len(whole)):
        path.write_bytes(whole[:end])
        run = read_raw(raw)
        readings = readings_of(run)
        assert readings == tuple(LINES[: run.content.count(b"\n")])
        if which == ".times":
            assert len(readings) == len(LINES)


def test_a_raw_file_is_never_overwritten(raw):
    """A second run of the same name is refused, and the first raw file stays."""
    with pytest.raises(FileExistsError), RawWriter(raw, HEADER):
        pass
    assert read_raw(raw).content == b"".join(LUMPS)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "first line"), (b'{"schema": "cartlab-raw/1"', "first line"),
        (b"1:2:3:4:5\n", "not a"), (b'{"schema": "cartlab-raw/9"}\n', "'cartlab-raw/9'"),
        (b'{"schema": "cartlab-raw/1", "bench": 3}\n', "not a"), (b"[1]\n", "not a"),
    ],
)  # fmt: skip
def test_a_file_without_a_header_is_refused(tmp_path, content, why):
    """A file without a whole header gives one error that names the file."""
    path = tmp_path / "strange.raw"
    path.write_bytes(content)
    with pytest.raises(DataError, match=f"strange.raw: .*{why}"):
        read_raw(path)


def test_the_record_reads_as_a_bench_log(raw, tmp_path):
    """The data file is a normal bench log, with scaled counts and even time stamps.

    Under feedback the target has its own column, which is read as the reference.
    """
    text = """version = 1
[system]
carts = 2
input = { unit = "V", sign = 1, per_count = 0.001 }
position = { unit = "cm", per_count = 0.01 }
[[experiments]]
id = "sine"
kind = "sine"
frequency = 2.0
file = "data/sine-µ.txt"
"""
    assert save_record(raw, folder=tmp_path, carts=2) == "data/sine-µ.txt"
    (tmp_path / "submission.toml").write_text(text, encoding="utf-8")
    (record,) = read_data(load_submission(tmp_path)).records
    assert record.y[1].tolist() == [0.01 * -2 * i for i in range(40)]
    assert record.u is not None
    assert record.u.tolist() == [0.001 * (i % 50) for i in range(40)]
    assert record.t[-1] == pytest.approx(39 * 1.0024e-3, abs=1e-3)
    heading, first, *_ = log_text(LINES, carts=1, reference=True).splitlines()
    assert heading.split("\t") == ["Sample", "Time", "Encoder 1 Pos", "Target", "Control Effort"]
    assert first.split("\t") == ["0", "0.000", "0", "0", "0"]


def test_a_raw_file_of_a_few_lines_makes_no_record(tmp_path):
    """Seven lines are too few for a record, and the message says so."""
    path = tmp_path / "short-1.raw"
    with RawWriter(path, HEADER) as writer:
        writer.write(b"".join(map(format_reading, LINES[:7])))
    with pytest.raises(DataError, match=r"short-1.raw: .*7 lines"):
        save_record(path, folder=tmp_path, carts=2)
