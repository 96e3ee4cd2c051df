"""Mathematics as a small tree, rendered as MathML, as plain text, or by the PDF template.

A leaf is a string: a number ("24.3"), an operator ("+"), or an identifier ("ω", "s"). A longer
identifier is set upright. A node is `Math(kind, parts)`.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

from pipeline.names import read_name

_NUMBER = re.compile(r"\d+(\.\d+)?")
_OPERATORS = frozenset("+−=·,()[]≥≤<≈≠→")
_RELATIONS = frozenset("=≥≤<≈≠→")

MathKind = Literal[
    "row", "fraction", "sub", "sup", "dot", "ddot", "matrix", "parens", "lines",
    # Only in formulas that students typed:
    "text", "operator", "accent", "sqrt", "root", "limits", "fenced", "table",
]  # fmt: skip


@dataclass(frozen=True)
class Math:
    """A node; `columns` is the number of columns of a matrix, whose parts are in rows.

    A "text" and an "operator" have one string. An "accent" has a base and a mark, and a "root" a
    base and a degree. "limits" has a base, an index and an exponent. "fenced" has a bracket, a term
    and a bracket. A "table" is a matrix without brackets. An empty string is no term.
    """

    kind: MathKind
    parts: tuple["Term", ...]
    columns: int = 0


Term = Math | str


def row(*parts: Term) -> Math:
    """Return terms in a row."""
    return Math("row", parts)


def fraction(above: Term, below: Term) -> Math:
    """Return a fraction."""
    return Math("fraction", (above, below))


def sub(base: Term, index: Term) -> Math:
    """Return a term with an index."""
    return Math("sub", (base, index))


def power(base: Term, exponent: Term) -> Math:
    """Return a term with an exponent."""
    return Math("sup", (base, exponent))


def dot(base: Term, *, order: int = 1) -> Math:
    """Return the first or second time derivative."""
    return Math("dot" if order == 1 else "ddot", (base,))


def parens(*parts: Term) -> Math:
    """Return terms in round brackets of the same height."""
    return Math("parens", parts)


def matrix(rows: Iterable[Sequence[Term]]) -> Math:
    """Return a matrix in square brackets."""
    filled = [tuple(r) for r in rows]
    return Math("matrix", tuple(term for r in filled for term in r), columns=len(filled[0]))


def lines(equations: Iterable[Term]) -> Math:
    """Return equations below each other."""
    return Math("lines", tuple(equations))


THIN_SPACE, WIDE_SPACE, NO_BREAK = "\u2009", "\u2003", "\u00a0"


def upright(words: str) -> str:
    """Return words inside a formula as one leaf, with their spaces."""
    return words.replace(" ", NO_BREAK)


def function(name: str, *argument: Term) -> tuple[Term, ...]:
    """Return a function's name and its argument, separated by a space unless it is in brackets."""
    return (THIN_SPACE, name, *(argument or (THIN_SPACE,)))


def total(terms: Sequence[Term]) -> Term:
    """Return the sum of terms."""
    if len(terms) == 1:
        return terms[0]
    joined: list[Term] = [terms[0]]
    for term in terms[1:]:
        joined += ["+", term]
    return row(*joined)


def negative(term: Term) -> Math:
    """Return the term with a minus sign in front."""
    return row("−", term)


def symbol(name: str) -> Term:
    """Return a parameter name such as `omega_a`, `K_1` or `mass` as a mathematical symbol."""
    read = read_name(name)
    base = GREEK.get(read.symbol, read.symbol)
    return sub(base, read.suffix) if read.suffix else base


GREEK = {"omega": "ω", "zeta": "ζ", "delta": "δ", "mass": "m", "damping": "c"}


def number(text: str) -> Term:
    """Return a formatted number ("−1.2 × 10⁻³") as one term."""
    unsigned = text.removeprefix("−")
    mantissa, times, exponent = unsigned.partition(" × 10")
    term: Term = mantissa
    if times:
        term = row(mantissa, "·", power("10", exponent.translate(_PLAIN_DIGITS)))
    return negative(term) if unsigned != text else term


_PLAIN_DIGITS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻", "0123456789−")


# ------------------------------------------------------------------- renderers


