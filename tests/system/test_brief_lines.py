"""The summary that `cartlab report` prints fits a terminal."""

import pytest

from pipeline.cli.common import brief_lines

ITEMS = [f"- Item {i} is odd. {'It has details. ' * 12}" for i in range(9)]
LONG = "\n".join(["A model was found. " * 3, *ITEMS, "Next:", *ITEMS])


@pytest.mark.parametrize("width", [40, 80, 200])
@pytest.mark.parametrize("items", [0, 1, 4, 9])
def test_a_summary_never_has_more_lines_than_allowed(width, items):
    """Each line fits the width, and the first and the last item of each list are shown."""
    text = "\n".join(["A model was found. " * 3, *ITEMS[:items], "Next:", *ITEMS[:items]])
    lines = brief_lines(text, width=width, most=12, more="the page")
    assert len(lines) <= 12
    assert max(map(len, lines)) <= width
    if items:
        assert sum(line.startswith(f"- Item {items - 1} ") for line in lines) == 2


def test_a_short_summary_is_shown_whole():
    """A summary that fits is only wrapped, and no name or number is broken."""
    text = "It has K_1 = 1.0 → 2.0; K_2 = 3.0 → 4.0.\n- See data/a-very-long-name-of-a-file.csv."
    lines = brief_lines(text, width=20, most=12, more="the page")
    assert " ".join(" ".join(lines).split()) == " ".join(text.split())
    assert any("K_2 = 3.0 → 4.0." in line for line in lines)
    assert any("data/a-very-long-name-of-a-file.csv." in line for line in lines)


def test_what_is_left_out_is_counted():
    """The last line says how many items are left out, and where they are."""
    lines = brief_lines(LONG, width=80, most=12, more="the page")
    left = 18 - sum(line.startswith("- Item") for line in lines)
    assert lines[-1] == f"- {left} more: see the page"
