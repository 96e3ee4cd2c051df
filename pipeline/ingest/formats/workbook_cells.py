"""Read the cells of an Excel workbook (.xlsx), using only the standard library.

A workbook of 2 kB may name two cells a million rows apart, or declare a billion texts. A reader
that reserves memory for all of this crashes. Here no declaration is trusted: parts are decompressed
and parsed piece by piece, and the results are counted. Layout: ECMA-376-1, chapter 18.
"""

import posixpath
import re
import struct
import zipfile
import zlib
from array import array
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from xml.parsers import expat

from pipeline.errors import SubmissionError

_MOST_BYTES = 200_000_000  # largest total size of all parts, decompressed
_MOST_ELEMENTS = 6_000_000  # two per cell
_MOST_CELLS, _MOST_TEXTS = 2_000_000, 500_000
_MOST_DIRECTORY = 1_000_000  # bytes of the archive's table of contents
_MOST_SHEETS = 250
_MOST_ROWS, _MOST_COLUMNS = 1_048_576, 16_384  # limits of any sheet
_CHUNK = 1 << 18
_LONGEST_TOKEN = 1_000_000  # bytes; the parser expat reads a tag again until it is complete
_DEEPEST = 60  # levels of nested elements
_LONGEST_TEXT = 200  # characters kept of a cell
_REFERENCE = re.compile(r"([A-Z]{1,3})([1-9]\d{0,6})")
_NO_VALUE = "a formula without its value: open the file in a spreadsheet program and save it again"

# Number formats (18.8.30): the predefined ones, then patterns for those with a code.
_PERCENTS = {9, 10}
_DATES = {14, 15, 16, 17, 22, *range(27, 37), *range(50, 59)}
_TIMES = {18, 19, 20, 21, 45, 46, 47}
_LONGEST_CODE = 255  # characters; Excel allows no longer number format
_NO_CODE = re.compile(r'"[^"]*"|\\.|_.|\*.|\[(?![hms]{1,9}\])[^\[\]]*\]', re.IGNORECASE | re.DOTALL)


class _Broken(Exception):
    """Content that no spreadsheet program writes."""


@dataclass(kw_only=True)
class Cells:
    """The filled cells of a sheet, in the order of the file.

    Attributes
    ----------
    rows, columns : row and column (from 1) of each number in `values`.
    formats : number format of each number; see `Book.formats`.
    texts : texts, by (row, column).
    wrong : contents that cannot be a measurement, by (row, column).
    merged : for each cell of a merged range, the first cell of the range.
    """

    rows: array = field(default_factory=lambda: array("l"))
    columns: array = field(default_factory=lambda: array("l"))
    values: array = field(default_factory=lambda: array("d"))
    formats: array = field(default_factory=lambda: array("l"))
    texts: dict[tuple[int, int], str] = field(default_factory=dict)
    wrong: dict[tuple[int, int], str] = field(default_factory=dict)
    merged: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)


