"""What all sections of a report share: the analysis, running numbers, figures as blocks."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count as counter

from matplotlib.figure import Figure

from pipeline.report.document import Block, Picture, bullet_list
from pipeline.report.figures import WIDTH
from pipeline.report.numbers import count
from pipeline.report.svg import to_svg
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

    def table_number(self) -> int:
        """Return the next table's number."""
        return next(self._tables)

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


def remarks(notes: Sequence[str]) -> list[Block]:
    """Return notes as a list, nothing where there are none."""
    return [bullet_list(rich(clean(note)) for note in notes)] if notes else []


def left_out(n: int) -> str:
    """Return the sentence that says how many records a figure does not show."""
    return f" {count(n, 'further record')} not drawn." if n > 0 else ""
