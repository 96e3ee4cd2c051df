"""What all sections of a report share: the analysis, running numbers, figures as blocks."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import count as counter

from matplotlib.figure import Figure

from pipeline import __version__
from pipeline.report.document import (
    Block,
    Cell,
    Document,
    Picture,
    Section,
    Spans,
    Table,
    bullet_list,
    make_table,
)
from pipeline.report.figures.style import WIDTH, drawing
from pipeline.report.figures.svg import to_svg
from pipeline.report.numbers import count
from pipeline.report.words import clean, rich
from pipeline.results import Analysis, Record


@dataclass(frozen=True)
class Page:
    """The analysis, its text made fit to show, and the running numbers of figures and tables."""

    analysis: Analysis
    records: dict[str, Record]
    position: str
    drive: str
    _figures: counter = field(default_factory=lambda: counter(1))
    _tables: counter = field(default_factory=lambda: counter(1))

    @classmethod
    def of(cls, analysis: Analysis) -> "Page":
        """Return the page of an analysis, nothing numbered yet."""
        return cls(
            analysis=analysis,
            records={record.id: record for record in analysis.records},
            position=clean(analysis.position_unit),
            drive=clean(analysis.input_unit),
        )

    def document(self, sections: Iterable[Section], *, about: str) -> Document:
        """Return the sections under title, authors and what the document is about.

        What it is about is the title where the students gave none, and is then said once.
        """
        analysis = self.analysis
        title = clean(analysis.title).strip()
        section = [f"Section {clean(analysis.section)}"] if analysis.section else []
        people = analysis.authors
        return Document(
            title=title or about,
            subtitle=" · ".join([*section, *([about] if title else [])]),
            authors=tuple(clean(f"{name} ({id_})" if name else id_) for id_, name in people),
            sections=tuple(sections),
            footer=f"cartlab {__version__}",
        )

    def sections(
        self, parts: Iterable["Part"], *, doing: str, progress: Callable[[str], None] | None
    ) -> list[Section]:
        """Return the sections that have something to show, each said to `progress` beforehand."""
        found = []
        with drawing():
            for id_, title, blocks_of in parts:
                if progress:
                    progress(f"{doing}: {title.lower()}")
                if blocks := blocks_of(self):
                    found.append(Section(id=id_, title=title, blocks=tuple(blocks)))
        return found

    def table(
        self,
        caption: str | Spans,
        head: Iterable[str | Spans],
        rows: Iterable[Sequence[Cell | str | Spans]],
        align: str,
    ) -> Table:
        """Return a table, see `make_table`, under the next table number."""
        return make_table(next(self._tables), caption, head, rows, align)

    def picture(self, name: str, figure: Figure, *, caption: str, alt: str) -> Picture:
        """Return a figure as SVG, under the next figure number."""
        alt = clean(alt)
        return Picture(
            number=next(self._figures),
            name=name,
            caption=rich(clean(caption)),
            alt=alt,
            svg=to_svg(figure, name=name, alt=alt),
            width=WIDTH,
        )


Part = tuple[str, str, Callable[[Page], list[Block]]]  # anchor, title, blocks


def remarks(notes: Sequence[str]) -> list[Block]:
    """Return notes as a list, nothing where there are none."""
    return [bullet_list(rich(clean(note)) for note in notes)] if notes else []


def left_out(n: int) -> str:
    """Return the sentence that says how many records a figure does not show."""
    return f" {count(n, 'further record')} not drawn." if n > 0 else ""
