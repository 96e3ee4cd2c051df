"""Make a document's files (the page, the PDF and the figures) and write them into a folder."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.document import Document

Made = Mapping[str, str | bytes]  # contents of files by their paths in the folder
FIGURES = "figures"  # folder of the figures


def make_files(document: Document, *, name: str, pdf: bool) -> Made:
    """Return `figures/*.svg`, `name.html` and, if asked for, `name.pdf`."""
    # Imported late, because programs that only write the files need no renderer.
    from pipeline.report.html import render_html
    from pipeline.report.pdf import render_pdf

    drawn: Made = {f"{FIGURES}/{one.name}.svg": one.svg for one in document.pictures()}
    with ThreadPoolExecutor(1) as thread:  # typst computes without the interpreter's lock
        printed = thread.submit(render_pdf, document) if pdf else None
        page = render_html(document)
        made = {**drawn, f"{name}.html": page}
        return made if printed is None else {**made, f"{name}.pdf": printed.result()}


def write_document(document: Document, out: Path, *, name: str, pdf: bool) -> None:
    """Make a document's files and write them into the folder `out`."""
    write_files(make_files(document, name=name, pdf=pdf), out, name=name)


def write_files(made: Made, out: Path, *, name: str) -> None:
    """Write the files of a document in place of those of an earlier one.

    All files are made before the first one is written, so an interrupted run leaves the earlier
    document complete.

    Parameters
    ----------
    name : name of the page and the PDF, without ending.
    """
    figures = own_folder(out, FIGURES)
    figures.mkdir(parents=True, exist_ok=True)
    clear_files(figures, "*.svg")
    clear_files(out, f"{name}.pdf")
    for file, content in made.items():
        write_file(out / file, content)
