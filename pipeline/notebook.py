"""An analysis for a notebook: one call, and every part shows itself."""

from dataclasses import dataclass, fields
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.report.content import build_document
from pipeline.report.document import Block, Document, Heading, spans
from pipeline.report.html import render_fragment
from pipeline.report.known_gap import with_gap
from pipeline.report.summary import terminal_summary
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.workflow import analyse as run


@dataclass(frozen=True)
class Shown:
    """Blocks of a report, which a notebook shows as the report does."""

    title: str
    blocks: tuple[Block, ...]

    def _repr_html_(self) -> str:
        return render_fragment((Heading(spans(self.title)), *self.blocks))

    def __repr__(self) -> str:
        return f"Shown({self.title!r})"


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class LabAnalysis(Analysis):
    """All results of one submission; at the end of a cell it shows its summary and its table."""

    document: Document

    @property
    def sections(self) -> tuple[str, ...]:
        """The sections that `show` knows."""
        return tuple(section.id for section in self.document.sections)

    def show(self, section: str) -> Shown:
        """Return one section of the report ("frequency-response", "feedback", …).

        Raises
        ------
        ConfigError : this report has no such section.
        """
        for found in self.document.sections:
            if found.id == section:
                return Shown(found.title, found.blocks)
        raise ConfigError(f"no section {section!r}; there are {', '.join(self.sections)}")

    def _repr_html_(self) -> str:
        shown = (section for section in self.document.sections if section.id in _AT_A_GLANCE)
        return render_fragment(
            [block for s in shown for block in (Heading(spans(s.title)), *s.blocks)]
        )

    def __repr__(self) -> str:
        return terminal_summary(self)


_AT_A_GLANCE = ("summary", "parameters")


def analyse(folder: Path | str) -> LabAnalysis:
    """Run the whole pipeline on a submission folder.

    Raises
    ------
    SubmissionError : `submission.toml` or a data file is wrong or missing.
    """
    submission = load_submission(Path(folder))
    analysis, gap = with_gap(run(submission), submission.folder)
    document = build_document(analysis, gap=gap, progress=None)
    values = {field.name: getattr(analysis, field.name) for field in fields(analysis)}
    return LabAnalysis(**values, document=document)
