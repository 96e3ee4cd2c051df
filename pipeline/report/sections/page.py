"""The parts that all sections of a report share: the analysis, its records and its units."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

from pipeline.report.document import Block, Document, Section, bullet_list
from pipeline.report.render.builder import PageBuilder
from pipeline.results import Analysis, Record
from pipeline.setup import Units
from pipeline.words.numbers import count
from pipeline.words.text import clean, rich


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
