"""A document as PDF, by typst: everything goes in as JSON, so no text is ever markup."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import typst
from matplotlib import get_data_path
from matplotlib.ft2font import FT2Font

from pipeline.report.document import Document, as_json
from pipeline.report.figures.svg import plain_svg
from pipeline.report.words import clean
from pipeline.resources import TEMPLATES

_TIMESTAMP = 0  # archival PDF wants a date; a real one would make two reports differ
_MISSING = "□"  # stands for a character that no font has
_SHOWN_IN_WARNING = 20


def render_pdf(document: Document) -> bytes:
    """Return the PDF (archival A-2a, accessible UA-1), with its own fonts only."""
    data = _printable(as_json(document))
    pdf = typst.compile(
        TEMPLATES / "report.typ",
        root=TEMPLATES,
        font_paths=[_font_folder()],
        ignore_system_fonts=True,  # another machine must give the same pages
        sys_inputs={"document": json.dumps(data, ensure_ascii=False, allow_nan=False)},
        pdf_standards=["a-2a", "ua-1"],
        timestamp=_TIMESTAMP,
        format="pdf",
    )
    assert isinstance(pdf, bytes)
    return pdf


def missing_characters(text: str) -> str:
    """Return the characters of a text that no font of the PDF has (Chinese, emoji), apart."""
    lost = sorted(_lost(clean(text)))
    more = " …" if len(lost) > _SHOWN_IN_WARNING else ""
    return " ".join(lost[:_SHOWN_IN_WARNING]) + more


def _printable(value: Any) -> Any:
    """Return JSON with the characters that no font has replaced, and drawings without data.

    Left as they are they would become empty boxes without a word, and the file no valid PDF/A.
    """
    if isinstance(value, str):
        lost = _lost(value)
        return "".join(_MISSING if c in lost else c for c in value) if lost else value
    if isinstance(value, dict):
        return {
            key: _printable(plain_svg(item) if key == "svg" else item)
            for key, item in value.items()
        }
    if isinstance(value, list):
        return [_printable(item) for item in value]
    return value


def _lost(text: str) -> set[str]:
    if text.isascii():
        return set()
    return {c for c in set(text) if ord(c) > 127 and ord(c) not in _charset()}


@cache
def _charset() -> frozenset[int]:
    """Return the code points of DejaVu Sans, the last font that all text falls back to."""
    return frozenset(FT2Font(str(_font_folder() / "DejaVuSans.ttf")).get_charmap())


def _font_folder() -> Path:
    return Path(get_data_path()) / "fonts" / "ttf"
