"""Make a document's files: the page, the PDF and the figures."""

from pathlib import Path

from pipeline.report.document import Document
from pipeline.report.render.folder import FIGURES, Made, write_files
from pipeline.report.render.html import render_html
from pipeline.report.render.pdf import render_pdf


def make_files(document: Document, *, name: str, pdf: bool) -> Made:
    """Return `figures/*.svg`, `name.html` and, if asked for, `name.pdf`."""
    drawn = {f"{FIGURES}/{one.name}.svg": one.svg for one in document.pictures()}
    printed = {f"{name}.pdf": render_pdf(document)} if pdf else {}
    return {**drawn, f"{name}.html": render_html(document), **printed}


def write_document(document: Document, out: Path, *, name: str, pdf: bool) -> None:
    """Make a document's files and write them into the folder `out`."""
    write_files(make_files(document, name=name, pdf=pdf), out, name=name)
