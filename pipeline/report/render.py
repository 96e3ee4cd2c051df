"""Write a report: one document, as HTML and as PDF, with its figures beside them."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

from pipeline.gap.types import Gap
from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.changes import DraftChanges
from pipeline.report.content import build_document
from pipeline.report.document import Document
from pipeline.report.html import render_html
from pipeline.report.pdf import missing_characters, render_pdf
from pipeline.report.svg import plain_svg
from pipeline.results import Analysis


def render_report(
    analysis: Analysis,
    out: Path,
    *,
    gap: Gap | None = None,
    changes: DraftChanges | None = None,
    pdf: bool = True,
    progress: Callable[[str], None] | None = None,
) -> None:
    """Write `report.html`, `report.pdf` and `figures/*.svg` into the folder `out`.

    The same analysis gives the same bytes. What the PDF's fonts cannot show is warned of, in the
    report and through `progress`, which is also told of each section.
    """
    if pdf and (lost := missing_characters(_students_text(analysis))):
        warning = f"report.pdf: no font there has {lost}; report.html shows them"
        analysis = replace(analysis, warnings=(*analysis.warnings, warning))
        if progress:
            progress(warning)
    document = build_document(analysis, gap=gap, changes=changes, progress=progress)
    write_document(document, out, name="report", pdf=pdf)


def write_document(document: Document, out: Path, *, name: str, pdf: bool) -> None:
    """Write a document as `name.html`, `name.pdf` and `figures/*.svg` into the folder `out`."""
    figures = own_folder(out, "figures")
    figures.mkdir(parents=True, exist_ok=True)
    clear_files(figures, "*.svg")
    clear_files(out, f"{name}.pdf")
    with ThreadPoolExecutor(max_workers=1) as beside:  # typst works outside the interpreter's lock
        printed = beside.submit(render_pdf, document) if pdf else None
        write_file(out / f"{name}.html", render_html(document))
        for picture in document.pictures():
            write_file(figures / f"{picture.name}.svg", plain_svg(picture.svg))
        if printed:
            write_file(out / f"{name}.pdf", printed.result())


def _students_text(analysis: Analysis) -> str:
    """Return all that students wrote and the report shows."""
    authors = (part for author in analysis.authors for part in author)
    records = (record.id for record in analysis.records)
    units = (analysis.position_unit, analysis.input_unit)
    notes = analysis.discussion or ""
    return "".join((analysis.title, analysis.section, *authors, *records, *units, notes))
