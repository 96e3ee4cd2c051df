"""Sentences that an instructor may edit or translate: `templates/words/SUBJECT.toml`, by key.

A sentence has its values in braces and marks **strong** words, `code` and [links](#here). Code
chooses the sentence and passes the values as text, which is never read as markup. A file is read
when its first sentence is needed. Only then are mistakes in it reported.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.resources import TEMPLATES
from pipeline.submission.toml import parse_toml, read_text
from pipeline.words.text import Span, Spans

_MARK = re.compile(r"\*\*(?P<strong>.+?)\*\*|`(?P<code>.+?)`|\[(?P<link>.+?)\]\((?P<url>#.+?)\)")
_VALUE = re.compile(r"\{(\w+)\}")
_ASKED = re.compile(r"\?\.(?=\s|$)")  # the sentence's full stop after a value that is a question
_LARGEST = 1_000_000  # largest file in bytes


@dataclass(frozen=True)
class Phrases:
    """The sentences of one file, or of one of its tables; a `ConfigError` reports a mistake."""

    path: Path
    table: str = ""

    @cached_property
    def by_key(self) -> Mapping[str, str]:
        """The sentences of the file or the table, by key."""
        where = self._where()
        text = read_text(self.path, where=where, limit=_LARGEST, error=ConfigError)
        found = parse_toml(text, where=where, error=ConfigError)
        found = found.get(self.table) if self.table else found
        if not isinstance(found, dict):
            raise ConfigError(f"{where}: needs a table [{self.table}]; add it")
        for key, sentence in found.items():
            if not isinstance(sentence, str):
                raise ConfigError(f"{where}: {key} needs a sentence in quotes, found {sentence!r}")
        return found

    def text(self, key: str, **values: object) -> str:
        """Return a sentence without marks, with its values filled in."""
        return _filled_in(self._template(key, values), values)

    def cells(self, key: str, **values: object) -> list[str]:
        """Return the headings of a table, which the file separates by bars."""
        template = self._template(key, values)
        return [_filled_in(part, values) for part in template.split(" | ")]

    def spans(self, key: str, **values: str | Spans) -> Spans:
        """Return a sentence as formatted spans; its values may be formatted too."""
        return tuple(span for span in _spans(self._template(key, values), values) if span.text)

    def _template(self, key: str, values: Mapping[str, object]) -> str:
        """Return a sentence, after checking that it uses only the given values."""
        known = f"it may name {', '.join(f'{{{v}}}' for v in sorted(values)) or 'no values'}"
        if key not in self.by_key:
            raise ConfigError(f"{self._where()}: the sentence {key} is missing; {known}")
        template = self.by_key[key]
        for name in _VALUE.findall(template):
            if name not in values:
                raise ConfigError(f"{self._where()}: {key} names {{{name}}}; {known}")
        return template

    def _where(self) -> str:
        return f"templates/words/{self.path.name}"


def phrases(subject: str, table: str = "") -> Phrases:
    """Return the sentences of a subject, or of one table of its file."""
    return Phrases(TEMPLATES / "words" / f"{subject}.toml", table)


def _filled_in(template: str, values: Mapping[str, object]) -> str:
    return _ASKED.sub("?", _VALUE.sub(lambda name: str(values[name[1]]), template))


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
    """Yield a text with its values, in the style of `like`; values with marks keep theirs."""
    said = ""
    for i, part in enumerate(_VALUE.split(text)):
        value = values[part] if i % 2 else part
        if isinstance(value, str):
            said += value
        else:
            yield replace(like, text=_ASKED.sub("?", said))
            yield from value
            said = ""
    yield replace(like, text=_ASKED.sub("?", said))
