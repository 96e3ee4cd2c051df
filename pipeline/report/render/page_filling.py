"""Fill the pages of a PDF.

A block that does not fit on a page moves to the next one and leaves white space. If there is much
of it, two things are tried: drawing the figures of the page and the next one a little smaller, or
keeping a broken table whole. The version with less white space is used.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

_GAP = 28.0  # points between the end of a block and a block that follows it
_WHITE = 0.3  # share of a page; less white space is accepted
_LEAST = 0.75  # smallest scale of a figure; its labels are then still 6 points high
_MOST_TRIES = 8  # most layouts tried; each takes a quarter of the time of the first one


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Changes to the default layout.

    Attributes
    ----------
    shares : scale of each changed figure, by the figure's number.
    whole : numbers of the tables that must not break across pages.
    """

    shares: Mapping[int, float] = field(default_factory=dict)
    whole: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class End:
    """The end of a block.

    Attributes
    ----------
    page : number of the page on which the block ends.
    y : distance from the top of the page, in points.
    picture, table : number of the figure or table, 0 for any other block. A table has a second
        `End` for its caption.
    share : scale of a figure, 1 by default.
    height : height of a figure, in points.
    """

    page: int
    y: float
    picture: int = 0
    table: int = 0
    share: float = 1.0
    height: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Pages:
    """The layout of a document.

    Attributes
    ----------
    ends : ends of the blocks of the document.
    top, bottom : limits of the text on every page, in points.
    """

    ends: Sequence[End]
    top: float
    bottom: float

    @property
    def count(self) -> int:
        """The number of pages."""
        return max((end.page for end in self.ends), default=0)

    def white_under(self, page: int) -> float:
        """Return the share of a page that is empty at the bottom.

        It counts as 0 for the last page, and where a table continues on the next page.
        """
        lowest = max((end.y for end in self.ends if end.page == page), default=self.bottom)
        if page >= self.count or page in self.broken.values():
            return 0.0
        return (self.bottom - lowest) / (self.bottom - self.top)

    @property
    def broken(self) -> dict[int, int]:
        """The tables that continue on another page, each with its first page."""
        first = {end.table: end.page for end in reversed(self.ends) if end.table}
        last = {end.table: end.page for end in self.ends if end.table}
        return {table: page for table, page in first.items() if page < last[table]}

    def white(self, last: int) -> float:
        """Return a penalty for white space on pages 1 to `last`.

        It is quadratic: one page with much white space counts more than two with half as much.
        """
        pages = range(1, last + 1)
        return sum(max(self.white_under(page) - _WHITE, 0.0) ** 2 for page in pages)


def fill_pages(lay_out: Callable[[Choices], Pages]) -> Choices:
    """Return the changes to the layout that leave the least white space.

    Pages are filled from first to last. A change may leave white space on a later page, which is
    filled when its turn comes. In the end, the best of all layouts is returned.

    Parameters
    ----------
    lay_out : function that returns the layout of the document with the given changes.
    """
    chosen = best = Choices()
    pages = lay_out(chosen)
    least = pages.white(pages.count)
    page = tries = 0
    while least and tries < _MOST_TRIES and (page := page + 1) < pages.count:
        if pages.white_under(page) <= _WHITE:
            continue
        for choices in _remedies(pages, page, chosen):
            tries += 1
            tried = lay_out(choices)
            if tried.white(page) < pages.white(page):
                chosen, pages = choices, tried
                break
        if (white := pages.white(pages.count)) < least:
            best, least = chosen, white
    return best


def _remedies(pages: Pages, page: int, chosen: Choices) -> Iterator[Choices]:
    """Yield changes that may fill a page, the smallest change first."""
    pictures = [end for end in pages.ends if end.picture]
    coming = next((end for end in pictures if end.page == page + 1), None)
    if coming:
        together = [*(end for end in pictures if end.page == page), coming]
        white = pages.white_under(page) * (pages.bottom - pages.top)
        over = coming.y - pages.top + _GAP - white
        factor = 1.0 - over / sum(end.height for end in together)
        if _LEAST <= factor * min(end.share for end in together) and factor < 1.0:
            shares = {n: chosen.shares.get(n, 1.0) for n in (end.picture for end in together)}
            smaller = {n: round(factor * share, 3) for n, share in shares.items()}
            yield replace(chosen, shares={**chosen.shares, **smaller})
    for table, begun in pages.broken.items():
        if begun == page - 1:
            yield replace(chosen, whole=(*chosen.whole, table))
