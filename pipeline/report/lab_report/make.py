"""Make a report from an analysis: its files and what the command prints about it."""

from dataclasses import replace
from typing import TYPE_CHECKING

from pipeline.report.lab_report.changes import DraftChanges, changes_line
from pipeline.report.lab_report.content import build_document
from pipeline.report.lab_report.files import NAME, PAGE_AND_PDF, Draft, Files
from pipeline.report.plots import NAME as PLOTS
from pipeline.report.render.folder import Made
from pipeline.report.render.pdf import missing_characters
from pipeline.report.render.write import make_files
from pipeline.report.sections.questions import open_line
from pipeline.report.sections.summary import terminal_summary
from pipeline.results import Analysis
from pipeline.words.progress import Progress, silent
from pipeline.words.text import with_symbols

if TYPE_CHECKING:
    from pipeline.gap.types import Gap


def make_draft(
    analysis: Analysis,
    *,
    gap: "Gap | None" = None,
    changes: DraftChanges | None = None,
    files: Files = PAGE_AND_PDF,
    progress: Progress = silent,
) -> Draft:
    """Return the report of an analysis."""
    lines = (changes and with_symbols(changes_line(changes)), open_line(analysis))
    return Draft(
        files=_make_files(analysis, gap=gap, changes=changes, files=files, progress=progress),
        summary=terminal_summary(analysis),
        remarks=tuple(filter(None, lines)),
    )


def _make_files(
    analysis: Analysis,
    *,
    gap: "Gap | None",
    changes: DraftChanges | None,
    files: Files,
    progress: Progress,
) -> Made:
    """Return `report.html`, `figures/*.svg` and the other requested pages.

    The same analysis gives the same bytes. If the PDF's fonts lack some characters, the report and
    `progress` name them. `progress` also receives the name of each section.
    """
    if files.pdf and (lost := missing_characters(_students_text(analysis))):
        warning = f"report.pdf: its fonts lack {lost}; report.html shows them"
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
        progress(warning)
    document = build_document(analysis, gap=gap, changes=changes, progress=progress)
    if not files.plots:
        return make_files(document, name=NAME, pdf=files.pdf)
    # Imported late, because it loads the catalogue of effects.
    from pipeline.report.plots.page import make_page

    plots = make_page(analysis, gap=gap, report=True, progress=progress)
    document = replace(document, plots=PLOTS)
    return {**make_files(document, name=NAME, pdf=files.pdf), PLOTS: plots}


def _students_text(analysis: Analysis) -> str:
    """Return all text in the report that was written by students."""
    authors = (part for author in analysis.authors for part in author)
    records = (record.id for record in analysis.records)
    units = vars(analysis.bench.units).values()
    notes = analysis.discussion or ""
    return "".join((analysis.title, analysis.section, *authors, *records, *units, notes))
