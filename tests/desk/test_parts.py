"""A browser that keeps the parts it has shows the same page as one that gets the whole page."""

import re
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.desk.parts import leave_out_parts

WORDS = st.sampled_from(["", "a", "b"])


def write(tree: tuple, ids: Iterator[int]) -> str:
    """Return a part as a template writes it: its words, then the parts in it."""
    words, children = tree
    inner = "".join(write(child, ids) for child in children)
    seen = f'<input name="seen" value="{words}0">'
    return f'<!--part--><div class="k" id="p{next(ids)}">{seen}{words}{inner}</div><!--/part-->'


def page(*trees: tuple) -> str:
    """Return a page with some parts."""
    ids = iter(range(10_000))
    return f"<main>{''.join(write(tree, ids) for tree in trees)}</main>"


def known(shown: str) -> str:
    """Return the parts of a page as the browser lists them."""
    found = re.findall(r'data-part="(\w+)" class="k" id="(\w+)"', shown)
    return " ".join(f"{id_}={digest}" for digest, id_ in found)


def keep(answer: str, shown: str) -> str:
    """Return the page that a browser shows after an answer: what it has takes its old place."""
    while kept := re.search(r'<div id="(\w+)" data-part="\w+" hx-preserve></div>', answer):
        start = re.search(rf'<div data-part="\w+" class="k" id="{kept[1]}">', shown)
        assert start
        depth, end = 1, start.end()
        while depth:
            tag = re.compile(r"</?div").search(shown, end)
            assert tag
            depth, end = depth + (-1 if tag[0] == "</div" else 1), tag.end()
        answer = answer.replace(kept[0], f"{shown[start.start() : end]}>", 1)
    return answer


TREES = st.recursive(
    st.tuples(WORDS, st.just(())),
    lambda inner: st.tuples(WORDS, st.lists(inner, max_size=3)),
    max_leaves=8,
)


@given(st.lists(TREES, max_size=3), st.lists(TREES, max_size=3))
def test_kept_parts_and_an_answer_make_the_whole_page(before, after):
    """Whatever changed, the answer and the kept parts make the page that is sent without htmx."""
    shown, whole = (leave_out_parts(page(*trees), "") for trees in (before, after))
    assert "<!--" not in whole
    seen = re.compile(r'value="\w*"')  # the browser replaces it
    assert seen.sub("", keep(leave_out_parts(page(*after), known(shown)), shown)) == seen.sub(
        "", whole
    )


def test_an_unchanged_part_is_sent_empty_and_a_changed_one_whole():
    """Only the changed inner part, and what surrounds it, is sent again."""
    row, other = ("long" * 100, ()), ("other" * 100, ())
    shown = leave_out_parts(page(("", (row, other))), "")
    answer = leave_out_parts(page(("", (row, ("new", ())))), known(shown))
    assert "long" not in answer
    assert "new" in answer
    assert len(leave_out_parts(page(("", (row, other))), known(shown))) < 100
    with pytest.raises(ValueError, match="with an id"):
        leave_out_parts("<!--part--><p>no id</p><!--/part-->", "")
