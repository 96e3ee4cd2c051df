"""Make a document's files: the page, the PDF and the figures."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.report.document import Document
from pipeline.report.figures.svg import plain_svg
from pipeline.report.render.folder import FIGURES, Made, write_files
from pipeline.report.render.html import render_html
from pipeline.report.render.pdf import lay_out, print_pages


def make_files(document: Document, *, name: str, pdf: bool) -> Made:
    """Return `figures/*.svg`, `name.html` and, if asked for, `name.pdf`."""
    with ThreadPoolExecutor(max_workers=1) as beside:  # typst releases Python's global lock
        layout = beside.submit(lay_out, document) if pdf else None
        pictures = document.pictures()
        drawn = {f"{FIGURES}/{one.name}.svg": plain_svg(one.svg) for one in pictures}
        printed = beside.submit(lambda: print_pages(document, layout.result())) if layout else None
        html = render_html(document)
        pages = {f"{name}.pdf": printed.result()} if printed else {}
    return {**drawn, f"{name}.html": html, **pages}


def write_document(document: Document, out: Path, *, name: str, pdf: bool) -> None:
    """Make a document's files and write them into the folder `out`."""
    write_files(make_files(document, name=name, pdf=pdf), out, name=name)
