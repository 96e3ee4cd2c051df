"""The sentences that an instructor may edit: found by key, with values and markup."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.resources import TEMPLATES
from pipeline.words.phrases import Phrases
from pipeline.words.text import Span, plain
from tests.helpers.places import ROOT

PIPELINE = ROOT / "pipeline"


def catalogues() -> Iterator[Phrases]:
    """Yield the sentences of every file, or of each table if it has tables."""
    for path in sorted((TEMPLATES / "words").glob("*.toml")):
        found = tomllib.loads(path.read_text(encoding="utf-8"))
        tables = [key for key, value in found.items() if isinstance(value, dict)]
        yield from (Phrases(path, table) for table in tables or [""])


def written(folder: Path, text: str) -> Phrases:
    """Return the sentences of a catalogue after an edit."""
    path = folder / "gap.toml"
    path.write_text(text + "\n", encoding="utf-8")
    return Phrases(path)


@pytest.fixture(scope="module")
def modules() -> list[tuple[str, set[str]]]:
    """Return each module of the package as text, with the strings in it."""
    texts = [path.read_text(encoding="utf-8") for path in PIPELINE.rglob("*.py")]
    return [
        (text, {n.value for n in ast.walk(ast.parse(text))
                if isinstance(n, ast.Constant) and isinstance(n.value, str)})
        for text in texts
    ]  # fmt: skip


@pytest.mark.parametrize(
    "words", list(catalogues()), ids=lambda words: words.path.stem + words.table
)
def test_every_sentence_is_used(words, modules):
    """Every sentence of a catalogue is used by some module."""
    asking = (f'"{words.path.stem}"', "WORDS", "say(", "words: Phrases", "advice_keys=(")
    strings: set[str] = set()
    parts: set[str] = set()  # keys that are put together, as in f"title_{verdict}"
    for text, found in modules:
        strings |= found
        parts |= found if any(word in text for word in asking) else set()
    built = tuple(s for s in parts if s.endswith("_"))
    built_ends = tuple(s for s in parts if s.startswith("_"))
    for key in words.by_key:
        is_used = key in strings or key.startswith(built) or key.endswith(built_ends)
        assert is_used or key in ("bode_fit", "time_fit"), key  # names of fit methods


def test_values_in_a_sentence_are_never_markup(tmp_path):
    """Bold text, code and links come from a sentence, and never from a value put into it."""
    words = written(tmp_path, 'a = "**Yes: **{name}, see `f` under [here](#x)."')
    assert words.spans("a", name="**no** [b](#y)") == (
        Span("Yes: ", "strong"),
        Span("**no** [b](#y), see "),
        Span("f", "code"),
        Span(" under "),
        Span("here", url="#x"),
        Span("."),
    )
    assert words.text("a", name=3).startswith("**Yes: **3,")
    name = (Span("K", "em"),)
    assert words.spans("a", name=name)[1:3] == (Span("K", "em"), Span(", see "))


def test_a_value_that_is_a_question_ends_its_sentence(tmp_path):
    """No full stop follows the question mark of a value at the end of a sentence."""
    catalogue = written(tmp_path, 'odd = "{what} is **odd: **{why}."')
    said = {"why": "is it another?", "what": "a?.b"}
    assert catalogue.text("odd", **said).endswith("is it another?")
    assert plain(catalogue.spans("odd", **said)) == "a?.b is odd: is it another?"
    assert catalogue.text("odd", what="it", why="so").endswith("so.")


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('a = "off by {shaer}"', "gap.toml: a names {shaer}; it may name {cart}, {share}"),
        (
            'b = "off by {share}"',
            "gap.toml: the sentence a is missing; it may name {cart}, {share}",
        ),
        ("a = 3", "gap.toml: a needs a sentence in quotes, found 3"),
        ('b = "x"\na = "off by {share}', "gap.toml line 2"),
    ],
)
def test_a_mistake_in_a_sentence_is_reported_in_one_line(tmp_path, text, named):
    """A mistake in a sentence gives one line with the file, the key and the allowed values."""
    words = written(tmp_path, text)
    for say in (words.text, words.spans):
        with pytest.raises(ConfigError) as error:
            say("a", share="3 %", cart="1")
        assert named in str(error.value)
        assert "\n" not in str(error.value)
