"""Text that any page can show: marked words, and parameter names in sentences."""

import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from markupsafe import Markup, escape

from pipeline.names import read_name
from pipeline.words.math import GREEK, Term, symbol
from pipeline.words.numbers import listing, subscript, typeset

# ---------------------------------------------------- strong words, links and inline mathematics


@dataclass(frozen=True)
class Span:
    """A piece of text in one style, a link, or inline mathematics.

    Links from students are http, https or mailto. cartlab's own links may also lead to a place on
    the page or to a file next to it.
    """

    text: str
    style: Literal["plain", "strong", "em", "code"] = "plain"
    url: str = ""
    math: Term | None = None


Spans = tuple[Span, ...]


def spans(*parts: str | Span | Spans) -> Spans:
    """Join strings, spans and tuples of spans."""
    joined: list[Span] = []
    for part in parts:
        if isinstance(part, str):
            joined.append(Span(part))
        elif isinstance(part, Span):
            joined.append(part)
        else:
            joined.extend(part)
    return tuple(joined)


def plain(text: Spans) -> str:
    """Return only the text, for titles, alt texts and attributes."""
    return "".join(span.text for span in text)


# -------------------------------------------------------------- parameter names inside sentences

_NAME = re.compile(r"\b(?:omega|zeta|K|X|m|c|k)_(?:\d|[a-h]|[nxy])\b|\b(?:omega|zeta)\b")
# What a file contains or should contain: "write omega_a = 10.1", 'omega_1', reported.final.omega_1,
# leave_out = ["step-1"].
_CODE = re.compile(
    r"((?<=write |found )[\w-]+ [=:] [-+,.\w]*\w|'[^'\s]+'|\breported\.[\w.]*\w|\w+ = \[[^\]]*\])"
)
_BREAK = re.compile(r"(?<=\w[._-])(?=[^\W\d])")  # "zeta_1" stays whole


def rich(text: str) -> Spans:
    """Return one of cartlab's sentences with names such as `omega_a` as mathematics.

    Quotations from a file stay as they are typed; a line with a list is code, so that it can be
    copied.
    """
    parts: list[Span] = []
    for i, piece in enumerate(_CODE.split(text)):
        quoted = Span(piece, style="code" if piece.endswith("]") else "plain")
        parts += [quoted] if i % 2 else _with_math(typeset(piece))
    return tuple(part for part in parts if part.text)


def _with_math(text: str) -> Iterator[Span]:
    end = 0
    for match in _NAME.finditer(text):
        yield Span(text[end : match.start()])
        yield name_span(match[0])
        end = match.end()
    yield Span(text[end:])


def name_span(name: str) -> Span:
    """Return one parameter name as mathematics, with its plain form as text."""
    read = read_name(name)
    plain = GREEK.get(read.symbol, read.symbol) + (f"_{read.suffix}" if read.suffix else "")
    return Span(plain, math=symbol(name))


def symbol_text(name: str) -> str:
    """Return a parameter's symbol as plain text, such as "ζ₁" if Unicode has the index."""
    read, text = read_name(name), name_span(name).text
    return text if read.cart is None else text.removesuffix(f"_{read.cart}") + subscript(read.cart)


def with_symbols(text: str) -> str:
    """Return a sentence with parameter names replaced by symbols, as plain text; see `rich`."""
    pieces = _CODE.split(text)
    pieces[::2] = [_NAME.sub(lambda match: symbol_text(match[0]), piece) for piece in pieces[::2]]
    return "".join(pieces)


def names_spans(names: list[str]) -> Spans:
    """Return "K_1, K_2 and omega_a" with the names as mathematics."""
    return rich(listing(names))


def clean(text: str) -> str:
    """Return text without control and unassigned characters, which no page can show."""
    return "".join(
        c if c in "\n\t" or unicodedata.category(c)[0] != "C" else "�"
        for c in text.replace("\r\n", "\n")
    )


def breakable(name: str) -> Markup:
    """Return a name as HTML that a narrow column breaks only after a dot, "_" or "-"."""
    return Markup(_BREAK.sub("<wbr>", str(escape(name))))


def sentence(text: str) -> str:
    """Return a text with a full stop, unless it already ends a sentence."""
    return text if text.endswith((".", "?", "!")) else f"{text}."


def capital(text: str) -> str:
    """Return a phrase with a capital first letter."""
    return text[:1].upper() + text[1:]
