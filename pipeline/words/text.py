"""Parameter names inside sentences, and text that any page can show."""

import re
import unicodedata

from markupsafe import Markup, escape

from pipeline.names import read_name
from pipeline.words.math import GREEK, symbol
from pipeline.words.numbers import listing, subscript, typeset
from pipeline.words.spans import Span, Spans

_NAME = re.compile(r"\b(?:omega|zeta|K|X|m|c|k)_(?:\d|[a-h]|[nxy])\b|\b(?:omega|zeta)\b")
_BREAK = re.compile(r"(?<=\w[._-])(?=[^\W\d])")  # "zeta_1" stays whole


def rich(text: str) -> Spans:
    """Return one of cartlab's sentences with names such as `omega_a` as mathematics."""
    text = typeset(text)
    parts: list[Span] = []
    end = 0
    for match in _NAME.finditer(text):
        parts += [Span(text[end : match.start()]), name_span(match[0])]
        end = match.end()
    return tuple(part for part in (*parts, Span(text[end:])) if part.text)


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
    """Return a sentence with parameter names replaced by symbols, as plain text."""
    return _NAME.sub(lambda match: symbol_text(match[0]), text)


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


def capital(text: str) -> str:
    """Return a phrase with a capital first letter."""
    return text[:1].upper() + text[1:]
