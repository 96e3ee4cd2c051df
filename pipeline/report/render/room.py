"""Fill the pages of a PDF.

A block that does not fit on a page moves to the next one and leaves white space. If that is much,
two things are tried: the figures of the page and the next one are drawn a little smaller, or a
broken table is kept whole. The version with less white space is used.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

_GAP = 28.0  # points, between the end of a page and the next block, such as a heading
_WHITE = 0.3  # of a page: less white space is accepted
_LEAST = 0.75  # of the usual size: the labels of a figure are then still 6 points high
_MOST_TRIES = 8  # each takes a quarter of the time that the first takes


@dataclass(frozen=True, kw_only=True)
class Choices:
    """Deviations from the default layout, by the numbers of figures and tables."""

    shares: Mapping[int, float] = field(default_factory=dict)  # of the usual size
    whole: tuple[int, ...] = ()  # tables that do not break


@dataclass(frozen=True, kw_only=True)
class End:
    """The end of a block.

    Attributes
    ----------
    page, y : its page, and points from the top.
    picture, table : its number, or 0; a table has a second entry for the end of its caption.
    share, height : relative size of a figure (1 by default), and its height in points.
    """

    page: int
    y: float
    picture: int = 0
    table: int = 0
    share: float = 1.0
    height: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Pages:
    """A document laid out: where its blocks end, and where the text of every page may stand."""

    ends: Sequence[End]
    top: float
    bottom: float

    @property
    def count(self) -> int:
        """Return how many pages there are."""
        return max((end.page for end in self.ends), default=0)

    def white_under(self, page: int) -> float:
        """Return the share of a page that is empty at its foot; of the last one none."""
        lowest = max((end.y for end in self.ends if end.page == page), default=self.bottom)
        if page >= self.count or page in self.broken.values():
            return 0.0
        return (self.bottom - lowest) / (self.bottom - self.top)

    @property
    def broken(self) -> dict[int, int]:
        """Return the tables that go on beyond a page, and the page that they begin on."""
        first = {end.table: end.page for end in reversed(self.ends) if end.table}
        last = {end.table: end.page for end in self.ends if end.table}
        return {table: page for table, page in first.items() if page < last[table]}

    def white(self, last: int) -> float:
        """Return how white pages 1 to `last` are: one that is half empty is worse than two."""
        pages = range(1, last + 1)
        return sum(max(self.white_under(page) - _WHITE, 0.0) ** 2 for page in pages)


def fill_pages(lay_out: Callable[[Choices], Pages]) -> Choices:
    """Return what is best set otherwise than usual; `lay_out` lays the document out.

    Pages are filled from the first to the last. A remedy may leave white space on a later page,
    whose turn comes later; the best layout of all is returned.
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
    """Yield what may fill a page, the least disturbing first."""
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