class Book:
    """An open workbook.

    Attributes
    ----------
    sheets : the file part of each worksheet, by name, in order.
    formats : what each number format shows: "percent", "time", "date" or "".

    Raises
    ------
    SubmissionError : this is not a workbook, or it is broken, locked or too large.
    """

    def __init__(self, raw: bytes, *, source: str) -> None:
        self._source = source
        self._bytes, self._elements = _MOST_BYTES, _MOST_ELEMENTS
        self._texts: list[str] | None = None
        with _reported(source):
            self._archive = zipfile.ZipFile(_Bounded(raw))
            self._members = {info.filename: info for info in self._archive.infolist()}
            if len(self._members) < len(self._archive.infolist()):
                raise _Broken("two parts with the same name")
            self._open()

    def _open(self) -> None:
        office = [target for kind, target in self._related("").values() if kind == "officeDocument"]
        main = office[0] if office else "xl/workbook.xml"
        if not main.startswith("xl/") or main not in self._members:
            raise SubmissionError(
                f"{self._source}: not an Excel workbook; save its table as .xlsx or CSV"
            )
        related = self._related(main)
        named: list[tuple[str, str]] = []

        def sheet(name: str, attributes: dict[str, str]) -> None:
            if name == "sheet":
                bare = {key.rpartition(":")[2]: value for key, value in attributes.items()}
                named.append((bare.get("name", "")[:_LONGEST_TEXT], bare.get("id", "")))

        self._parse(main, start=sheet)
        if len(named) > _MOST_SHEETS:
            raise _Broken("more sheets than any workbook has")
        parts = [(name, *related.get(target, ("", ""))) for name, target in named]
        self.sheets = {name: part for name, kind, part in parts if kind == "worksheet"}
        one_of = {kind: part for kind, part in related.values()}
        self._shared = one_of.get("sharedStrings", "")
        self.formats = self._read_formats(one_of["styles"]) if "styles" in one_of else [""]

    def _related(self, part: str) -> dict[str, tuple[str, str]]:
        """Return the references of a part: kind and target of each, by id."""
        folder, name = posixpath.split(part)
        listed = posixpath.join(folder, "_rels", f"{name}.rels")
        found: dict[str, tuple[str, str]] = {}

        def relation(name: str, attributes: dict[str, str]) -> None:
            if name != "Relationship" or attributes.get("TargetMode") == "External":
                return
            kind = attributes.get("Type", "").rpartition("/")[2]
            target = posixpath.normpath(posixpath.join("/", folder, attributes.get("Target", "")))
            found[attributes.get("Id", "")] = kind, target.lstrip("/")

        if listed in self._members:
            self._parse(listed, start=relation)
        return found

    def _read_formats(self, part: str) -> list[str]:
        codes: dict[int, str] = {}
        formats: list[str] = []
        within: list[str] = []

        def start(name: str, attributes: dict[str, str]) -> None:
            within.append(name)
            if name == "numFmt":
                codes[int(attributes["numFmtId"])] = attributes.get("formatCode", "")
            elif name == "xf" and "cellXfs" in within:
                number = int(attributes.get("numFmtId", 0))
                formats.append(_classify_format(number, codes.get(number, "")))

        self._parse(part, start=start, end=lambda _: within.pop())
        return formats or [""]

    def _shared_texts(self) -> list[str]:
        """Return the texts that cells refer to by number; they are read on first use."""
        if self._texts is None:
            reading = _Texts()
            if self._shared:
                self._parse(
                    self._shared,
                    start=reading.start,
                    end=reading.end,
                    characters=reading.characters,
                )
            self._texts = reading.texts
        return self._texts

    def has_cells(self, sheet: str) -> bool:
        """Return whether a sheet has a filled cell."""
        reading = _Sheet(list, most=0)
        try:
            self._read_sheet(sheet, reading)
        except _Full:
            return True
        return False

    def cells(self, sheet: str) -> Cells:
        """Return the cells of a sheet.

        Raises
        ------
        SubmissionError : the sheet is broken, or has more cells than any recording.
        """
        reading = _Sheet(self._shared_texts, most=_MOST_CELLS)
        try:
            self._read_sheet(sheet, reading)
        except _Full:
            raise SubmissionError(
                f"{self._source} sheet {sheet!r}: more than {_MOST_CELLS:,} cells, or "
                f"{_MOST_TEXTS:,} texts; keep one recording, in numbers"
            ) from None
        return reading.cells

    def _read_sheet(self, sheet: str, reading: "_Sheet") -> None:
        with _reported(self._source):
            self._parse(
                self.sheets[sheet],
                start=reading.start,
                end=reading.end,
                characters=reading.characters,
            )

    def _parse(
        self,
        part: str,
        *,
        start: Callable[[str, dict[str, str]], object],
        end: Callable[[str], object] = lambda _: None,
        characters: Callable[[str], object] | None = None,
    ) -> None:
        """Parse a part; the handlers get names without namespace prefixes."""
        if part not in self._members:
            raise _Broken(f"the part {part} is missing")
        depth = 0

        def opened(name: str, attributes: dict[str, str]) -> None:
            nonlocal depth
            depth += 1
            self._elements -= 1
            if depth > _DEEPEST or self._elements < 0:
                raise _Broken("too many elements")
            start(name.rpartition(":")[2], attributes)

        def closed(name: str) -> None:
            nonlocal depth
            depth -= 1
            end(name.rpartition(":")[2])

        def refuse(*_: object) -> None:
            raise _Broken("a document type, which could hold entities")

        parser = expat.ParserCreate()
        parser.buffer_text = True
        parser.StartDoctypeDeclHandler = refuse
        parser.StartElementHandler, parser.EndElementHandler = opened, closed
        parser.CharacterDataHandler = characters
        fed = 0
        for chunk in self._inflated(part):
            parser.Parse(chunk)
            fed += len(chunk)
            if fed - parser.CurrentByteIndex > _LONGEST_TOKEN:
                raise _Broken("a tag without end")
        parser.Parse(b"", True)

    def _inflated(self, part: str) -> Iterator[bytes]:
        info = self._members[part]
        if info.flag_bits & 1:
            raise SubmissionError(f"{self._source}: locked by a password; save it without one")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise _Broken("packed in a way that no spreadsheet program uses")
        with self._archive.open(info) as file:
            while chunk := file.read(_CHUNK):
                self._bytes -= len(chunk)
                if self._bytes < 0:
                    raise _Broken("too large")
                yield chunk


@contextmanager
def _reported(source: str) -> Iterator[None]:
    """Turn every error that a broken workbook causes into a `SubmissionError` of one line."""
    try:
        yield
    except (_Broken, zipfile.BadZipFile, zlib.error, struct.error, expat.ExpatError, EOFError,
            LookupError, OSError, OverflowError, RuntimeError, ValueError):  # fmt: skip
        message = f"{source}: the workbook is broken, cut short or larger than any recording"
        raise SubmissionError(message) from None


class _Bounded(BytesIO):
    """Bytes of which `zipfile` may read only a limited number at once, to bound the directory."""

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > max(_MOST_DIRECTORY, _CHUNK):
            raise _Broken("too many parts")
        return super().read(size)


class _Full(Exception):
    """There are more cells than the caller wants."""


