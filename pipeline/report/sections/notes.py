"""The students' notes: read Markdown into blocks, so that no text in them is markup.

An answer in `notes.md` follows a heading that begins with the id of its question. Raw HTML is shown
as text. Images are replaced by their descriptions. Only links to web and mail addresses are kept.
LaTeX between dollars is typeset; a formula that cannot be typeset is shown as typed.
"""

import re
from collections.abc import Iterable, Sequence
from urllib.parse import urlsplit

from markdown_it import MarkdownIt
from markdown_it.tree import SyntaxTreeNode
from mdit_py_plugins.dollarmath import dollarmath_plugin

from pipeline.errors import SubmissionError
from pipeline.report.document import (
    Block,
    Cell,
    Code,
    Formula,
    Heading,
    Items,
    Paragraph,
    Quote,
    Table,
)
from pipeline.report.equations.latex import LatexError, read_latex
from pipeline.submission.load import COMMENT
from pipeline.words.math import to_text
from pipeline.words.numbers import listing
from pipeline.words.text import Span, Spans, clean, plain

_DEEPEST_HEADING = 6
_TOP_HEADING = 3  # larger headings belong to the report
_DEEPEST_READ = 200  # most levels of nesting; the parser leaves out deeper text
# Lists and quotations that are nested deeper are not indented further, because a page has no room.
_DEEPEST_NESTING = 6
# so many characters without a space are longer than any address and wider than any page
_ENDLESS = re.compile(r"\S{2000}")
_SCHEMES = ("http", "https", "mailto")
_FORMULAS = ("math_inline", "math_inline_double", "math_block")
_MOST_PROBLEMS = 3  # formulas that a message lists
_ALIGN = {"text-align:center": "c", "text-align:right": "r"}

_LEAD = re.compile(r"(?:question|q|answer|a)?[\s:.#]*([\w.-]+)", re.IGNORECASE)
_LEVEL = 2  # level of a heading that is added
_SPELT = str.maketrans({"ω": "omega", "ζ": "zeta", " ": " "})
_OPEN = (
    "this answer would merge with others: close every block of code (```) and every comment "
    "(<!-- -->), here and in notes.md, and start no heading with another question's id"
)


def note_blocks(markdown: str) -> tuple[Block, ...]:
    """Return Markdown as blocks of text; if it is nested too deeply, show it as typed."""
    text = _readable(markdown)
    try:
        return _blocks(_tree(text))
    except RecursionError:
        return (Code(text),)


def formula_problems(markdown: str) -> list[str]:
    """Return the first formulas that are shown as typed, each with the reason."""
    found: dict[str, str] = {}
    try:
        for node in _tree(_readable(markdown)).walk():
            if node.type in _FORMULAS:
                try:
                    read_latex(node.content)
                except LatexError as error:
                    found[_as_typed(node)] = str(error)
    except RecursionError:
        return []
    shown = list(found.items())[:_MOST_PROBLEMS]
    return [f"{typed} is shown as typed: {why}" for typed, why in shown]


def _readable(markdown: str) -> str:
    return _ENDLESS.sub(r"\g<0> ", clean(markdown))


def _tree(markdown: str) -> SyntaxTreeNode:
    parser = MarkdownIt("commonmark", {"html": False, "maxNesting": _DEEPEST_READ}).enable("table")
    # Dollars next to a digit or a space are amounts of money.
    parser.use(
        dollarmath_plugin,
        allow_labels=False,
        allow_space=False,
        allow_digits=False,
        allow_blank_lines=False,
        double_inline=True,
    )
    return SyntaxTreeNode(parser.parse(markdown))


def discussion_blocks(markdown: str) -> tuple[Block, ...]:
    """Return the notes as blocks; a first heading "Discussion" is left out."""
    blocks = note_blocks(markdown)
    first = blocks[0] if blocks else None
    if isinstance(first, Heading) and plain(first.text).strip().lower() == "discussion":
        return blocks[1:]
    return blocks


