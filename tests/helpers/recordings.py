"""Write one recording as other programs save it: Excel, LabVIEW, National Instruments."""

import zipfile
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO

import numpy as np
import openpyxl
from nptdms import ChannelObject, TdmsWriter

from pipeline.ingest.table import Note

_SPREADSHEET = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_RELATED = "http://schemas.openxmlformats.org/package/2006/relationships"
_TYPES = (
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="xml" ContentType="application/xml"/>'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Override PartName="/xl/workbook.xml" ContentType="application/vnd.openxmlformats-'
    'officedocument.spreadsheetml.sheet.main+xml"/>'
    '<Override PartName="/xl/worksheets/one.xml" ContentType="application/vnd.openxmlformats-'
    'officedocument.spreadsheetml.worksheet+xml"/>'
    "{}</Types>"
)
_SHARED = (
    '<Override PartName="/xl/texts.xml" ContentType="application/vnd.openxmlformats-'
    'officedocument.spreadsheetml.sharedStrings+xml"/>'
)


def facts(notes: Iterable[str]) -> dict[str, Note]:
    """Return the notes that state a fact, by its code."""
    return {note.code: note for note in notes if isinstance(note, Note)}


def xlsx(columns: Mapping[str, np.ndarray]) -> bytes:
    """Return a workbook of one sheet with headings and one row per sample."""
    book = openpyxl.Workbook()
    assert book.active is not None
    book.active.append([*columns])
    for row in zip(*columns.values(), strict=True):
        book.active.append([float(value) for value in row])
    return saved(book)


def saved(book: openpyxl.Workbook) -> bytes:
    """Return the bytes of a workbook's file."""
    stream = BytesIO()
    book.save(stream)
    return stream.getvalue()


def package(
    sheet: str | bytes, *, texts: str | bytes | None = None, more: Mapping[str, bytes] = {}
) -> bytes:
    """Return a workbook with this part as its only sheet, valid or not.

    Parameters
    ----------
    texts : the part with the texts that cells share.
    more : further parts, or replacements for those made here.
    """
    related = f'<Relationships xmlns="{_RELATED}">{{}}</Relationships>'
    to = f'<Relationship Id="{{}}" Type="{_OFFICE}/{{}}" Target="{{}}"/>'
    parts = {
        "[Content_Types].xml": _TYPES.format(_SHARED if texts is not None else ""),
        "_rels/.rels": related.format(to.format("a", "officeDocument", "xl/workbook.xml")),
        "xl/workbook.xml": f'<workbook xmlns="{_SPREADSHEET}" xmlns:r="{_OFFICE}"><sheets>'
        '<sheet name="Run" sheetId="1" r:id="b"/></sheets></workbook>',
        "xl/_rels/workbook.xml.rels": related.format(
            to.format("b", "worksheet", "worksheets/one.xml")
            + to.format("c", "sharedStrings", "/xl/texts.xml")
        ),
        "xl/worksheets/one.xml": sheet,
        **({"xl/texts.xml": texts} if texts is not None else {}),
        **more,
    }
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return stream.getvalue()


def sheet_xml(rows: Sequence[Sequence[str | float]]) -> str:
    """Return the XML of a sheet, with texts in their cells and numbers unchanged."""
    cells = [
        "<row>"
        + "".join(
            f'<c t="str"><v>{cell}</v></c>' if isinstance(cell, str) else f"<c><v>{cell!r}</v></c>"
            for cell in row
        )
        + "</row>"
        for row in rows
    ]
    return f'<worksheet xmlns="{_SPREADSHEET}"><sheetData>{"".join(cells)}</sheetData></worksheet>'


def lvm(columns: Mapping[str, np.ndarray], *, separator: str = "\t", decimal: str = ".") -> bytes:
    """Return a file in LabVIEW's text format, version 2.

    Its first column is X, and each segment has a header.
    """
    about = {
        "Writer_Version": "2", "Reader_Version": "2",
        "Separator": {"\t": "Tab", ",": "Comma"}[separator], "Decimal_Separator": decimal,
        "Multi_Headings": "Yes", "X_Columns": "One", "Time_Pref": "Relative",
        "Date": "2026/01/05", "Time": f"11:32:52{decimal}5312500",
    }  # fmt: skip
    head = [f"{tag}{separator}{value}" for tag, value in about.items()]
    start = "\r\n".join(
        ["LabVIEW Measurement" + separator, *head, "***End_of_Header***" + separator]
    )
    body = lvm_segment(columns, separator=separator, decimal=decimal)
    return f"{start}\r\n{separator}\r\n{body}".encode()


def lvm_segment(
    columns: Mapping[str, np.ndarray],
    *,
    separator: str = "\t",
    decimal: str = ".",
    tags: Mapping[str, Sequence[str]] = {},
) -> str:
    """Return a segment with its header; `tags` are additional ones."""
    _, *channels = columns
    n = len(next(iter(columns.values())))
    header: dict[str, Sequence[str]] = {
        "Channels": [str(len(channels))],
        "Samples": [str(n)] * len(channels),
        "X_Dimension": ["Time"] * len(channels),
        "X0": ["0.0000000000000000E+0".replace(".", decimal)] * len(channels),
        **tags,
    }
    lines = [separator.join([tag, *values, ""]) for tag, values in header.items()]
    lines += [
        "***End_of_Header***" + separator * (len(channels) + 1),
        separator.join(["X_Value", *channels, "Comment"]),
    ]
    for row in zip(*columns.values(), strict=True):
        lines.append(separator.join(f"{value:.6f}".replace(".", decimal) for value in row))
    return "\r\n".join(lines) + "\r\n"


def tdms(*segments: Sequence[ChannelObject]) -> bytes:
    """Return a .tdms file of segments of channels."""
    stream = BytesIO()
    with TdmsWriter(stream) as writer:
        for segment in segments:
            writer.write_segment(segment)
    return stream.getvalue()


def tdms_of(columns: Mapping[str, np.ndarray]) -> bytes:
    """Return a .tdms file of one group and one segment."""
    return tdms([ChannelObject("run", name, values) for name, values in columns.items()])
