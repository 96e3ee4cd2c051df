"""Excel workbooks are read in the ways people make them; a broken one gives one clear line."""

import datetime as dt
import re
import zipfile
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO

import numpy as np
import openpyxl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.errors import SubmissionError
from pipeline.ingest.files import parse_table, parse_tables
from pipeline.ingest.table import FileTable
from tests.helpers.recordings import facts, package, saved, sheet_xml, xlsx

N = 40
TIME = np.round(0.01 * np.arange(N), 2)
X1 = np.round(3 * np.sin(20 * TIME), 4)
U = 0.5 * np.sign(np.sin(9 * TIME))
ROWS = [[float(v) for v in row] for row in zip(TIME, U, X1, strict=True)]
HEADINGS = ["time", "input", "x1"]


def table(raw: bytes) -> FileTable:
    """Read a workbook's bytes."""
    return parse_table(raw, source="f.xlsx")


def sheet(fill: Callable[..., object]) -> bytes:
    """Return a workbook whose first sheet is filled by a function."""
    book = openpyxl.Workbook()
    fill(book.active)
    return saved(book)


def document() -> bytes:
    """Return an Office document that is no workbook."""
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("word/document.xml", "<document/>")
    return stream.getvalue()


def plain(ws) -> None:
    """Fill a sheet as a program would export it."""
    for row in (HEADINGS, *ROWS):
        ws.append(row)


def changed(**cells: object) -> bytes:
    """Return the plain workbook with other contents of some cells."""

    def fill(ws) -> None:
        plain(ws)
        for at, value in cells.items():
            ws[at] = value

    return sheet(fill)


def titled(ws) -> None:
    """Fill a sheet as a person does: a title over columns, settings, units, empty rows, a note."""
    ws["A1"] = "Bench 4, run 3"
    ws.merge_cells("A1:C1")
    ws["A2"], ws["B2"] = "mass of the cart", 2.5
    for column, (name, unit) in enumerate(zip(HEADINGS, ["s", "(V)", "[cm]"], strict=True), 1):
        ws.cell(5, column, name)
        ws.cell(6, column, unit)
    for row, values in enumerate(ROWS, 8):
        for column, value in enumerate(values, 1):
            ws.cell(row, column, value)
    ws["H9"], ws["H10"] = "maximum", 0.5
    ws["A60"] = "measured on Monday"


def typed(ws) -> None:
    """Fill a sheet with numbers as text, some with decimal commas."""
    ws.append(HEADINGS)
    for t, u, x in ROWS:
        ws.append([f"{t:.2f}".replace(".", ","), u, f" {x} "])


def merged(ws) -> None:
    """Fill a sheet with a heading over two rows and one over two columns."""
    ws["A1"], ws["B1"], ws["B2"], ws["C2"] = "time", "signals", "input", "x1"
    ws.merge_cells("A1:A2")
    ws.merge_cells("B1:C1")
    for row in ROWS:
        ws.append(row)


def scattered(ws) -> None:
    """Fill a sheet with an empty row after each sample and with its columns apart."""
    for at, row in enumerate([HEADINGS, *ROWS]):
        for column, value in zip((2, 4, 7), row, strict=True):
            ws.cell(3 + 2 * at, column, value)


def remarked(ws) -> None:
    """Fill a sheet with remarks beside some samples."""
    ws.append([*HEADINGS, "remark"])
    for i, row in enumerate(ROWS):
        ws.append([*row, "knock" if i % 5 == 3 else None])


SHEETS = {
    "as exported": plain, "as typed": titled, "text": typed, "merged": merged,
    "scattered": scattered, "remarks": remarked,
}  # fmt: skip


@pytest.mark.parametrize("fill", SHEETS.values(), ids=SHEETS.keys())
def test_every_sheet_gives_the_same_numbers(fill):
    """Titles, units, empty rows, merged headings and remarks in a sheet change no number."""
    got = table(sheet(fill))
    assert [re.sub(r" \[.*", "", name) for name in got.names] == HEADINGS
    assert_array_equal(got.values, [TIME, U, X1])
    assert got.format.title == "Excel workbook"
    assert got.cut is None


def test_unread_rows_and_columns_are_reported():
    """A note names the text below a table that is not read; units join the headings."""
    got = table(sheet(titled))
    assert got.names == ("time [s]", "input [V]", "x1 [cm]")
    assert len(got.notes) == 1
    assert facts(got.notes)["text"].at == (60,)
    assert got.place(0) == "row 8"
    (said,) = table(sheet(typed)).notes
    assert "'0,00'" in said


def test_every_sheet_with_headings_is_a_run():
    """Each sheet with headings above numbers is a run, named by its sheet."""
    book = openpyxl.Workbook()
    assert book.active is not None
    book.active["A1"] = "plan of the afternoon"
    plain(book.create_sheet("Run 1"))
    plain(book.create_sheet("Run 2"))
    book.create_sheet("Empty")
    got = parse_tables(saved(book), source="f.xlsx")
    assert [one.run for one in got] == ["Run 1", "Run 2"]
    for one in got:
        assert_array_equal(one.values, [TIME, U, X1])


def test_a_bench_log_in_a_workbook_is_a_bench_log():
    """A bench log that Excel opened and saved still has its duty counts."""
    columns = {"Sample": np.arange(N), "Time": TIME, "Encoder 1 Pos": X1, "Control Effort": U}
    assert table(xlsx(columns)).format.inputs == "count"