def to_mathml(math: Term, *, display: bool = False) -> str:
    """Return the mathematics as MathML; every leaf is escaped."""
    mode = ' display="block"' if display else ""
    return f"<math{mode}>{_mathml(math)}</math>"


def _mathml(term: Term) -> str:
    if isinstance(term, str):
        return _mathml_leaf(term)
    parts = [_mathml(part) for part in term.parts]
    inside = "".join(parts)
    match term.kind:
        case "text":
            return f"<mtext>{escape(str(term.parts[0]))}</mtext>"
        case "operator":
            return f'<mo stretchy="false">{escape(str(term.parts[0]))}</mo>'
        case "accent":
            return f'<mover accent="true">{parts[0]}<mo>{escape(str(term.parts[1]))}</mo></mover>'
        case "sqrt":
            return f"<msqrt>{inside}</msqrt>"
        case "root":
            return f"<mroot>{inside}</mroot>"
        case "limits":
            tag = "munderover" if all(term.parts) else "munder" if term.parts[1] else "mover"
            shown = "".join(mathml for part, mathml in zip(term.parts, parts, strict=True) if part)
            return f"<{tag}>{shown}</{tag}>"
        case "fenced":
            left, right = (
                f'<mo fence="true" stretchy="true" form="{form}">{escape(str(end))}</mo>'
                for form, end in (("prefix", term.parts[0]), ("postfix", term.parts[2]))
            )
            return f"<mrow>{left}{parts[1]}{right}</mrow>"
        case "row":
            return f"<mrow>{inside}</mrow>"
        case "parens":
            # A stretchable bracket takes more room, so it is used only for tall terms.
            grow = "true" if any(map(_is_tall, term.parts)) else "false"
            left, right = (f'<mo stretchy="{grow}">{bracket}</mo>' for bracket in "()")
            return f"<mrow>{left}<mrow>{inside}</mrow>{right}</mrow>"
        case "fraction":
            return f"<mfrac>{inside}</mfrac>"
        case "sub":
            return f"<msub>{inside}</msub>"
        case "sup":
            if isinstance(base := term.parts[0], Math) and base.kind == "sub":
                return f"<msubsup>{''.join(map(_mathml, base.parts))}{parts[1]}</msubsup>"
            return f"<msup>{inside}</msup>"
        case "dot" | "ddot":
            mark = "˙" if term.kind == "dot" else "¨"
            return f'<mover accent="true">{inside}<mo>{mark}</mo></mover>'
        case "lines":
            rows = "".join(f"<mtr>{_aligned(part)}</mtr>" for part in term.parts)
            return f'<mtable class="lines" displaystyle="true">{rows}</mtable>'
        case "matrix" | "table":
            cells = [f"<mtd>{part}</mtd>" for part in parts]
            rows = [
                "<mtr>" + "".join(cells[i : i + term.columns]) + "</mtr>"
                for i in range(0, len(cells), term.columns)
            ]
            table = f"<mtable>{''.join(rows)}</mtable>"
            return table if term.kind == "table" else f"<mrow><mo>[</mo>{table}<mo>]</mo></mrow>"


def _is_tall(term: Term) -> bool:
    if isinstance(term, str):
        return False
    return term.kind in ("fraction", "matrix", "table", "sqrt") or any(map(_is_tall, term.parts))


def _aligned(line: Term) -> str:
    """Return a line in three cells, so that the equals signs of all lines are aligned.

    A line that begins with a plus sign continues the line above it.
    """
    if isinstance(line, Math) and line.parts[:1] == ("+",):
        return f"<mtd></mtd><mtd></mtd><mtd>{_mathml(line)}</mtd>"
    if not isinstance(line, Math) or "=" not in line.parts:
        return f"<mtd>{_mathml(line)}</mtd>"
    at = line.parts.index("=")
    left, right = row(*line.parts[:at]), row(*line.parts[at + 1 :])
    return "".join(f"<mtd>{_mathml(part)}</mtd>" for part in (left, "=", right))


def _mathml_leaf(leaf: str) -> str:
    text = escape(leaf)
    if _NUMBER.fullmatch(leaf):
        return f"<mn>{text}</mn>"
    if leaf in _OPERATORS:
        return f"<mo>{text}</mo>"
    return f"<mi>{text}</mi>"


