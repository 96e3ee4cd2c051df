"""The sentences that an instructor may edit: found by key, values put in, marks set."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

from pipeline.report.document import Span
from pipeline.report.phrases import Phrases, phrases
from pipeline.resources import TEMPLATES

REPORT = Path(__file__).parents[1] / "pipeline" / "report"
SUBJECTS = sorted(path.stem for path in (TEMPLATES / "words").glob("*.toml"))


@pytest.mark.parametrize("subject", SUBJECTS)
def test_every_sentence_is_said_somewhere(subject):
    """A catalogue holds no sentence that nothing asks for, and each names its values once known."""
    users = [p.read_text(encoding="utf-8") for p in REPORT.rglob("*.py")]
    users = [text for text in users if f'"{subject}"' in text or "WORDS" in text]
    strings = {
        node.value
        for text in users
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    built = tuple(s for s in strings if s.endswith("_"))  # as in f"title_{verdict}"
    built_ends = tuple(s for s in strings if s.startswith("_"))
    for key in phrases(subject).by_key:
        said = key in strings or key.startswith(built) or key.endswith(built_ends)
        assert said or key in ("bode_fit", "time_fit"), key  # the fit's own name


def test_marks_are_set_and_values_are_never_markup():
    """Strong, code and links come from the sentence alone."""
    words = Phrases({"a": "**Yes: **{name}, see `f` under [here](#x)."})
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


@pytest.mark.parametrize("subject", SUBJECTS)
def test_a_catalogue_is_plain_toml(subject):
    """One table of strings, whose braces are values or stand apart."""
    found = tomllib.loads((TEMPLATES / "words" / f"{subject}.toml").read_text(encoding="utf-8"))
    for key, text in found.items():
        assert isinstance(text, str), key
        assert re.sub(r"\{\w+\}|\{ [^{}]* \}", "", text).count("{") == 0, key
