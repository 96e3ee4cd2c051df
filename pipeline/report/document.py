"""A report as plain data: sections of blocks, which are rendered as HTML and as PDF.

The content is decided once (`content.py`), so both renderings agree. Every text is data: neither
renderer ever reads a string as markup. `as_json` makes the input of the PDF template.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from typing import Any, Literal

from pipeline import __version__
from pipeline.words.math import Math
from pipeline.words.numbers import at_decimal
from pipeline.words.text import Span, Spans, plain, spans

_PHONE = 42  # most characters in a row of a table on a phone; each gap between columns takes two
_LONG = 16  # a tile whose value has more characters is wide
_WIDE_TILES, _MOST_TILES = 3, 5  # tiles in one row

Tone = Literal["", "good", "bad", "quiet"]


@dataclass(frozen=True)
class Heading:
    """A heading inside a section; level 3 or deeper."""

    text: Spans
    level: int = 3
    kind: str = field(default="heading", init=False)


@dataclass(frozen=True)
class Paragraph:
    """A paragraph."""

    text: Spans
    kind: str = field(default="paragraph", init=False)


@dataclass(frozen=True)
class Items:
    """A list; each item is a tuple of blocks."""

    items: tuple[tuple["Block", ...], ...]
    ordered: bool = False
    kind: str = field(default="items", init=False)


@dataclass(frozen=True)
class Quote:
    """Quoted blocks."""

    blocks: tuple["Block", ...]
    kind: str = field(default="quote", init=False)


@dataclass(frozen=True)
class Code:
    """Preformatted text."""

    text: str
    kind: str = field(default="code", init=False)


@dataclass(frozen=True)
class Formula:
    """A displayed equation.

    Attributes
    ----------
    alt : the equation in words.
    copy : text that a reader can paste into a program.
    """

    math: Math
    alt: str
    copy: str = ""
    kind: str = field(default="formula", init=False)


@dataclass(frozen=True)
class Cell:
    """A table cell.

    Attributes
    ----------
    tone : colour of the cell; the text says the same in words.
    parts : the text before the decimal mark and the text from the mark on, in a column aligned on
        the decimal mark.
    """

    text: Spans
    tone: Tone = ""
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Table:
    """A numbered table.

    Attributes
    ----------
    align : one letter for each column: l, c, r or d (on the decimal mark).
    finder : whether readers of the page can search and sort the table.
    """

    number: int
    caption: Spans
    head: tuple[Cell, ...]
    rows: tuple[tuple[Cell, ...], ...]
    align: str
    finder: bool = False
    kind: str = field(default="table", init=False)

    @cached_property
    def is_wide(self) -> bool:
        """Whether a phone has too little room for the columns, so that it shows rows as lines."""
        widths = [max(map(len, plain(one.text).split()), default=0) for one in self.head]
        for row in self.rows:
            lengths = (len(plain(one.text)) for one in row)
            widths = [max(pair) for pair in zip(widths, lengths, strict=True)]
        return sum(widths) + 2 * (len(widths) - 1) > _PHONE


@dataclass(frozen=True)
class Picture:
    """A numbered figure.

    Attributes
    ----------
    name : file name in `figures/`.
    draw : function that returns the figure as SVG; called when `svg` is first used.
    """

    number: int
    name: str
    caption: Spans
    alt: str
    draw: Callable[[], str] = field(repr=False)
    kind: str = field(default="picture", init=False)

    @cached_property
    def svg(self) -> str:
        """The drawing."""
        return self.draw()


@dataclass(frozen=True)
class Tile:
    """One fact on a board: its label, value and meaning.

    Attributes
    ----------
    url : address of the section on this fact.
    """

    label: Spans
    value: Spans
    note: Spans = ()
    tone: Tone = ""
    url: str = ""


@dataclass(frozen=True)
class Tiles:
    """A board of the most important facts.

    Attributes
    ----------
    across : tiles in one row; by default, as many as make the rows equally long.
    """

    tiles: tuple[Tile, ...]
    across: int = 0
    kind: str = field(default="tiles", init=False)

    def __post_init__(self) -> None:
        if self.across:
            return
        most = _WIDE_TILES if self.longest > _LONG else _MOST_TILES
        rows = -(-len(self.tiles) // most)
        # Make the rows equally long.
        object.__setattr__(self, "across", -(-len(self.tiles) // rows))

    @property
    def longest(self) -> int:
        """The number of characters of the longest value."""
        return max(len(plain(tile.value)) for tile in self.tiles)


@dataclass(frozen=True)
class Details:
    """Blocks that a page hides until a reader opens them.

    Attributes
    ----------
    in_print : what the PDF shows instead; by default, the blocks themselves.
    """

    title: Spans
    blocks: tuple["Block", ...]
    in_print: tuple["Block", ...] | None = None
    kind: str = field(default="details", init=False)


@dataclass(frozen=True)
class Question:
    """A question to the students, with their answer or a mark where the answer is missing."""

    id: str
    text: Spans
    answer: tuple["Block", ...] = ()
    kind: str = field(default="question", init=False)


Block = (
    Heading
    | Paragraph
    | Items
    | Quote
    | Code
    | Formula
    | Table
    | Picture
    | Tiles
    | Details
    | Question
)


@dataclass(frozen=True)
class Section:
    """A section of a report.

    Attributes
    ----------
    id : the section's anchor on the page.
    in_print : whether the PDF has the section.
    """

    id: str
    title: str
    blocks: tuple[Block, ...]
    in_print: bool = True


@dataclass(frozen=True)
class Document:
    """A whole report.

    Attributes
    ----------
    plots : address of the page with plots of all recordings; "" if there is no such page.
    """

    title: str
    subtitle: str
    authors: tuple[str, ...]
    sections: tuple[Section, ...]
    plots: str = ""
    footer: str = f"cartlab {__version__}"

    def pictures(self) -> tuple[Picture, ...]:
        """The figures in order."""
        return tuple(
            block
            for section in self.sections
            for block in flat(section.blocks)
            if isinstance(block, Picture)
        )


def flat(blocks: Iterable[Block]) -> Iterator[Block]:
    """Yield all blocks in order, including those inside `Details`."""
    for block in blocks:
        if isinstance(block, Details):
            yield from flat(block.blocks)
        else:
            yield block


def paragraph(*parts: str | Span | Spans) -> Paragraph:
    """Return a paragraph made of several parts."""
    return Paragraph(spans(*parts))


def bullet_list(items: Iterable[Spans]) -> Items:
    """Return a list in which each item is one paragraph."""
    return Items(tuple((Paragraph(item),) for item in items))


def plain_lines(blocks: Iterable[Block]) -> str:
    """Return paragraphs and lists as lines of plain text."""
    lines = []
    for block in blocks:
        if isinstance(block, Paragraph):
            lines.append(plain(block.text))
        elif isinstance(block, Items):
            items = (inner for item in block.items for inner in item)
            lines += [f"- {plain(inner.text)}" for inner in items if isinstance(inner, Paragraph)]
    return "\n".join(lines)


def cell(text: str | Spans | Span, tone: Tone = "") -> Cell:
    """Return a table cell."""
    return Cell(spans(text), tone)


def make_table(
    number: int,
    caption: str | Spans,
    head: Iterable[str | Spans],
    rows: Iterable[Sequence[Cell | str | Spans]],
    align: str,
) -> Table:
    """Return a table; each cell is a `Cell` or plain text.

    Parameters
    ----------
    align : one letter for each column; see `Table`.
    """

    def cut(content: Cell | str | Spans, how: str) -> Cell:
        made = content if isinstance(content, Cell) else cell(content)
        return replace(made, parts=at_decimal(plain(made.text))) if how == "d" else made

    return Table(
        number=number,
        caption=spans(caption),
        head=tuple(cell(text) for text in head),
        rows=tuple(tuple(cut(*pair) for pair in zip(row, align, strict=True)) for row in rows),
        align=align,
    )


def as_json(value: Any) -> Any:
    """Return dataclasses and tuples in a form that `json` can write."""
    if is_dataclass(value):
        return {f.name: as_json(getattr(value, f.name)) for f in fields(value) if f.repr}
    if isinstance(value, tuple):
        return [as_json(item) for item in value]
    return value
