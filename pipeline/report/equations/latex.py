"""Formulas that students type in LaTeX, read into the same tree as cartlab's own formulas.

latex2mathml reads the LaTeX. Only the structure and the characters of its result are used, never an
attribute, so nothing that a student types is a link, a style or a command. Unknown LaTeX is refused
with the reason, and the notes then show it as typed.
"""

import re
import unicodedata
from collections.abc import Sequence
from html import unescape
from xml.etree.ElementTree import Element

from pipeline.words.math import (
    THIN_SPACE,
    WIDE_SPACE,
    Math,
    Term,
    fraction,
    lines,
    parens,
    power,
    row,
    sub,
    to_text,
    upright,
)
from pipeline.words.text import clean

_LONGEST = 1000  # characters of a formula
_DEEPEST = 24  # levels of nesting; typst limits the depth of calls
# Definitions could be nested so that a short formula becomes gigabytes.
_DEFINES = re.compile(r"\\(?:def|(?:re)?newcommand|DeclareMathOperator)(?![A-Za-z])")
_BRACE = re.compile(r"\\\\|\\[{}]")  # what is no brace of a group
_ALIGNED = re.compile(r"(\\(?:begin|end)\s*)\{(?:align\*?|aligned|split|eqnarray\*?)\}")
_UNKNOWN = re.compile(r"\\([A-Za-z]+)")
_DOTS = {"˙": "dot", "¨": "ddot"}
_ACCENTS = {"^": "^", "~": "~", "¯": "¯", "―": "¯", "→": "→"}
_OPENING, _CLOSING, _BARS = "([{⟨⌊⌈", ")]}⟩⌋⌉", "|‖"
_LIMITS = ("lim", "max", "min", "sup", "inf")
_SIGNS = ("Sm", "Ps", "Pe", "Po", "Pd")  # Unicode categories of operators
_PLAIN = "=+−·,≤≈≠→"  # signs that a formula may have as plain leaves
_NO_OPERATORS = "/∞∂∇∀∃∅%…′″"
_TOO_WIDE = "⏞⏟⎴⎵⏜⏝"  # brackets above or below a formula, which the fonts lack


class LatexError(ValueError):
    """A formula cannot be typeset; the message says why."""


def read_latex(latex: str, *, display: bool = False) -> Math:
    """Return a formula that was typed between dollars.

    Parameters
    ----------
    display : whether it stands on a line of its own.

    Raises
    ------
    LatexError : it cannot be typeset.
    """
    # Imported late, because few notes have formulas.
    from latex2mathml.converter import convert_to_element

    if len(latex) > _LONGEST:
        raise LatexError(f"it has more than {_LONGEST:,} characters")
    if found := _DEFINES.search(latex):
        raise LatexError(f"{found[0]} is not known here")
    if _BRACE.sub("", latex).count("{") != _BRACE.sub("", latex).count("}"):
        raise LatexError("its braces do not match")
    aligned = _ALIGNED.sub(r"\1{align*}", latex)
    try:
        math = row(*_terms(convert_to_element(aligned, display="block" if display else "inline")))
    except LatexError:
        raise
    except Exception:  # latex2mathml ends with any of a dozen exceptions
        raise LatexError("it cannot be read as LaTeX") from None
    if not to_text(math).strip():
        raise LatexError("it is empty")
    return math


def _terms(element: Element, depth: int = 0) -> list[Term]:
    """Return the children of an element."""
    _refuse_deep(depth)
    terms: list[Term] = []
    for child in element:
        if child.tag in ("mrow", "mstyle") and not _is_fenced(child):
            terms += _terms(child, depth + 1)  # brackets without a meaning of their own
        else:
            terms.append(_term(child, depth + 1))
    return _with_spaces(_with_brackets(_with_words(terms)))


def _refuse_deep(depth: int) -> None:
    if depth > _DEEPEST:
        raise LatexError("it is nested too deeply")


def _term(element: Element, depth: int) -> Term:
    _refuse_deep(depth)
    text = clean(unescape(element.text or ""))
    match element.tag:
        case "mi" | "mn" | "mo":
            return _leaf(text, is_upright=element.get("mathvariant") == "normal")
        case "mtext":
            if text == "⧸":
                raise LatexError(r"\not is not known here")
            return Math("text", (upright(text),))
        case "mspace":
            if element.get("linebreak"):
                raise LatexError(r"\\ is known only in aligned and in matrices")
            return WIDE_SPACE if element.get("width", "").startswith(("1", "2")) else THIN_SPACE
        case "mrow" | "mstyle":
            return _fenced(element, depth) if _is_fenced(element) else _row(element, depth)
        case "mtable":
            return _table(element, depth)
        case "msqrt":
            return Math("sqrt", (_row(element, depth),))
    return _compound(element.tag, [_inside(child, depth + 1) for child in element])


def _compound(tag: str, parts: Sequence[Term]) -> Term:
    """Return a term with a fixed number of parts."""
    match tag, *parts:
        case "mfrac", above, below:
            return fraction(above, below)
        case "mroot", base, degree:
            return Math("root", (base, degree))
        case "msub", base, index:
            if isinstance(base, Math) and base.kind == "text" and base.parts[0] in _LIMITS:
                return Math("limits", (base, index, ""))
            return sub(base, index)
        case "msup", base, exponent:
            return power(base, exponent)
        case "msubsup", base, index, exponent:
            return power(sub(base, index), exponent)
        case "mover", base, mark:
            sign = _sign(mark)
            if sign in _DOTS:
                return Math("dot" if sign == "˙" else "ddot", (base,))
            if sign in _ACCENTS:
                return Math("accent", (base, _ACCENTS[sign]))
            return Math("limits", (base, "", mark))
        case "munder", base, mark:
            return Math("limits", (base, mark, ""))
        case "munderover", base, below, above:
            return Math("limits", (base, below, above))
    raise LatexError("it cannot be read as LaTeX")


