"""The students' notes: Markdown read into blocks, so that nothing in them is ever markup.

Raw HTML is text, images leave their description, links keep only web and mail addresses.
"""

from urllib.parse import urlsplit

from markdown_it import MarkdownIt
from markdown_it.tree import SyntaxTreeNode

from pipeline.report.document import (
    Block,
    Cell,
    Code,
    Heading,
    Items,
    Paragraph,
    Quote,
    Span,
    Spans,
    Table,
)
from pipeline.report.words import clean

_DEEPEST_HEADING = 6
_TOP_HEADING = 3  # the report's own headings are above
_SCHEMES = ("http", "https", "mailto")
_ALIGN = {"text-align:center": "c", "text-align:right": "r"}


def note_blocks(markdown: str) -> tuple[Block, ...]:
    """Return Markdown as blocks of inert text."""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tree = SyntaxTreeNode(parser.parse(clean(markdown)))
    return _blocks(tree)


def _blocks(node: SyntaxTreeNode) -> tuple[Block, ...]:
    return tuple(block for child in node.children for block in _block(child))


def _block(node: SyntaxTreeNode) -> list[Block]:
    match node.type:
        case "heading":
            level = min(int(node.tag[1]) + _TOP_HEADING - 1, _DEEPEST_HEADING)
            return [Heading(_inline(node), level=level)]
        case "paragraph":
            return [Paragraph(_inline(node))]
        case "bullet_list" | "ordered_list":
            items = tuple(_blocks(item) for item in node.children)
            return [Items(items, ordered=node.type == "ordered_list")]
        case "blockquote":
            return [Quote(_blocks(node))]
        case "fence" | "code_block":
            return [Code(node.content.rstrip("\n"))]
        case "table":
            return [_table(node)]
        case _:  # a rule between paragraphs says nothing here
            return []


def _table(node: SyntaxTreeNode) -> Table:
    head, *bodies = node.children
    columns = head.children[0].children
    return Table(
        number=0,
        caption=(),
        head=tuple(Cell(_inline(cell)) for cell in columns),
        rows=tuple(
            tuple(Cell(_inline(cell)) for cell in line.children)
            for body in bodies
            for line in body.children
        ),
        align="".join(_ALIGN.get(str(cell.attrs.get("style")), "l") for cell in columns),
    )


def _inline(node: SyntaxTreeNode) -> Spans:
    return tuple(span for child in node.children for span in _spans(child, Span("")))


def _spans(node: SyntaxTreeNode, around: Span) -> list[Span]:
    """Return a node's text in the style of what is around it; the innermost style wins."""
    match node.type:
        case "text":
            return [Span(node.content, around.style, around.url)] if node.content else []
        case "softbreak" | "hardbreak":
            return [Span(" ")]
        case "code_inline":
            return [Span(node.content, "code", around.url)]
        case "image":
            return [Span(f"[image: {node.content}]", "em")]
        case "strong":
            around = Span("", "strong", around.url)
        case "em":
            around = Span("", "em", around.url)
        case "link":
            address = str(node.attrs.get("href", ""))
            around = Span("", around.style, address if _is_safe(address) else "")
    return [span for child in node.children for span in _spans(child, around)]


def _is_safe(address: str) -> bool:
    try:
        return urlsplit(address).scheme in _SCHEMES
    except ValueError:
        return False
