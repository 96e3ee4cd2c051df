"""Write a document as HTML and as PDF, with its figures in a folder next to it."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from pipeline.output import clear_files, own_folder, write_file
from pipeline.report.document import Document
from pipeline.report.figures.svg import plain_svg
from pipeline.report.render.html import render_html
from pipeline.report.render.pdf import lay_out, print_pages


def write_document(document: Document, out: Path, *, name: str, pdf: bool) -> None:
    """Write a document as `name.html`, `name.pdf` and `figures/*.svg` into the folder `out`.

    Everything is made before the first file is written, so an interrupted run leaves an earlier
    document complete.
    """
    figures = own_folder(out, "figures")
    with ThreadPoolExecutor(max_workers=1) as beside:  # typst releases Python's global lock
        layout = beside.submit(lay_out, document) if pdf else None
        drawn = {f"{picture.name}.svg": plain_svg(picture.svg) for picture in document.pictures()}
        printed = beside.submit(lambda: print_pages(document, layout.result())) if layout else None
        html = render_html(document)
        pages = printed.result() if printed else None
    figures.mkdir(parents=True, exist_ok=True)
    clear_files(figures, "*.svg")
    clear_files(out, f"{name}.pdf")
    for file, svg in drawn.items():
        write_file(figures / file, svg)
    write_file(out / f"{name}.html", html)
    if pages:
        write_file(out / f"{name}.pdf", pages)