def to_text(term: Term) -> str:
    """Return the mathematics in one line of text, for screen readers."""
    if isinstance(term, str):
        return f" {term} " if term in _RELATIONS or term in "+" else term
    parts = [to_text(part) for part in term.parts]
    match term.kind:
        case "row" | "text" | "operator" | "accent" | "fenced":
            return "".join(parts)
        case "sqrt":
            return f"√({parts[0]})"
        case "root":
            return f"√[{parts[1]}]({parts[0]})"
        case "limits":
            marks = zip("_^", parts[1:], strict=True)
            return parts[0] + "".join(f"{mark}({part})" for mark, part in marks if part)
        case "parens":
            return f"({''.join(parts)})"
        case "fraction":
            return f"({parts[0]})/({parts[1]})"
        case "sub":
            return f"{parts[0]}_{parts[1]}"
        case "sup":
            return f"{parts[0]}^{parts[1]}"
        case "dot":
            return f"{parts[0]}′"
        case "ddot":
            return f"{parts[0]}″"
        case "lines":
            return "; ".join(parts)
        case "matrix" | "table":
            width = term.columns
            rows = [", ".join(parts[i : i + width]) for i in range(0, len(parts), width)]
            return f"[{'; '.join(rows)}]"


_IN_TEX = {
    "−": "-", "→": r"\to", "≤": r"\le", "≠": r"\ne", "·": r"\cdot", "π": r"\pi", "μ": r"\mu",
    "τ": r"\tau", "λ": r"\lambda", "φ": r"\phi", "δ": r"\delta", WIDE_SPACE: r"\quad",
    NO_BREAK: "\\",  # "\\" includes the space that follows it
}  # fmt: skip


def to_tex(term: Term) -> str:
    """Return a formula as TeX; matrices and derivations are not supported."""
    if isinstance(term, str):
        return _tex_leaf(term)
    first, *others = term.parts
    match term.kind:
        case "row":
            return _tex_row(term.parts)
        case "parens":
            left, right = (r"\left(", r"\right)") if _has_parens(term) else "()"
            return f"{left}{_tex_row(term.parts)}{right}"
        case "sub" | "sup":
            mark, script = "_" if term.kind == "sub" else "^", to_tex(others[0])
            return f"{to_tex(first)}{mark}" + (
                script if isinstance(others[0], str) else f"{{{script}}}"
            )
        case "dot" | "ddot":
            return rf"\{term.kind} {to_tex(first)}"
    raise ValueError(f"no TeX for {term.kind}")


def _has_parens(term: Math) -> bool:
    return any(isinstance(part, Math) and part.kind == "parens" for part in term.parts)


def _tex_leaf(leaf: str) -> str:
    if leaf in ("sin", "cos", "min", "max"):
        return rf"\{leaf}"
    if leaf in ("sign", "clip"):
        return rf"\operatorname{{{leaf}}}"
    if len(leaf) > 1 and not _NUMBER.fullmatch(leaf):
        return rf"\text{{{leaf.replace(NO_BREAK, ' ')}}}"
    return _IN_TEX.get(leaf, leaf)


def _tex_row(parts: Sequence[Term]) -> str:
    """Return terms with spaces between them, except next to a bar, a sign or a slash."""
    text, joined, bars = "", True, 0  # `joined`: no space before the next part
    for before, part in zip((None, *parts), parts, strict=False):
        if part == THIN_SPACE:
            continue
        bars += part == "|"
        closes = part == "|" and bars % 2 == 0
        called = isinstance(part, Math) and part.kind == "parens" and _is_called(before, part)
        text += ("" if joined or closes or called or part in (",", "/") else " ") + to_tex(part)
        signs = part == "−" and (before is None or before == "," or before in _RELATIONS)
        joined = signs or part == "/" or (part == "|" and not closes)
    return text


def _is_called(name: Term | None, brackets: Math) -> bool:
    """Return whether brackets hold a function's argument rather than a factor.

    They do if the name before them is a word, or if they begin with t for time.
    """
    return brackets.parts[0] == "t" or (isinstance(name, str) and len(name) > 1)
