"""Write a document as HTML and as PDF, with its figures in a folder next to it."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.document import Document
from pipeline.report.figures.svg import plain_svg
from pipeline.report.render.html import render_html
from pipeline.report.render.pdf import lay_out, print_pages


def write_document(document: Document, out: Path, *, name: str, pdf: bool) -> None:
    """Write a document as `name.html`, `name.pdf` and `figures/*.svg` into the folder `out`."""
    figures = own_folder(out, "figures")
    figures.mkdir(parents=True, exist_ok=True)
    clear_files(figures, "*.svg")
    clear_files(out, f"{name}.pdf")
    with ThreadPoolExecutor(max_workers=1) as beside:  # typst runs without the interpreter's lock
        layout = beside.submit(lay_out, document) if pdf else None
        for picture in document.pictures():
            write_file(figures / f"{picture.name}.svg", plain_svg(picture.svg))
        printed = beside.submit(lambda: print_pages(document, layout.result())) if layout else None
        write_file(out / f"{name}.html", render_html(document))
        if printed:
            write_file(out / f"{name}.pdf", printed.result())
