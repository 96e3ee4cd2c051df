"""A table of cells, columns aligned."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from pipeline.report.document import Cell, Span, Spans, Table, plain, spans
from pipeline.report.numbers import at_decimal


def cell(text: str | Spans | Span, tone: str = "") -> Cell:
    """Return a table cell."""
    return Cell(spans(text), tone)  # type: ignore[arg-type]


def make_table(
    number: int,
    caption: str | Spans,
    head: Iterable[str | Spans],
    rows: Iterable[Sequence[Cell]],
    align: str,
) -> Table:
    """Return a table; `align` has one of l, c, r or d (on the decimal mark) for each column."""
    return Table(
        number=number,
        caption=spans(caption),
        head=tuple(cell(text) for text in head),
        rows=tuple(
            tuple(_cut(c) if how == "d" else c for c, how in zip(row, align, strict=True))
            for row in rows
        ),
        align=align,
    )


def _cut(content: Cell) -> Cell:
    return replace(content, parts=at_decimal(plain(content.text)))
