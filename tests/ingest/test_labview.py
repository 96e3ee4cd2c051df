"""LabVIEW's text and National Instruments' binary files give the same numbers as any other form."""

import struct
import subprocess
import sys
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nptdms import ChannelObject
from numpy.testing import assert_allclose

from pipeline.errors import SubmissionError
from pipeline.ingest.files import parse_table
from pipeline.ingest.table import FileTable
from tests.helpers.places import ROOT
from tests.helpers.recordings import lvm, lvm_segment, tdms, tdms_of

N = 40
TIME = np.round(0.01 * np.arange(N), 2)
X1 = np.round(3 * np.sin(20 * TIME), 4)
U = 0.5 * np.sign(np.sin(9 * TIME))
COLUMNS = {"time": TIME, "input": U, "x1": X1}


def table(raw: bytes | str) -> FileTable:
    """Read a file's bytes."""
    return parse_table(raw.encode() if isinstance(raw, str) else raw, source="f")


# --------------------------------------------------------------------------------- .lvm

GOOD = lvm(COLUMNS).decode()
HEAD = GOOD[: GOOD.index("Channels")]
LATER = {"time": TIME + 0.4, "input": U, "x1": X1}
SPECIAL = "***Start_Special***\r\nWaveform\t1,2\r\n***End_Special***\r\n\r\n"


def multi(clock: np.ndarray) -> str:
    """Return a file in which each channel has an X column; the second channel's is `clock`."""
    rows = ["\t".join(f"{v:.6f}" for v in row) for row in zip(TIME, U, clock, X1, strict=True)]
    text = GOOD[: GOOD.index("X_Value")] + "X_Value\tinput\tX_Value\tx1\tComment\r\n"
    return text.replace("X_Columns\tOne", "X_Columns\tMulti") + "\r\n".join(rows) + "\r\n"


def no_times(**tags: list[str]) -> str:
    """Return a file whose X column is empty; the header may state the interval."""
    text = HEAD.replace("X_Columns\tOne", "X_Columns\tNo") + lvm_segment(COLUMNS, tags=tags)
    head, names, rows = text.partition("X_Value\tinput\tx1\tComment\r\n")
    return head + names + "\r\n".join("\t" + row.partition("\t")[2] for row in rows.splitlines())


LVM = {
    "tabs": GOOD,
    "commas": lvm(COLUMNS, separator=",").decode(),
    "decimal commas": lvm(COLUMNS, decimal=",").decode(),
    "version 1": GOOD.replace("Decimal_Separator\t.\r\n", ""),
    "line ends": GOOD.replace("\r\n", "\n"),
    "special block": HEAD + SPECIAL + GOOD[len(HEAD) :],
    "X for each channel": multi(TIME),
    "X stated": no_times(Delta_X=["1.0E-2", "1.0E-2"]),
    "byte-order mark": "\ufeff" + GOOD,
}


@pytest.mark.parametrize("content", LVM.values(), ids=LVM.keys())
def test_every_dialect_of_lvm_gives_the_same_numbers(content):
    """Any separator, decimal mark and way to write X in an .lvm file gives the same numbers."""
    got = table(content)
    assert got.format.title.endswith("(.lvm)")
    assert got.names == ("time", "input", "x1")
    assert_allclose(got.values, [TIME, U, X1], rtol=0, atol=1e-12)
    assert got.cut is None


def test_the_first_time_of_the_header_is_used():
    """Without an X column, the times begin at the X0 of the header."""
    got = table(no_times(Delta_X=["1.0E-2", "1.0E-2"], X0=["5.0E-1", "5.0E-1"]))
    assert_allclose(got.values[0], 0.5 + TIME, rtol=0, atol=1e-12)


def test_units_of_the_header_are_joined_to_the_headings():
    """Units in the header, which LabVIEW writes in words, are added to the headings."""
    segment = lvm_segment(COLUMNS, tags={"Y_Unit_Label": ["Volts", "Millimeters"]})
    assert table(HEAD + segment).names == ("time", "input [V]", "x1 [mm]")