def even_headings(blocks: Iterable[Block]) -> tuple[Block, ...]:
    """Return the blocks with new heading levels, so that the outline skips no level."""
    above: list[int] = []  # levels of the headings above this one, as typed

    def even(block: Block) -> Block:
        match block:
            case Heading(text=text, level=level):
                while above and above[-1] >= level:
                    above.pop()
                above.append(level)
                return Heading(text, level=_TOP_HEADING + len(above) - 1)
            case Quote(blocks=inner):
                return Quote(tuple(even(b) for b in inner))
            case Items(items=items, ordered=ordered):
                return Items(tuple(tuple(even(b) for b in i) for i in items), ordered=ordered)
        return block

    return tuple(even(block) for block in blocks)


def _blocks(node: SyntaxTreeNode, depth: int = 0) -> tuple[Block, ...]:
    return tuple(block for child in node.children for block in _block(child, depth))


def _block(node: SyntaxTreeNode, depth: int) -> list[Block]:
    if depth >= _DEEPEST_NESTING and node.type in ("bullet_list", "ordered_list", "blockquote"):
        return [Paragraph((Span(_plain(node)),))]
    match node.type:
        case "heading":
            level = min(int(node.tag[1]) + _TOP_HEADING - 1, _DEEPEST_HEADING)
            text = _inline(node)
            return [Heading(text, level=level)] if plain(text).strip() else []
        case "paragraph":
            return [Paragraph(_inline(node))]
        case "bullet_list" | "ordered_list":
            items = tuple(_blocks(item, depth + 1) for item in node.children)
            return [Items(items, ordered=node.type == "ordered_list")]
        case "blockquote":
            return [Quote(_blocks(node, depth + 1))]
        case "fence" | "code_block":
            return [Code(node.content.rstrip("\n"))]
        case "table":
            return [_table(node)]
        case "math_block":
            return [_displayed(node)]
        case _:  # a horizontal rule has no meaning here
            return []


def _displayed(node: SyntaxTreeNode) -> Block:
    try:
        math = read_latex(node.content, display=True)
    except LatexError:
        return Code(_as_typed(node))
    return Formula(math, alt=to_text(math))


def _as_typed(node: SyntaxTreeNode) -> str:
    mark = "$" if node.type == "math_inline" else "$$"
    return f"{mark}{node.content.strip()}{mark}"


def _plain(node: SyntaxTreeNode) -> str:
    """Return all text inside a node.

    It works without recursion, because there may be a thousand levels.
    """
    shown = ("text", "code_inline", "fence", *_FORMULAS)
    return " ".join(n.content for n in node.walk() if n.type in shown)


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
    """Return the text of a node in the style of its surroundings.

    An inner style takes precedence.
    """
    match node.type:
        case "text":
            return [Span(node.content, around.style, around.url)] if node.content else []
        case "softbreak" | "hardbreak":
            return [Span(" ")]
        case "code_inline":
            return [Span(node.content, "code", around.url)]
        case "math_inline" | "math_inline_double":
            try:
                math = read_latex(node.content)
            except LatexError:
                return [Span(_as_typed(node), "code")]
            return [Span(to_text(math), math=math)]
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


def named(heading: str) -> str:
    """Return the id with which a heading begins, in its usual spelling."""
    match = _LEAD.match(heading.translate(_SPELT).strip())
    return match[1].rstrip(".:").lower() if match else ""


def written_answer(notes: str, id_: str) -> str:
    """Return the answer to a question as typed; "" if there is no answer."""
    lines = _lines(notes)
    found = _span(notes, id_)
    return "".join(lines[found[2] : found[3]]).strip() if found else ""


