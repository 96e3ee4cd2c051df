"""Students' notes in Markdown become blocks that cannot run any code."""

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.report.document import (
    Block,
    Code,
    Document,
    Heading,
    Items,
    Paragraph,
    Quote,
    Section,
    Table,
)
from pipeline.report.html import render_html
from pipeline.report.pdf import render_pdf
from pipeline.report.sections.notes import even_headings, note_blocks
from pipeline.words.text import plain


def document_of(blocks: tuple[Block, ...]) -> Document:
    """Return a report that contains only these blocks."""
    section = Section("discussion", "Discussion", blocks)
    return Document(title="t", subtitle="", authors=(), sections=(section,), footer="")


def page(markdown: str) -> str:
    """Return what a report shows of these notes, as HTML."""
    html = render_html(document_of(note_blocks(markdown)))
    return html.split("<main>")[1].split("<script>")[0]


def test_markdown_becomes_blocks():
    """Headings, emphasis, code, lists, quotes and tables of Markdown keep their structure."""
    blocks = note_blocks(
        "# Result\n\nIt is **very** *soft*, `k = 3`.\n\n1. one\n   - inner\n2. two\n\n> quoted\n\n"
        "```\ncode <b>\n```\n\n| a | b |\n|---|--:|\n| 1 | 2 |\n"
    )

    heading, text, items, quote, code, table = blocks
    assert isinstance(heading, Heading)
    assert heading.level == 3  # the report's own headings use the levels above
    assert isinstance(text, Paragraph)
    marks = [(span.text, span.style) for span in text.text if span.style != "plain"]
    assert marks == [("very", "strong"), ("soft", "em"), ("k = 3", "code")]
    assert isinstance(items, Items)
    assert (items.ordered, len(items.items)) == (True, 2)
    assert isinstance(items.items[0][1], Items)
    assert isinstance(quote, Quote)
    assert code == Code("code <b>")
    assert isinstance(table, Table)
    assert table.align == "lr"
    assert [plain(cell.text) for cell in table.rows[0]] == ["1", "2"]


@pytest.mark.parametrize(
    "markdown",
    [
        "<script>alert(1)</script>",
        "text <img src=x onerror=alert(1)> text",
        "[click](javascript:alert(1))",
        "[click](data:text/html,<script>alert(1)</script>)",
        "[click](//evil.example/x)",
        "![tracker](https://evil.example/pixel.png)",
        "<style>body{display:none}</style>",
        '[a](https://ok.example/"onmouseover=alert(1)//)',
        "&lt;script&gt;alert(1)&lt;/script&gt;",
    ],
)
def test_hostile_markdown_stays_text(markdown):
    """No tag, attribute, script or remote image in a student's notes takes effect on the page."""
    html = page(markdown)

    tags = re.findall(r"<[^>]*>", html)
    allowed = re.compile(
        r"</?(p|section|h2|main|footer|body|html|em|strong)\b[^<>]*>"
        r'|<a href="https://[^"]*" rel="noopener noreferrer nofollow">|</a>'
    )
    assert all(allowed.fullmatch(tag) for tag in tags), tags
    assert "evil.example/pixel" not in html


def test_web_and_mail_links_stay():
    """Links to web pages and mail addresses keep their addresses."""
    (block,) = note_blocks("[paper](https://example.org/a?b=1&c=2) <mailto:a@example.org>")
    assert isinstance(block, Paragraph)
    assert [span.url for span in block.text if span.url] == [
        "https://example.org/a?b=1&c=2",
        "mailto:a@example.org",
    ]


def test_control_characters_are_replaced():
    """Characters that are not allowed in a page are replaced."""
    (block,) = note_blocks("a\x07b\ud800c\ufffe")
    assert isinstance(block, Paragraph)
    assert plain(block.text) == "a�b�c�"


@given(st.text(alphabet=st.sampled_from("ab<>&\"'`*_[]()!#-|\n \\$:/h1.{}%~+="), max_size=80))
def test_any_text_gives_a_page_without_foreign_tags(markdown):
    """Whatever the notes contain, the page has only the tags of its template and of formulas."""
    html = page(markdown)
    names = set(re.findall(r"<\s*/?\s*([a-zA-Z][\w-]*)", html))
    ours = "section h2 h3 h4 h5 h6 p ul ol li em strong code pre blockquote a div table thead tbody"
    formulas = "math mrow mi mn mo mtext mfrac msub msup msubsup mover munder munderover".split()
    assert names <= {*ours.split(), *formulas, "tr", "th", "td", "main", "footer", "body", "html"}


@settings(max_examples=20)
@given(st.text(alphabet=st.sampled_from("ab#->*1._`|\n "), max_size=60))
def test_any_notes_give_an_accessible_pdf(markdown):
    """Whatever the notes contain, the PDF's outline skips no level, as PDF/UA demands."""
    blocks = even_headings(note_blocks(markdown))

    assert render_pdf(document_of(blocks)).startswith(b"%PDF")


def test_headings_go_down_one_level_at_a_time():
    """A heading that skips a level is raised; headings of one level stay equal."""
    blocks = even_headings(note_blocks("### a\n\n###### b\n\n###### c\n\n# d\n\n## e"))

    levels = [block.level for block in blocks if isinstance(block, Heading)]
    assert levels == [3, 4, 4, 3, 4]


NESTS = ["> " * 20, "> " * 90, "> " * 3000, "- " * 40, "1. " * 30, "[" * 3000]


@pytest.mark.parametrize("nest", [*NESTS, "*" * 5000 + "x" + "*" * 5000])
def test_deeply_nested_notes_give_a_page(nest):
    """Deeply nested notes cause no crash and keep their text; quotes are at most six deep."""
    blocks = note_blocks(f"{nest}deep")
    assert "deep" in str(blocks) or len(nest) > 1000
    assert str(blocks).count("kind='quote'") <= 6
