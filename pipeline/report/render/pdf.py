"""A document as PDF, by typst: everything goes in as JSON, so no text is ever markup."""

import json
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import typst
from matplotlib import get_data_path
from matplotlib.ft2font import FT2Font

from pipeline.report.document import Document, as_json
from pipeline.report.figures.svg import plain_svg
from pipeline.report.render.room import Choices, End, Pages, fill_pages
from pipeline.resources import TEMPLATES
from pipeline.words.numbers import unbroken
from pipeline.words.text import clean

_TIMESTAMP = 0  # archival PDF wants a date; a real one would make two reports differ
_MISSING = "□"  # stands for a character that no font has
_SHOWN_IN_WARNING = 20


def render_pdf(document: Document) -> bytes:
    """Return the PDF (archival A-2a, accessible UA-1), with its own fonts only."""
    data = _printable(as_json(document))
    text = json.dumps(data, ensure_ascii=False, allow_nan=False)
    choices = fill_pages(lambda choices: _lay_out(text, choices))
    pdf = typst.compile(
        **_source(text, choices),
        pdf_standards=["a-2a", "ua-1"],
        timestamp=_TIMESTAMP,
        format="pdf",
    )
    assert isinstance(pdf, bytes)
    return pdf


def _source(text: str, choices: Choices) -> dict[str, Any]:
    """Return what is compiled, a part a file: typst remembers what follows from each alone."""
    parts = {
        "main.typ": (TEMPLATES / "report.typ").read_bytes(),
        "document.json": text.encode(),
        "choices.json": json.dumps(asdict(choices)).encode(),
    }
    # Without fonts of the system, as another machine must give the same pages.
    return {"input": parts, "font_paths": [_font_folder()], "ignore_system_fonts": True}


def _lay_out(text: str, choices: Choices) -> Pages:
    found = typst.query(**_source(text, choices), selector="<pages>", field="value")
    (pages,) = json.loads(found)
    return Pages(**pages | {"ends": [End(**end) for end in pages["ends"]]})


def missing_characters(text: str) -> str:
    """Return the characters of a text that no font of the PDF has (Chinese, emoji), apart."""
    lost = sorted(_lost(clean(text)))
    more = " …" if len(lost) > _SHOWN_IN_WARNING else ""
    return " ".join(lost[:_SHOWN_IN_WARNING]) + more


def _printable(value: Any) -> Any:
    """Return JSON with the characters that no font has replaced, and drawings without data.

    Numbers keep to their units, but in what is quoted as it is typed.

    Left as they are they would become empty boxes without a word, and the file no valid PDF/A.
    """
    if isinstance(value, str):
        lost = _lost(value)
        return "".join(_MISSING if c in lost else c for c in value) if lost else value
    if isinstance(value, dict):
        if value.get("style", "code") != "code":
            value = value | {"text": unbroken(value["text"])}
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