def with_answer(notes: str, id_: str, answer: str) -> str:
    """Return the notes with a new answer to a question; all other text is unchanged.

    Raises
    ------
    SubmissionError : a heading in the answer would end the answer early, or an unclosed code block
        or comment would merge it with other answers.
    """
    text = answer.replace("\r\n", "\n").strip()
    lines = _lines(notes)
    level, heading, start, end = _span(notes, id_) or (_LEVEL, len(lines), None, len(lines))
    if any(at <= level for at, *_ in _headings(text)):
        least = "#" * (level + 1)
        raise SubmissionError(
            f"a heading in an answer must start with {least}, or the answer would end there"
        )
    if len(_headings(f"{text}\n\n# end")) != len(_headings(text)) + 1:
        raise SubmissionError(_OPEN)
    if not text:
        return "".join([*lines[:heading], *lines[end:]])
    if start is None:
        new = f"{notes.rstrip()}\n\n{'#' * level} {id_}\n\n{text}\n".lstrip()
    else:
        rest = ["\n", *lines[end:]] if lines[end:] else []
        new = "".join([*lines[:start], f"\n{text}\n", *rest])
    others = {name: body for name, (at, body) in _bodies(notes).items() if not heading <= at < end}
    now = {name: body for name, (_, body) in _bodies(new).items()}
    if written_answer(new, id_) != text or any(now.get(name) != others[name] for name in others):
        raise SubmissionError(_OPEN)
    return new


def written_discussion(notes: str, ids: Iterable[str]) -> str:
    """Return the notes without the answers to the questions, as typed."""
    lines, rest, after = _lines(notes), "", 0
    for start, end in _answers(notes, ids):
        rest += "".join(lines[after:start])
        after = end
    return (rest + "".join(lines[after:])).strip()


def with_discussion(notes: str, ids: Sequence[str], discussion: str) -> str:
    """Return the notes with a new discussion, followed by the answers to the questions.

    Raises
    ------
    SubmissionError : the discussion has a heading with a question's id, or an unclosed code block
        or comment would merge it with the answers.
    """
    text, lines = discussion.replace("\r\n", "\n").strip(), _lines(notes)
    if taken := {named(words) for *_, words in _headings(text)} & {id_.lower() for id_ in ids}:
        raise SubmissionError(
            f"write the answer to {listing(sorted(taken))} into its own field, not under a heading "
            f"of the discussion"
        )
    kept = ["".join(lines[start:end]).strip() for start, end in _answers(notes, ids)]
    new = "".join(f"{part}\n\n" for part in (text, *kept) if part).rstrip() + "\n"
    same = all(written_answer(new, id_) == written_answer(notes, id_) for id_ in ids)
    if not same or written_discussion(new, ids) != text:
        raise SubmissionError(_OPEN)
    return new if new.strip() else ""


def _answers(notes: str, ids: Iterable[str]) -> list[tuple[int, int]]:
    """Return the first line of each answer's heading and the line after the answer."""
    known = {id_.lower() for id_ in ids}
    found: list[tuple[int, int]] = []
    begun: tuple[int, int] | None = None  # line and level of the heading of an answer
    for level, at, _, words in _headings(notes):
        is_answer = named(words) in known
        if begun and (is_answer or level <= begun[1]):
            found.append((begun[0], at))
            begun = None
        if is_answer:
            begun = at, level
    return [*found, (begun[0], len(_lines(notes)))] if begun else found


def _lines(text: str) -> list[str]:
    """Return the lines as Markdown counts them, including their ends."""
    return re.findall(r"[^\n]*\n|[^\n]+", text)


def _span(notes: str, id_: str) -> tuple[int, int, int, int] | None:
    """Return level and line of an answer's heading, and where the answer begins and ends."""
    headings = _headings(notes)
    for i, (level, start, end, text) in enumerate(headings):
        if named(text) == id_.lower():
            after = (line for at, line, _, _ in headings[i + 1 :] if at <= level)
            return level, start, end, next(after, len(_lines(notes)))
    return None


def _bodies(notes: str) -> dict[str, tuple[int, str]]:
    """Return the line of each answer's heading and the text up to the next heading, by id."""
    lines, headings = _lines(notes), _headings(notes)
    found: dict[str, tuple[int, str]] = {}
    for i, (_, at, start, text) in enumerate(headings):
        end = headings[i + 1][1] if headings[i + 1 :] else len(lines)
        found.setdefault(named(text), (at, "".join(lines[start:end]).strip()))
    return found


def _headings(markdown: str) -> list[tuple[int, int, int, str]]:
    """Return level, first line, next line, and text of each heading outside comments."""
    text = COMMENT.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), markdown)
    return [
        (int(node.tag[1:]), *node.map, plain(_inline(node)))
        for node in _tree(text).children
        if node.type == "heading" and node.map
    ]
