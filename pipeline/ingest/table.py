"""A data file as written: named columns of numbers, without meaning or unit."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.words.numbers import first_few

MOST_COLUMNS = 64
_LONGEST_HEADING = 100  # characters
MOST_NAMED = 8
FEW_NAMED = 4  # places named in a note
SETTING = 0.1  # share of the longest signal; a shorter one holds settings, such as gains
# Range of values that a bench can measure, in any unit: times, positions, inputs, ratios. Powers
# and products of several such values, as in the stages, neither overflow nor underflow.
_SMALLEST_MEASURED, _LARGEST_MEASURED = 1e-12, 1e12


# Where the unit of a column stands: in its heading or the submission; it is a count; or unknown.
UnitFrom = Literal["heading", "count", "unknown"]


class Note(str):
    """A sentence about a file, with the facts that it states.

    Attributes
    ----------
    code : what it says, such as "gap".
    about : the column concerned; "" for the whole file.
    at : the samples concerned, from 0, or for a text their lines in the file.
    """

    code: str
    about: str
    at: tuple[int, ...]

    def __new__(
        cls, text: str, code: str = "", *, about: str = "", at: Iterable[int] = ()
    ) -> "Note":
        """Make a note; see the class."""
        note = super().__new__(cls, text)
        note.code, note.about, note.at = code, about, tuple(map(int, at))
        return note


@dataclass(frozen=True, kw_only=True)
class Format:
    """What the format of a file says about its numbers.

    Attributes
    ----------
    title : name of the format.
    positions, inputs : where the units of positions and of inputs stand. If a unit is unknown,
        whole numbers may be counts.
    """

    title: str
    positions: UnitFrom = "heading"
    inputs: UnitFrom = "heading"


BENCH_LOG = Format(title="bench log", positions="unknown", inputs="count")


@dataclass(frozen=True, kw_only=True)
class Variable:
    """A variable of a binary file, and whether it is read.

    Attributes
    ----------
    size : numbers of rows and columns; empty if they could not be read.
    kind : type of the numbers, or a description of other content.
    read : whether the numbers are among the columns of the table.
    advice : how to make the variable readable; empty if it cannot hold a recording.
    """

    name: str
    size: tuple[int, ...]
    kind: str
    read: bool
    advice: str = ""

    def __str__(self) -> str:
        """Return a short text such as "data (20000 × 7, float64)"."""
        size = " × ".join(map(str, self.size))
        return f"{self.name} ({', '.join(filter(None, (size, self.kind)))})"


@dataclass(frozen=True, kw_only=True, eq=False)
class Signal:
    """A named array of a binary file: one signal, or one in each column.

    Attributes
    ----------
    size : numbers of rows and columns.
    kind : type of the numbers, or a description of other content.
    values : the numbers (rows, columns); None for other content.
    bytes : memory of content other than numbers.
    group, unit : as stated; "" if not stated.
    interval, start : sample interval and first time in s, as stated; 0 if not stated.
    elements : those of a struct, each with its fields by name.
    text : the content of a text.
    """

    name: str
    kind: str
    size: tuple[int, ...] = ()
    values: np.ndarray | None = None
    bytes: int = 0
    group: str = ""
    unit: str = ""
    interval: float = 0.0
    start: float = 0.0
    elements: "tuple[dict[str, Signal], ...]" = ()
    text: str = ""

    @property
    def numbers(self) -> np.ndarray:
        """The numbers; there must be some."""
        assert self.values is not None
        return self.values

    @property
    def samples(self) -> int:
        """The number of samples, along rows or columns."""
        return max(self.size, default=0)

    @property
    def is_vector(self) -> bool:
        """Whether it is a single signal."""
        return self.samples > 1 and min(self.size) == 1

    def entry(self, *, read: bool, advice: str = "") -> Variable:
        """Return the entry in an inspection."""
        return Variable(name=self.name, size=self.size, kind=self.kind, read=read, advice=advice)


@dataclass(frozen=True, kw_only=True, eq=False)
class FileTable:
    """The columns of one file.

    Attributes
    ----------
    source : the file's name, for messages.
    format : the format of the file.
    names : (n_columns,) headings as written. Without headings, the numbers "1", "2", ….
    values : (n_columns, n), all finite.
    whole : (n_columns,) whether all numbers of a column were written as whole numbers.
    lines : (n,) line of the file in which each row is written; None for a binary file.
    lines_are : what `lines` counts: "line", or "row" for a sheet.
    cut : what is missing at the end of a truncated file; None if nothing is known to be missing.
    ends_broken : whether the last line is no row of the table, as in a file that is still being
        written.
    notes : repairs and omissions made while reading.
    variables : the variables of a binary file, in the order of the file.
    partial : columns left out because cells are empty or not numbers: heading to a description.
    run : which of the file's recordings this is; "" if there is only one.
    """

    source: str
    format: Format
    names: tuple[str, ...]
    values: Array
    whole: tuple[bool, ...]
    lines: NDArray[np.int64] | None
    cut: str | None = None
    ends_broken: bool = False
    notes: tuple[str, ...] = ()
    lines_are: str = "line"
    variables: tuple[Variable, ...] = ()
    partial: Mapping[str, str] = field(default_factory=dict)
    run: str = ""

    @property
    def cut_short(self) -> str:
        """The message about a truncated file, with advice; "" for a complete file."""
        if self.cut is None:
            return ""
        return f"{self.cut}; the file is truncated: export it again"

    def place(self, row: int) -> str:
        """Return "line 12" (or "row 12", or "sample 12") for a row counted from 0."""
        return f"sample {row + 1}" if self.lines is None else f"{self.lines_are} {self.lines[row]}"

    def index(self, column: str | int) -> int:
        """Return the position (from 0) of a column given by heading or by number (from 1).

        Raises
        ------
        SubmissionError : there is no such column.
        """
        if isinstance(column, int):
            if 1 <= column <= len(self.names):
                return column - 1
            raise SubmissionError(
                f"{self.source}: there is no column {column}, the file has {len(self.names)}"
            )
        wanted = _loosely(column)
        for i, name in enumerate(self.names):
            if _loosely(name) == wanted:
                return i
        self.refuse_partial(name for name in self.partial if _loosely(name) == wanted)
        close = get_close_matches(column, self.names, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"it has {self.headings()}"
        raise SubmissionError(f"{self.source}: there is no column {column[:60]!r}; {hint}")

    def refuse_partial(self, names: Iterable[str]) -> None:
        """Refuse columns that are needed, if they were left out for their cells.

        Raises
        ------
        SubmissionError : there is such a column.
        """
        for name in names:
            raise SubmissionError(
                f"{self.source}: {self.partial[name]}; fill these cells, or leave out their rows"
            )

    def has(self, column: str | int) -> bool:
        """Return whether there is such a column."""
        if isinstance(column, int):
            return 1 <= column <= len(self.names)
        return _loosely(column) in map(_loosely, self.names)

    def headings(self) -> str:
        """Return the headings as one short line of text."""
        shown = ", ".join(self.names[:12])
        return shown + (", …" if len(self.names) > 12 else "")


def checked_names(
    names: Sequence[str], *, place: str, numbers: Sequence[int] | None = None
) -> list[str]:
    """Return headings without quotes; an empty one becomes the number of its column.

    `numbers` (from 0) are the numbers of the columns, if some are left out.

    Raises
    ------
    SubmissionError : there are too many headings, or a heading is too long or repeated; the message
        begins with `place`.
    """
    if len(names) > MOST_COLUMNS:
        raise SubmissionError(f"{place}: more than {MOST_COLUMNS} columns")
    if (longest := max(map(len, names), default=0)) > _LONGEST_HEADING:
        raise SubmissionError(
            f"{place}: a heading of {longest:,} characters; the limit is {_LONGEST_HEADING}"
        )
    numbers = numbers if numbers is not None else range(len(names))
    clean = [name.strip(" \"'") or str(i + 1) for i, name in zip(numbers, names, strict=True)]
    clean = [*map(printable, clean)]
    seen: set[str] = set()
    for name in clean:
        if name.casefold() in seen:
            raise SubmissionError(f"{place}: the heading {name[:40]!r} appears twice")
        seen.add(name.casefold())
    return clean


def binary_table(
    columns: Sequence[np.ndarray],
    *,
    names: Sequence[str],
    source: str,
    format: Format,
    run: str = "",
    notes: Sequence[str] = (),
    variables: Sequence[Variable] = (),
) -> FileTable:
    """Return the table of a binary file, which has samples instead of lines.

    Raises
    ------
    SubmissionError : a number is not usable.
    """
    values = np.array(columns, dtype=np.float64)
    refuse_unusable(values, names=names, place=lambda row: f"{source} sample {row + 1}")
    return FileTable(
        source=source,
        format=format,
        names=tuple(names),
        values=values,
        whole=tuple(bool((column == np.round(column)).all()) for column in values),
        lines=None,
        run=run,
        notes=tuple(notes),
        variables=tuple(variables),
    )


def even_times(n: int, *, start: float, interval: float) -> Array:
    """Return n times in s, from the first time and the interval."""
    return start + interval * np.arange(n, dtype=np.float64)


def printable(text: str) -> str:
    """Return a text of a file without characters that cannot be shown."""
    return text if text.isprintable() else repr(text)[1:-1]


def not_read(variables: Sequence[Variable]) -> list[str]:
    """Return a note on each variable that is not read, the largest first."""
    variables = [v for v in variables if not v.read]
    large = [v for v in variables if v.advice]
    large.sort(key=lambda v: -math.prod(v.size))
    notes = [f"not read: {v}; {v.advice}" for v in large[:MOST_NAMED]]
    alike: dict[str, list[str]] = {}
    for v in (*large[MOST_NAMED:], *(v for v in variables if not v.advice)):
        alike.setdefault(str(v).removeprefix(v.name), []).append(v.name)
    rest = [first_few(names, MOST_NAMED) + what for what, names in alike.items()]
    return notes + ([f"not read: {first_few(rest, MOST_NAMED)}"] if rest else [])


def refuse_unusable(values: Array, *, names: Sequence[str], place: Callable[[int], str]) -> None:
    """Refuse NaN, infinity and numbers beyond any measurement; `values` is (n_columns, n).

    Raises
    ------
    SubmissionError : there is such a number; the message names its column and `place(row)`.
    """
    # This limit applies to everything in a file, also to times and unused columns.
    usable = np.abs(values) < 1e50  # NaN compares as false
    if not usable.all():
        column, row = np.argwhere(~usable)[0]
        what = "too large" if np.isfinite(values[column, row]) else "not a finite number"
        raise SubmissionError(f"{place(int(row))}: {names[column]!r} is {what}")


def refuse_extreme(values: Array, *, what: str) -> None:
    """Refuse numbers whose largest magnitude is impossible on a bench; all zeros are allowed.

    Raises
    ------
    SubmissionError : the numbers are refused; the message begins with `what`.
    """
    largest = float(np.abs(values).max(initial=0.0))
    if largest != 0 and not _SMALLEST_MEASURED <= largest <= _LARGEST_MEASURED:
        raise SubmissionError(
            f"{what} reaches {largest:.3g}; expected {_SMALLEST_MEASURED:g} to "
            f"{_LARGEST_MEASURED:g}: check the file, its unit and `per_count`"
        )


def _loosely(name: str) -> str:
    return " ".join(name.casefold().split())
