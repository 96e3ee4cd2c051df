"""Text with marks: strong words, links and inline mathematics."""

from dataclasses import dataclass
from typing import Literal

from pipeline.words.math import Term


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