def test_segments_that_continue_each_other_are_one_recording():
    """Segments that follow each other in time become one recording."""
    last = {**LATER, "time": TIME + 0.8}
    for text in (
        "\r\n".join([GOOD, lvm_segment(LATER), lvm_segment(last)]),
        "\r\n".join(
            [GOOD, *(lvm_segment(one).partition("Comment\r\n")[2] for one in (LATER, last))]
        ),
    ):
        got = table(text)
        stamps = np.r_[TIME, LATER["time"], last["time"]]
        assert_allclose(got.values[0], stamps, rtol=0, atol=1e-12)
        assert got.lines is not None
        assert got.lines[-1] == len(text.splitlines())


def test_comments_beside_rows_are_not_read():
    """Comments beside the rows, in the last column, are not read, and a note says so."""
    got = table(GOOD.replace("\r\n0.010000", "\tknock\r\n0.010000"))
    assert len(got.notes) == 1
    assert got.values.shape == (3, N)


BAD_LVM = {
    "twice": (GOOD + "\r\n" + lvm_segment(COLUMNS), "'1', '2'"),
    "other channels": (GOOD + "\r\n" + lvm_segment({"time": TIME + 1, "x1": X1}), "'1', '2'"),
    "two clocks": (multi(TIME + 0.001), "line 18: .*X_Columns"),
    "two intervals": (no_times(Delta_X=["0.1", "0.2"]), "line 19: .*Delta_X"),
    "no interval": (no_times(Delta_X=["a", "b"]), "line 19: .*Delta_X"),
    "no number": (GOOD.replace("0.030000", "0.03x"), "line 22: 'time'.*'0.03x'"),
    "a gap": (GOOD.replace("\r\n0.030000\t", "\r\n0.030000\t\t"), "line 22: 'input'"),
    "text between": (GOOD.replace("\r\n0.03", "\r\nhere\r\n0.03"), "line 22:"),
    "no end of header": (GOOD.replace("***End_of_Header***", ""), "line 1:"),
    "no end of special": (HEAD + "***Start_Special***\r\n" + GOOD[len(HEAD) :], "line 13:"),
    "no rows": (GOOD[: GOOD.index("0.000000\t")], "no rows"),
    "no names": (GOOD[: GOOD.index("X_Value")].rstrip("\r\n"), "ends after"),
    "unknown X": (GOOD.replace("X_Columns\tOne", "X_Columns\tTwo"), "'two'"),
    "infinite": (GOOD.replace("0.030000", "inf"), "line 22: 'time'"),
    "name twice": (GOOD.replace("\tinput\t", "\tx1\t"), "'x1' appears"),
    "wide": (lvm({f"c{i}": TIME for i in range(70)}), "64"),
}


@pytest.mark.parametrize(("content", "said"), BAD_LVM.values(), ids=BAD_LVM.keys())
def test_a_broken_lvm_names_its_line(content, said):
    """A broken .lvm file gives one line of error, usually with the line's number, and no table."""
    with pytest.raises(SubmissionError, match=said) as caught:
        table(content)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("end", "n"), [(GOOD.index("0.300000"), 30), (len(GOOD) - 12, N - 1)])
def test_an_lvm_cut_between_two_rows_is_recognised(end, n):
    """A cut .lvm file is recognised from the number of samples in its header."""
    assert f"{n} of {N}" in (table(GOOD[:end]).cut or "")


@given(st.integers(0, len(GOOD) - 1))
def test_any_piece_of_an_lvm_is_cut_or_refused(end):
    """An .lvm file cut anywhere is refused, reported as cut, or still has all its samples."""
    with suppress(SubmissionError):
        got = table(GOOD[:end])
        assert got.cut or got.values.shape[1] == N
        assert got.cut is None or f"of {N}" in got.cut


# --------------------------------------------------------------------------------- .tdms


def channel(name: str, values: np.ndarray, group: str = "run", **properties: Any) -> ChannelObject:
    """Return a channel to be written."""
    return ChannelObject(group, name, values, properties=properties)


