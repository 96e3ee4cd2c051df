"""Answers in `notes.md`: each follows a heading that begins with the id of its question."""

import re
from itertools import pairwise

from markdown_it import MarkdownIt

from pipeline.errors import SubmissionError
from pipeline.submission.load import COMMENT

_LEAD = re.compile(r"(?:question|q|answer|a)?[\s:.#]*([\w.-]+)", re.IGNORECASE)
_LEVEL = 2  # level of a heading that is added
_SPELT = str.maketrans({"ω": "omega", "ζ": "zeta", " ": " "})
_OPEN = (
    "this answer would merge with others: close every block of code (```) and every comment "
    "(<!-- -->), here and in notes.md, and start no heading with another question's id"
)


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
    tokens = MarkdownIt("commonmark", {"html": False}).parse(text)
    found = []
    for heading, inline in pairwise(tokens):
        if heading.type == "heading_open" and heading.level == 0 and heading.map:
            words = "".join(one.content for one in inline.children or ())
            found.append((int(heading.tag[1:]), *heading.map, words))
    return found
