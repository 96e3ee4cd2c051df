"""Build a page: number figures and tables, add their captions, collect sections."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

from matplotlib.figure import Figure

from pipeline.report.document import (
    Block,
    Cell,
    Document,
    Picture,
    Section,
    Table,
    bullet_list,
    make_table,
)
from pipeline.report.figures.style import drawing, to_svg
from pipeline.results import Analysis, Record
from pipeline.setup import Units
from pipeline.words.numbers import count
from pipeline.words.phrases import Phrases
from pipeline.words.progress import Progress, silent
from pipeline.words.text import Spans, clean, rich

# Anchor, title, and a function that returns the blocks of a page.
Part = tuple[str, str, Callable[[Any], Sequence[Block]]]


@dataclass(frozen=True)
class PageBuilder:
    """Counts the figures and tables of a page."""

    _figures: Iterator[int] = field(default_factory=lambda: itertools.count(1), init=False)
    _tables: Iterator[int] = field(default_factory=lambda: itertools.count(1), init=False)

    def sections(
        self, parts: Iterable[Part], *, doing: str = "", progress: Progress = silent
    ) -> tuple[Section, ...]:
        """Return the sections that are not empty; `progress` is called before each one."""
        found = []
        with drawing():
            for id_, title, blocks_of in parts:
                progress(f"{doing}: {title.lower()}")
                if blocks := blocks_of(self):
                    found.append(Section(id=id_, title=title, blocks=tuple(blocks)))
        return tuple(found)

    def table(
        self,
        words: Phrases,
        key: str,
        rows: Iterable[Sequence[Cell | str | Spans]],
        align: str,
        is_numbered: bool = True,
        /,
        **values: object,
    ) -> Table:
        """Return a table with the next number; see `make_table`.

        Parameters
        ----------
        words : the texts of the page.
        key : key of the caption; the headings have the key `{key}_head`.
        is_numbered : false for a table without a number and a visible caption.
        values : values that are inserted into the caption and the headings.
        """
        head = [rich(text) for text in words.cells(f"{key}_head", **values)]
        caption, head = words.text(key, **values), head[: len(align)]
        if not is_numbered:
            return make_table(0, caption, head, rows, align)
        return self.headed_table(caption, head, rows, align)

    def headed_table(
        self,
        caption: str,
        head: Iterable[str | Spans],
        rows: Iterable[Sequence[Cell | str | Spans]],
        align: str,
    ) -> Table:
        """Return a table with the next number, with the given caption and headings."""
        return make_table(next(self._tables), caption, head, rows, align)

    def picture(
        self,
        name: str,
        figure: Figure,
        words: Phrases,
        key: str,
        /,
        *,
        alt: str = "",
        **said: object,
    ) -> Picture:
        """Return a figure with the next number; it is drawn later.

        Parameters
        ----------
        name : file name.
        words : the texts of the page.
        key : key of the caption.
        alt : key of the text alternative, by default `{key}_alt`.
        said : values that are inserted into the caption and the text alternative.
        """
        alt = clean(words.text(alt or f"{key}_alt", **said))
        return Picture(
            number=next(self._figures),
            name=name,
            caption=rich(clean(words.text(key, **said))),
            alt=alt,
            draw=partial(_draw, figure, name=name, alt=alt),
        )


def _draw(figure: Figure, *, name: str, alt: str) -> str:
    with drawing():
        return to_svg(figure, name=name, alt=alt)


@dataclass(frozen=True)
class Page(PageBuilder):
    """A page about an analysis; its units and other text are safe to show."""

    analysis: Analysis

    @cached_property
    def records(self) -> dict[str, Record]:
        """The records by their ids."""
        return {record.id: record for record in self.analysis.records}

    @cached_property
    def units(self) -> Units:
        """The units, without control characters."""
        stated = self.analysis.bench.units
        return Units(position=clean(stated.position), input=clean(stated.input))

    @property
    def position(self) -> str:
        """The unit of positions."""
        return self.units.position

    @property
    def drive(self) -> str:
        """The unit of the input."""
        return self.units.input

    def document(self, sections: Iterable[Section], *, about: str) -> Document:
        """Return the sections as a document, with title and authors.

        Parameters
        ----------
        about : the subject; it becomes the title if the students gave none.
        """
        analysis = self.analysis
        title = clean(analysis.title).strip()
        section = [f"Section {clean(analysis.section)}"] if analysis.section else []
        return Document(
            title=title or about,
            subtitle=" · ".join([*section, *([about] if title else [])]),
            authors=tuple(
                clean(f"{name} ({id_})" if name else id_) for id_, name in analysis.authors
            ),
            sections=tuple(sections),
        )


def remarks(notes: Sequence[str]) -> list[Block]:
    """Return notes as a list; empty if there are no notes."""
    return [bullet_list(rich(clean(note)) for note in notes)] if notes else []


def left_out(n: int) -> str:
    """Return a sentence with the number of recordings that a figure does not show."""
    return f" {count(n, 'further record')} not drawn." if n > 0 else ""