def test_dates_and_times_of_day_become_seconds():
    """Dates become seconds since the first one, and times of day seconds since midnight."""
    begin = dt.datetime.fromisoformat("2026-01-05 12:00")

    def dates(ws) -> None:
        ws.append(["Time (ms)", "x1"])
        for t, _, x in ROWS:
            ws.append([begin + dt.timedelta(seconds=t), x])

    def times(ws) -> None:
        ws.append(["Time", "x1"])
        for t, _, x in ROWS:
            ws.append([(begin + dt.timedelta(seconds=t)).time(), x])

    def durations(ws) -> None:
        ws.append(["Time (s)", "x1"])
        for t, _, x in ROWS:
            ws.append([dt.timedelta(days=1, seconds=t), x])

    got = table(sheet(dates))
    assert got.names[0] == "Time [s]"
    assert_array_equal(got.values[0], TIME)
    assert_array_equal(table(sheet(times)).values[0], 43_200 + TIME)
    # a day has 11 digits of a double above the microsecond
    assert_allclose(table(sheet(durations)).values[0], 86_400 + TIME, rtol=0, atol=1e-6)


def test_percent_is_read_and_reported():
    """A cell with 50 % is read as 0.5, and a note says so."""

    def fill(ws) -> None:
        plain(ws)
        for row in range(2, N + 2):
            ws.cell(row, 2).number_format = "0.0%"

    got = table(sheet(fill))
    assert_array_equal(got.values[1], U)
    assert len(got.notes) == 1
    assert "column B" in got.notes[0]


BAD = {
    "empty": (changed(C7=None), 7, "x1"),
    "text": (changed(C7="stuck"), 7, "x1"),
    "thousands": (changed(C7="1,234,5"), 7, "x1"),
    "nan": (changed(C7="nan"), 7, "x1"),
    "fault": (changed(C7="#DIV/0!"), 7, "x1"),
    "truth": (changed(C7=True), 7, "x1"),
    "formula": (changed(C7="=A2+1"), 7, "formula"),
    "formulas": (changed(**{f"C{i}": "=A2" for i in range(2, N + 2)}), 2, "formula"),
    "date": (changed(C7=dt.datetime.fromisoformat("2026-05-01")), 7, "x1"),
    "huge": (changed(C7=1e60), 7, "x1"),
    "mean": (changed(A42="mean", B42=0.5), 42, "time"),
    "marker": (changed(A30="here", B30=None, C30=None), 30, "time"),
    "twice": (changed(C1="input"), 1, "input"),
    "wide": (xlsx({f"c{i}": TIME for i in range(65)}), 1, "64"),
}


@pytest.mark.parametrize(("raw", "row", "what"), BAD.values(), ids=BAD.keys())
def test_a_cell_that_is_not_a_number_is_named(raw, row, what):
    """A cell that is not a number gives one line of error with sheet, row and column."""
    with pytest.raises(SubmissionError, match=rf"'Sheet' row {row}:.*{what}") as caught:
        table(raw)
    assert "\n" not in str(caught.value)


BOOK = sheet_xml([HEADINGS, *ROWS])
NAMESPACE = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
OPEN = f'<worksheet xmlns="{NAMESPACE}"><sheetData>'
CLOSE = "</sheetData></worksheet>"
FAR = '<row><c t="str"><v>x1</v></c></row><row r="2"><c r="A2"><v>1</v></c></row>'
ENTITIES = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 12))

HOSTILE = {
    "two cells far apart": (
        OPEN + FAR + '<row r="1048576"><c r="XFD1048576"><v>2</v></c></row>' + CLOSE
    ),
    "entities": (
        f'<!DOCTYPE w [<!ENTITY a0 "aaaaaaaaaa">{ENTITIES}]>'
        + OPEN + '<row><c t="str"><v>&a11;</v></c></row>' + CLOSE
    ),
    "a file elsewhere": (
        '<!DOCTYPE w [<!ENTITY a SYSTEM "file:///etc/passwd">]>'
        + OPEN + '<row><c t="str"><v>&a;</v></c></row>' + CLOSE
    ),
}  # fmt: skip


def test_the_stated_size_of_a_sheet_need_not_be_true():
    """A sheet that states a size of sixteen billion cells is read like any other."""
    raw = package(BOOK.replace("<sheetData>", '<dimension ref="A1:XFD1048576"/><sheetData>'))
    assert_array_equal(table(raw).values, [TIME, U, X1])


REFUSED = {
    "a document": (document(), "Office"),
    "cut": (xlsx({"time": TIME, "x1": X1})[:3000], "broken"),
    "no headings": (sheet(lambda ws: [ws.append(r) for r in ROWS]), "'Sheet'"),
    "nothing": (sheet(lambda ws: None), "'Sheet'"),
    "two tables": (sheet(lambda ws: [plain(ws), plain(ws)]), "several"),
    **{name: (package(xml), r"f\.xlsx") for name, xml in HOSTILE.items()},
}


@pytest.mark.parametrize(("raw", "what"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_no_sheet_with_one_table_is_refused(raw, what):
    """Another document, a part of a workbook, and no table or two tables are refused.

    So is a sheet that spans everything, grows by its entities or names another file.
    """
    with pytest.raises(SubmissionError, match=what):
        table(raw)


cells = st.one_of(
    st.floats(-1e6, 1e6), st.sampled_from(["time", "x1", "input", "s", "", "0,5", "#N/A", "x1"])
)


@given(st.lists(st.lists(cells, max_size=5), max_size=12))
def test_any_sheet_is_a_table_or_one_line(rows):
    """In a sheet of texts and numbers in any order, the numbers that are read are right."""
    got = None
    with suppress(SubmissionError):
        got = table(package(sheet_xml(rows)))
    if got is None:
        return
    written = {value for row in rows for value in row if isinstance(value, float)} | {0.5}
    assert set(got.values.ravel().tolist()) <= written
