"""The check of English finds crooked sentences wherever a person may read them."""

import runpy
from pathlib import Path

import pytest

CHECK = runpy.run_path(str(Path(__file__).parents[2] / ".ci" / "prose.py"))
ODD = "The runs are" + " to be looked" + " at."  # split, so that this file has no odd sentence


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("page.md", f"A page.\n\n{ODD}\n"),
        ("page.html.j2", f"<p>{{{{ name }}}} A page.</p>\n<p>{ODD}</p>\n"),
        ("words.toml", f'say = "{ODD}"\n'),
        ("docstring.py", f'"""A module. {ODD}"""\n'),
        ("comment.py", f"x = 1\n# A comment. {ODD}\n"),
        ("message.py", f'x = f"{{1}} A message. {ODD}"\n'),
    ],
)
def test_an_odd_sentence_is_found_once(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    (find,) = CHECK["finds"](tmp_path / name)
    assert ODD in find.sentence


def test_code_is_not_checked(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"Say `{ODD}` so.\n\n```\n{ODD}\n```\n", encoding="utf-8")
    assert list(CHECK["finds"](page)) == []


def test_a_text_is_split_into_sentences() -> None:
    words = CHECK["LONGEST"]
    assert len(CHECK["sentences"]("Word " * words + "end. Two.")) == 2