CLOCK: dict[str, Any] = {"wf_increment": 0.01, "wf_start_offset": 0.0}
START = np.datetime64("2026-01-05T12:00:00", "ns")
TDMS = {
    "one segment": tdms_of(COLUMNS),
    "two segments": tdms(*[
        [channel(name, values[part]) for name, values in COLUMNS.items()]
        for part in (slice(0, 15), slice(15, None))
    ]),
    "interval": tdms([channel("input", U, **CLOCK), channel("x1", X1, wf_increment=0.01)]),
    "stamps": tdms([
        channel("time", START + np.round(1e9 * TIME).astype("m8[ns]")),
        channel("input", U), channel("x1", X1),
    ]),
    "settings": tdms([
        *(channel(name, values) for name, values in COLUMNS.items()),
        channel("gains", np.array([1.0, 2.0])), channel("by", np.array(["me"])),
        channel("gain", np.array([1.0, 3.0]), group="settings"),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("raw", TDMS.values(), ids=TDMS.keys())
def test_every_tdms_gives_the_same_numbers(raw):
    """Segments, waveforms and time stamps of a .tdms file change none of the numbers read."""
    got = table(raw)
    assert got.format.title.endswith(".tdms")
    assert [name.removesuffix(" [s]") for name in got.names] == ["time", "input", "x1"]
    assert_allclose(got.values, [TIME, U, X1], rtol=0, atol=1e-9)


def test_other_content_of_a_tdms_is_named():
    """A note names short channels and text channels that are not read; units join the headings."""
    got = table(TDMS["settings"])
    unread = [one.name for one in got.variables if not one.read]
    assert unread == ["run/gains", "run/by", "settings/gain"]
    assert all(name in got.notes[0] for name in unread)
    unit: dict[str, Any] = {"unit_string": "Volts"}
    assert table(tdms([channel("t", TIME), channel("u", U, **unit)])).names == ("t", "u [V]")


GOOD_TDMS = tdms_of(COLUMNS)
COUNT = struct.pack("<Q", N)


BAD_TDMS = {
    "cut": (GOOD_TDMS[:-1], r"the segment at byte 0 is not whole: the file was cut short"),
    "never closed": (
        GOOD_TDMS[:12] + b"\xff" * 8 + GOOD_TDMS[20:], r"copied while LabVIEW was writing it",
    ),
    "absurd count": (GOOD_TDMS.replace(COUNT, struct.pack("<Q", 2**60)), r"damaged|broken"),
    "fewer values than bytes": (GOOD_TDMS.replace(COUNT, struct.pack("<Q", 33)), r"damaged"),
    "lengths": (tdms([channel("t", TIME), channel("x1", X1[:30])]), r"differ in length: t \(40\)"),
    "two groups": (
        tdms([channel("t", TIME), channel("t", TIME, group="b")]),
        r"several recordings \('b', 'run'\)",
    ),
    "two rates": (
        tdms([channel("u", U, wf_increment=0.1), channel("x1", X1, wf_increment=0.2)]),
        r"wf_increment 0.1 s, 0.2 s",
    ),
    "no numbers": (tdms([channel("by", np.array(["me"] * 9))]), r"no channel of numbers, but run/"),
    "nan": (tdms([channel("t", TIME), channel("x1", X1 * np.nan)]), r"sample 1: 'x1' is not a fin"),
}  # fmt: skip


@pytest.mark.parametrize(("raw", "said"), BAD_TDMS.values(), ids=BAD_TDMS.keys())
def test_a_broken_tdms_is_one_line(raw, said, capfd):
    """A damaged .tdms file, which npTDMS would read in part, is refused with one line."""
    with pytest.raises(SubmissionError, match=said) as caught:
        table(raw)
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_other_forms_do_not_load_the_readers():
    """Reading text files does not load the libraries for other formats."""
    code = (
        "import sys; from pipeline.ingest.files import parse_table; "
        "parse_table(b'time,x1\\n0,1\\n1,2\\n', source='a'); "
        "print(*[m for m in ('nptdms', 'h5py', 'openpyxl') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == []
