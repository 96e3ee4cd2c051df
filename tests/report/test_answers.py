"""An answer in `notes.md` is found under its question's id; writing it changes nothing else."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.errors import SubmissionError
from pipeline.report.sections.notes import (
    discussion_blocks,
    with_answer,
    with_discussion,
    written_answer,
    written_discussion,
)
from pipeline.report.sections.questions import Asked, split_notes

NOTES = """\
<!-- keep
## zeta_b
me -->
# Discussion

All is well.

## Question **friction-2**: why?

Because.

### In detail

```
# no heading
```

## Outlook

More.
"""


def test_an_answer_is_the_text_under_its_heading():
    """An answer includes code and smaller headings under its heading, but no comment."""
    assert written_answer(NOTES, "friction-2").startswith("Because.\n\n### In detail")
    assert written_answer(NOTES, "friction-2").endswith("# no heading\n```")
    assert written_answer(NOTES, "zeta_b") == ""


def test_an_answer_can_be_replaced_added_and_removed():
    """An answer can be replaced, added and removed; all other lines stay as they are."""
    new = with_answer(NOTES, "friction-2", "Dry bearings.\r\n")
    assert written_answer(new, "friction-2") == "Dry bearings."
    assert new.splitlines()[:9] == NOTES.splitlines()[:9]
    assert new.endswith("Dry bearings.\n\n## Outlook\n\nMore.\n")
    assert "friction" not in with_answer(new, "friction-2", "")
    assert with_answer("", "level", "So.") == "## level\n\nSo.\n"
    assert with_answer(NOTES, "level", "") == NOTES


def test_a_heading_that_would_end_the_answer_is_refused():
    """An answer is refused if it contains a heading of the same or a higher level than its own."""
    with pytest.raises(SubmissionError, match="###"):
        with_answer(NOTES, "level", "So.\n\n# Aha\n\nMore.")
    assert "### Aha" in with_answer(NOTES, "level", "So.\n\n### Aha\n\nMore.")


OPEN = ["```\ncode", "~~~", "So <!-- why", "```\n<!-- x\n```", "So.\n\n### outlook\n\nMine."]


@pytest.mark.parametrize("text", OPEN)
def test_an_answer_that_would_hide_another_is_refused(text):
    """An answer with an unclosed comment or code block is refused.

    Otherwise it would hide the next answer.
    """
    with pytest.raises(SubmissionError, match="close every"):
        with_answer(NOTES, "friction-2", text)
    for closed in ("```\n# code\n```", "So <!-- why --> it is.", "### In detail\n\nMore."):
        assert written_answer(with_answer(NOTES, "friction-2", closed), "friction-2") == closed
    with pytest.raises(SubmissionError, match="close every"):  # a code block is open
        with_answer("## zeta_b\n\n```\ncode", "level", "So.")
    with pytest.raises(SubmissionError, match="close every"):  # it would contain the next answer
        with_answer(NOTES, "level", "So.\n```")


WORDS = st.text(st.characters(codec="utf-8", exclude_categories=["C"]), max_size=30)


@given(st.lists(WORDS, max_size=6), WORDS.filter(str.strip), st.integers(0, 6))
def test_an_answer_is_read_back_unchanged(lines, answer, at):
    """Whatever text surrounds it, an answer without headings is read back unchanged."""
    notes = "\n\n".join([*lines[:at], "## zeta_b", *lines[at:]])
    try:
        new = with_answer(notes, "level", answer)
    except SubmissionError:
        return
    asked = [Asked(kind="level", id="level", section="x", text="")]
    assert bool(split_notes(discussion_blocks(new), asked)[0]) == bool(discussion_blocks(answer))
    assert written_answer(new, "level") == answer.strip()


@given(
    st.lists(st.sampled_from(["zeta_b", "x", "level"]) | WORDS, max_size=6),
    st.lists(
        WORDS | st.sampled_from(["# x", "```", "### y", "<!--", "$$", "## level"]), max_size=4
    ),
)
def test_a_discussion_is_read_back_unchanged(parts, typed):
    """A discussion is refused, or read back unchanged beside unchanged answers."""
    notes = "\n\n".join(f"## {one}\n\nabout {one}" if one.isascii() else one for one in parts)
    ids, discussion = ("level", "zeta_b"), "\n\n".join(typed)
    try:
        new = with_discussion(notes, ids, discussion)
    except SubmissionError:
        return
    assert written_discussion(new, ids) == discussion.strip()
    assert [written_answer(new, id_) for id_ in ids] == [written_answer(notes, id_) for id_ in ids]
    assert with_discussion(new, ids, discussion) == new


def test_a_discussion_stands_before_the_answers():
    """The discussion is all that answers no question; it is written before the answers."""
    ids = ("zeta_b", "friction-2")
    rest = written_discussion(NOTES, ids)
    assert rest.startswith("<!-- keep\n## zeta_b")
    assert "friction-2" not in rest
    assert rest.endswith("## Outlook\n\nMore.")
    new = with_discussion(NOTES, ids, "All is new.")
    assert new.startswith("All is new.\n\n## Question **friction-2**: why?\n\nBecause.")
    assert with_discussion("", ids, "") == ""
    for text in ("## zeta_b\n\nSo.", "```\nopen", "<!-- open"):
        with pytest.raises(SubmissionError):
            with_discussion(NOTES, ids, text)
