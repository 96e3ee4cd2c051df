"""Pages are filled by trying several layouts and keeping the best one."""

from collections.abc import Callable

import pytest

from pipeline.report.render.page_filling import Choices, End, Pages, fill_pages

TOP, BOTTOM = 50.0, 750.0


def figures(*heights: float) -> Callable[[Choices], Pages]:
    """Return a function that lays out figures with these heights, one below the other."""

    def lay_out(choices: Choices) -> Pages:
        ends, page, y = [], 1, TOP
        for number, height in enumerate(heights, start=1):
            share = choices.shares.get(number, 1.0)
            if y + share * height > BOTTOM:
                page, y = page + 1, TOP
            y += share * height
            end = End(page=page, y=y, picture=number, share=share, height=share * height)
            ends.append(end)
        return Pages(ends=ends, top=TOP, bottom=BOTTOM)

    return lay_out


def test_a_figure_that_nearly_fits_is_drawn_smaller():
    """If a figure nearly fits, it and the figure above it are drawn smaller by the same factor."""
    shares = fill_pages(figures(400.0, 350.0, 100.0)).shares
    assert shares == {1: shares[1], 2: shares[1]}
    assert (BOTTOM - TOP) * 0.9 < shares[1] * 750.0 <= BOTTOM - TOP


@pytest.mark.parametrize(
    "heights",
    [
        (400.0, 600.0, 100.0),  # too small to read if it should fit
        (600.0, 600.0),  # full pages
        (),
    ],
)
def test_other_pages_are_left_as_they_are(heights):
    """Full pages, and figures that would become too small to read, stay as they are."""
    assert fill_pages(figures(*heights)) == Choices()


def test_a_table_stays_whole_if_this_saves_white_space():
    """A table is kept on one page if less white space remains that way."""

    def lay_out(choices: Choices) -> Pages:
        begun = 2 if choices.whole == (7,) else 1
        ends = [
            End(page=1, y=BOTTOM - 150.0),
            End(page=begun, y=TOP + 20.0, table=7),
            End(page=2, y=TOP + 250.0 * begun, table=7),
            End(page=3, y=BOTTOM, picture=1, height=700.0),
        ]
        return Pages(ends=ends, top=TOP, bottom=BOTTOM)

    assert fill_pages(lay_out) == Choices(whole=(7,))
