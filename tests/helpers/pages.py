"""Read pages, documents and figures as a reader does."""

from collections.abc import Iterable
from html.parser import HTMLParser

from pipeline.report.document import Block, Document, Picture, Section, Table, Tile, Tiles, flat
from pipeline.words.text import plain

HOSTILE = '#import "/etc/passwd": * $x^2$ <script>alert(1)</script> {{ 7*7 }} `#panic()` \\ [a](b)'
_VOID = {"meta", "link", "br", "img", "hr", "input"}


class Page(HTMLParser):
    """A parser that collects what the tests need and checks that tags are closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self._open: list[str] = []
        self.feed(html)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        """Record an opening tag."""
        self.tags.append((tag, dict(attrs)))
        if tag not in _VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        """Record a tag that closes itself."""
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        """Check that the closed tag is the one opened last."""
        assert self._open.pop() == tag

    def handle_data(self, data):
        """Collect the text that a reader sees."""
        if self._open[-1:] not in (["style"], ["script"]):
            self.text += data.replace("\u00a0", " ")

    def values(self, attribute: str) -> list[str]:
        """Return all values of one attribute."""
        return [value for _, attrs in self.tags if (value := attrs.get(attribute)) is not None]

    def count(self, tag: str) -> int:
        """Return how many elements of one kind there are."""
        return sum(name == tag for name, _ in self.tags)


def sections(document: Document) -> dict[str, Section]:
    """Return the sections of a document by their anchors."""
    return {section.id: section for section in document.sections}


def tiles(blocks: Iterable[Block]) -> list[Tile]:
    """Return the tiles of all boards."""
    return [tile for block in flat(blocks) if isinstance(block, Tiles) for tile in block.tiles]


def pictures(blocks: Iterable[Block]) -> dict[str, Picture]:
    """Return the pictures by the names of their files."""
    return {block.name: block for block in flat(blocks) if isinstance(block, Picture)}


def rows(blocks: Iterable[Block]) -> dict[str, list[str]]:
    """Return the rows of all tables, as text without the first cell, by the first cell."""
    return {
        plain(row[0].text): [plain(cell.text) for cell in row[1:]]
        for block in flat(blocks)
        if isinstance(block, Table)
        for row in block.rows
    }
