"""Sentences that an instructor may edit or translate: `templates/words/SUBJECT.toml`, by key.

A sentence names the values it takes in braces, marks **strong** words, `code` and [links](#here).
Code decides which sentence is said and passes the values, already written as text; what stands in
a value is never markup.
"""

import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache

from pipeline.report.document import Span, Spans
from pipeline.resources import TEMPLATES

_MARK = re.compile(r"\*\*(?P<strong>.+?)\*\*|`(?P<code>.+?)`|\[(?P<link>.+?)\]\((?P<url>#.+?)\)")
_VALUE = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True)
class Phrases:
    """The sentences of one subject."""

    by_key: Mapping[str, str]

    def text(self, key: str, **values: object) -> str:
        """Return a sentence without marks, its values put in."""
        return _VALUE.sub(lambda name: str(values[name[1]]), self.by_key[key])

    def spans(self, key: str, **values: str | Spans) -> Spans:
        """Return a sentence with its marks; values may be marked as well."""
        return tuple(span for span in _spans(self.by_key[key], values) if span.text)


@cache
def phrases(subject: str) -> Phrases:
    """Return the sentences of a subject."""
    path = TEMPLATES / "words" / f"{subject}.toml"
    return Phrases(tomllib.loads(path.read_text(encoding="utf-8")))


def _spans(template: str, values: Mapping[str, str | Spans]) -> Iterator[Span]:
    end = 0
    for mark in _MARK.finditer(template):
        yield from _filled(template[end : mark.start()], Span(""), values)
        if mark["strong"]:
            yield from _filled(mark["strong"], Span("", "strong"), values)
        elif mark["code"]:
            yield from _filled(mark["code"], Span("", "code"), values)
        else:
            yield from _filled(mark["link"], Span("", url=mark["url"]), values)
        end = mark.end()
    yield from _filled(template[end:], Span(""), values)


def _filled(text: str, like: Span, values: Mapping[str, str | Spans]) -> Iterator[Span]:
    """Yield the text in the style of a span; text values join it, marked ones stand alone."""
    said = ""
    for i, part in enumerate(_VALUE.split(text)):
        value = values[part] if i % 2 else part
        if isinstance(value, str):
            said += value
        else:
            yield replace(like, text=said)
            yield from value
            said = ""
    yield replace(like, text=said)
