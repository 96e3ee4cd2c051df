"""Render a document as PDF with typst; all content goes in as JSON, so no text is markup."""

import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import typst
from matplotlib import get_data_path
from matplotlib.ft2font import FT2Font

from pipeline.report.document import Document, Picture, as_json
from pipeline.report.figures.svg import plain_svg
from pipeline.report.render.page_filling import Choices, End, Pages, fill_pages
from pipeline.resources import TEMPLATES
from pipeline.words.numbers import unbroken
from pipeline.words.text import clean

_TIMESTAMP = 0  # archival PDF needs a date; the real one would make two reports differ
_MISSING = "□"  # replaces a character that no font has
_SHOWN_IN_WARNING = 20


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The layout of a document.

    Attributes
    ----------
    text : the document's content as JSON.
    choices : changes to the default layout.
    """

    text: str
    choices: Choices


def render_pdf(document: Document) -> bytes:
    """Return the PDF (archival A-2a, accessible UA-1), which uses only the fonts of cartlab."""
    return print_pages(document, lay_out(document))


def lay_out(document: Document) -> Layout:
    """Lay out the pages, before the figures need to be drawn; this takes most of the time."""
    text = json.dumps(_printable(as_json(document)), ensure_ascii=False, allow_nan=False)
    blanks = {_file(one): (one.blank or one.svg).encode() for one in document.pictures()}
    choices = fill_pages(lambda choices: _try(_parts(text, choices, blanks)))
    return Layout(text=text, choices=choices)


def print_pages(document: Document, layout: Layout) -> bytes:
    """Return the PDF of a document whose layout is known.

    This is fast, because typst keeps its results for files that have not changed.
    """
    drawn = {_file(one): _printable(plain_svg(one.svg)).encode() for one in document.pictures()}
    pdf = typst.compile(
        _parts(layout.text, layout.choices, drawn),
        font_paths=_fonts(),
        pdf_standards=["a-2a", "ua-1"],
        timestamp=_TIMESTAMP,
        format="pdf",
    )
    assert isinstance(pdf, bytes)
    return pdf


def _parts(text: str, choices: Choices, figures: dict[str, bytes]) -> Any:
    """Return the source in several files, because typst keeps the results for unchanged files."""
    return {
        "main.typ": (TEMPLATES / "report.typ").read_bytes(),
        "document.json": text.encode(),
        "choices.json": json.dumps(asdict(choices)).encode(),
        **figures,
    }


def _file(picture: Picture) -> str:
    return f"{picture.number}.svg"


@cache
def _fonts() -> typst.Fonts:
    """Return cartlab's own fonts, so that all computers make the same pages."""
    return typst.Fonts(include_system_fonts=False, font_paths=[_font_folder()])


def _try(parts: Any) -> Pages:
    found = typst.query(parts, font_paths=_fonts(), selector="<pages>", field="value")
    (pages,) = json.loads(found)
    return Pages(**pages | {"ends": [End(**end) for end in pages["ends"]]})


def missing_characters(text: str) -> str:
    """Return the characters of a text that no font of the PDF has, separated by spaces."""
    lost = sorted(_lost(clean(text)))
    more = " …" if len(lost) > _SHOWN_IN_WARNING else ""
    return " ".join(lost[:_SHOWN_IN_WARNING]) + more


def _printable(value: Any) -> Any:
    """Return JSON in which characters that no font has are replaced.

    Otherwise these characters would become empty boxes without a warning, and the file would not be
    a valid PDF/A. A number and its unit are kept on one line, except in text quoted as typed.
    """
    if isinstance(value, str):
        lost = _lost(value)
        return "".join(_MISSING if c in lost else c for c in value) if lost else value
    if isinstance(value, dict):
        if value.get("style", "code") != "code":
            value = value | {"text": unbroken(value["text"])}
        return {key: _printable(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return value


def _lost(text: str) -> set[str]:
    if text.isascii():
        return set()
    return {c for c in set(text) if ord(c) > 127 and ord(c) not in _charset()}


@cache
def _charset() -> frozenset[int]:
    """Return the code points of DejaVu Sans, the font that is tried last for any text."""
    return frozenset(FT2Font(str(_font_folder() / "DejaVuSans.ttf")).get_charmap())


def _font_folder() -> Path:
    return Path(get_data_path()) / "fonts" / "ttf"