class _Texts:
    """The list of texts, joined from their pieces; Japanese pronunciation hints are ignored."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self._pieces: list[str] = []
        self._in_text = self._in_sound = False

    def start(self, name: str, _: dict[str, str]) -> None:
        if name == "si":
            self._pieces = []
        elif name == "rPh":
            self._in_sound = True
        self._in_text = name == "t" and not self._in_sound

    def characters(self, text: str) -> None:
        if self._in_text and len(self._pieces) < _LONGEST_TEXT:
            self._pieces.append(text[:_LONGEST_TEXT])

    def end(self, name: str) -> None:
        self._in_text = False
        if name == "rPh":
            self._in_sound = False
        elif name == "si":
            self.texts.append("".join(self._pieces)[:_LONGEST_TEXT])
            if len(self.texts) > _MOST_TEXTS:
                raise _Broken("too many texts")


class _Sheet:
    """The cells of a sheet, built while its elements are read."""

    def __init__(self, shared: Callable[[], list[str]], *, most: int) -> None:
        self.cells = Cells()
        self._shared, self._left = shared, most
        self._row = self._column = 0
        self._kind, self._format, self._formula = "n", 0, False
        self._pieces: list[str] | None = None  # None while no value is being read
        self._value: str | None = None
        self._in_sound = False
        self._numbers: dict[str, int] = {}

    def start(self, name: str, attributes: dict[str, str]) -> None:
        if name == "c":
            self._place(attributes.get("r"))
            self._kind = attributes.get("t", "n")
            self._format = int(attributes.get("s", 0))
            self._formula, self._value, self._in_sound = False, None, False
        elif name == "v" or (name == "t" and not self._in_sound):
            self._pieces = []
        elif name == "f":
            self._formula = True
        elif name == "row":
            self._row = int(attributes.get("r", self._row + 1))
            self._column = 0
        elif name == "rPh":
            self._in_sound = True
        elif name == "mergeCell":
            self._merge(attributes.get("ref", ""))

    def characters(self, text: str) -> None:
        if self._pieces is not None and len(self._pieces) < _LONGEST_TEXT:
            self._pieces.append(text[:_LONGEST_TEXT])

    def end(self, name: str) -> None:
        if name == "c":
            self._keep()
        elif self._pieces is not None and name in ("v", "t"):
            self._value = ((self._value or "") + "".join(self._pieces))[:_LONGEST_TEXT]
            self._pieces = None
        elif name == "rPh":
            self._in_sound = False

    def _place(self, reference: str | None) -> None:
        if reference is None:
            self._column += 1
        else:
            self._row, self._column = self._read(reference)
        if not (0 < self._row <= _MOST_ROWS and 0 < self._column <= _MOST_COLUMNS):
            raise _Broken("a cell outside the sheet")

    def _read(self, reference: str) -> tuple[int, int]:
        """Return (row, column) of a reference such as "B12"."""
        match = _REFERENCE.fullmatch(reference)
        if match is None:
            raise _Broken("a cell without a valid reference")
        letters = match[1]
        column = self._numbers.get(letters)
        if column is None:
            column = 0
            for letter in letters:
                column = 26 * column + ord(letter) - 64
            self._numbers[letters] = column
        return int(match[2]), column

    def _keep(self) -> None:
        value, at = self._value, (self._row, self._column)
        if not value and not self._formula:
            return
        self._left -= 1
        if self._left < 0 or len(self.cells.texts) + len(self.cells.wrong) > _MOST_TEXTS:
            raise _Full
        if value is None or (not value and self._kind == "n"):
            self.cells.wrong[at] = _NO_VALUE
        elif self._kind == "n":
            self.cells.rows.append(at[0])
            self.cells.columns.append(at[1])
            self.cells.values.append(float(value))
            self.cells.formats.append(self._format)
        elif self._kind == "s":
            if text := self._shared()[int(value)].strip():
                self.cells.texts[at] = text
        elif self._kind in ("str", "inlineStr"):
            if text := value.strip():
                self.cells.texts[at] = text
        else:  # "e" is an error, "b" a truth value, "d" a date as text
            words = {"b": {"0": "FALSE", "1": "TRUE"}.get(value, value)}.get(self._kind, value)
            self.cells.wrong[at] = f"not a number: {words[:30]!r}"

    def _merge(self, reference: str) -> None:
        first, _, last = reference.partition(":")
        (top, left), (bottom, right) = self._read(first), self._read(last or first)
        if bottom - top < 10 and right - left < 10:  # only small ranges, as in a heading
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    self.cells.merged[row, column] = top, left
        if len(self.cells.merged) > _MOST_TEXTS:
            raise _Broken("too many merged cells")


def _classify_format(number: int, code: str) -> str:
    """Return what a number format stands for: "percent", "time", "date" or ""."""
    bare = _NO_CODE.sub("", code[:_LONGEST_CODE]).casefold()
    if number in _PERCENTS or "%" in bare:
        return "percent"
    if bare == "general" or (code and not re.search(r"[ymdhs]", bare)):
        return ""
    if number in _DATES or re.search(r"[yd]", bare):
        return "date"
    if number in _TIMES or re.search(r"[hs]", bare):
        return "time"
    return "date" if "m" in bare else ""
