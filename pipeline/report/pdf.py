"""Render a document as PDF with typst; all content goes in as JSON, so no text is markup."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import typst
from matplotlib import get_data_path
from matplotlib.ft2font import FT2Font

from pipeline.report.document import Document, as_json
from pipeline.resources import TEMPLATES
from pipeline.words.numbers import unbroken
from pipeline.words.text import clean

_TIMESTAMP = 0  # archival PDF needs a date; the real one would make two reports differ
_MISSING = "□"  # replaces a character that no font has
_SHOWN_IN_WARNING = 20


def render_pdf(document: Document) -> bytes:
    """Return the PDF (archival A-2a, accessible UA-1), which uses only the fonts of cartlab."""
    document = replace(document, sections=tuple(s for s in document.sections if s.in_print))
    text = json.dumps(_printable(as_json(document)), ensure_ascii=False, allow_nan=False)
    figures = {f"{one.number}.svg": _printable(one.svg).encode() for one in document.pictures()}
    parts: Any = {
        "main.typ": (TEMPLATES / "report.typ").read_bytes(),
        "document.json": text.encode(),
        **figures,
    }
    pdf = typst.compile(
        parts,
        font_paths=_fonts(),
        pdf_standards=["a-2a", "ua-1"],
        timestamp=_TIMESTAMP,
        format="pdf",
    )
    assert isinstance(pdf, bytes)
    return pdf


@cache
def _fonts() -> typst.Fonts:
    """Return cartlab's own fonts, so that all computers make the same pages."""
    return typst.Fonts(include_system_fonts=False, font_paths=[_font_folder()])


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