def _leaf(text: str, *, is_upright: bool) -> Term:
    if found := _UNKNOWN.match(text):
        raise LatexError(f"\\{found[1]} is not known here")
    if text == "&":
        raise LatexError("& is known only in aligned and in matrices")
    if any(c in _TOO_WIDE for c in text):
        raise LatexError("brackets above or below a formula are not known here")
    if len(text) != 1 or text in _PLAIN:
        return Math("text", (text,)) if text.isalpha() else text
    if unicodedata.category(text) in _SIGNS and text not in _NO_OPERATORS:
        return Math("operator", (text,))
    plain_letter = unicodedata.normalize("NFKC", text)
    if ord(text) > 0xFFFF and plain_letter.isalnum():  # bold and script letters
        return Math("text", (plain_letter,))
    return Math("text", (text,)) if is_upright and text.isalpha() else text


def _sign(term: Term) -> str:
    """Return the character of an operator or leaf; "" for another term."""
    while isinstance(term, Math) and term.kind in ("operator", "row") and len(term.parts) == 1:
        term = term.parts[0]
    return term if isinstance(term, str) else ""


def _inside(element: Element, depth: int) -> Term:
    """Return a part of a fraction, root or script."""
    if element.tag in ("mrow", "mstyle") and not _is_fenced(element):
        terms = _terms(element, depth)
        return terms[0] if len(terms) == 1 else row(*terms)
    return _term(element, depth)


def _row(element: Element, depth: int) -> Term:
    return row(*_terms(element, depth))


def _is_fenced(element: Element) -> bool:
    return len(element) > 0 and element[0].get("form") == "prefix"


def _fenced(element: Element, depth: int) -> Term:
    r"""Return what stands between \left and \right."""
    has_end = element[-1].get("form") == "postfix"
    inner = Element("mrow")
    inner.extend(element[1 : -1 if has_end else None])
    ends = [clean(unescape(element[at].text or "")) for at in (0, -1)]
    return _brackets(ends[0], _terms(inner, depth), ends[1] if has_end else "")


def _brackets(left: str, inner: Sequence[Term], right: str) -> Term:
    if (left, right) == ("(", ")"):
        return parens(*inner)
    if any(len(end) > 1 or end not in _OPENING + _CLOSING + _BARS for end in (left, right)):
        raise LatexError(f"\\left{left} and \\right{right} are not known here")
    return Math("fenced", (left, row(*inner), right))


def _table(element: Element, depth: int) -> Term:
    rows = [[_row(cell, depth) for cell in one] for one in element]
    width = max(map(len, rows), default=0)
    if not width:
        raise LatexError("it has an empty matrix")
    if element.get("columnspacing"):  # of `align`: one equation a row
        return lines(
            row(*(part for cell in one if isinstance(cell, Math) for part in cell.parts if part))
            for one in rows
            if any(isinstance(cell, Math) and any(cell.parts) for cell in one)
        )
    cells = tuple(cell for one in rows for cell in [*one, *[""] * (width - len(one))])
    return Math("table", cells, columns=width)


def _with_words(terms: Sequence[Term]) -> list[Term]:
    """Return terms in which upright letters next to each other are one word, such as "rad"."""
    joined: list[Term] = []
    for term in terms:
        last = joined[-1] if joined else None
        both = (last, term)
        if all(isinstance(one, Math) and one.kind == "text" for one in both):
            words = [str(one.parts[0]) for one in both if isinstance(one, Math)]
            if all(len(word) == 1 for word in words[1:]) and words[0].isalpha():
                joined[-1] = Math("text", ("".join(words),))
                continue
        joined.append(term)
    return joined


def _with_brackets(terms: Sequence[Term]) -> list[Term]:
    """Return terms in which the brackets around a matrix grow with it."""
    joined = list(terms)
    at = 1
    while at < len(joined) - 1:
        term, left, right = joined[at], _sign(joined[at - 1]), _sign(joined[at + 1])
        is_table = isinstance(term, Math) and term.kind == "table"
        if is_table and left and right and left in _OPENING + _BARS and right in _CLOSING + _BARS:
            joined[at - 1 : at + 2] = [_brackets(left, [term], right)]
        at += 1
    return joined


def _with_spaces(terms: Sequence[Term]) -> list[Term]:
    """Return terms with a space between the name of a function and its argument."""
    spaced: list[Term] = []
    for at, term in enumerate(terms):
        spaced.append(term)
        follows = terms[at + 1] if at + 1 < len(terms) else None
        if isinstance(term, Math) and term.kind in ("text", "limits") and _is_word(term):
            is_letter = isinstance(follows, str) and follows.isalnum()
            is_compound = isinstance(follows, Math) and follows.kind in (
                "sub", "sup", "fraction", "sqrt", "accent", "dot", "ddot",
            )  # fmt: skip
            if is_letter or is_compound:
                spaced.append(THIN_SPACE)
    return spaced


def _is_word(term: Math) -> bool:
    base = term.parts[0] if term.kind == "limits" else term
    return isinstance(base, Math) and base.kind == "text" and len(str(base.parts[0])) > 1
