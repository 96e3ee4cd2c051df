"""Render a document as one self-contained HTML file with one script; it loads nothing else.

The security policy in the page allows only this script, by its hash.
"""

import base64
import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.report.document import Block, Document, Picture, Table, Tiles, flat
from pipeline.report.figures import GRID, MEASURED, MODEL, QUIET, SECOND, SHADE, THIRD
from pipeline.resources import TEMPLATES
from pipeline.words.math import Term, to_mathml
from pipeline.words.numbers import unbroken
from pipeline.words.text import breakable, plain

# The style sheet defines each colour for light and dark pages.
_ROLES = {
    MEASURED: "ink", MODEL: "model", SECOND: "second", THIRD: "third", QUIET: "quiet",
    SHADE: "shade", GRID: "grid", "#444444": "axis", "#555555": "mark",
}  # fmt: skip
ALWAYS, FINDER = "page.js", "finder.js"
PLOTS = ("uplot.min.js", "charts.js", "plots.js")  # scripts that only the page of plots has
_TITLE = re.compile(r"<title>.*?</title>", re.DOTALL)
_NARROW = " .,()"  # characters that are half as wide as a digit
_WIDE = "±×%"  # characters that are wider than a digit


def render_html(document: Document) -> str:
    """Return the page; every text is escaped, except cartlab's own SVG, MathML and script."""
    text = script(*_scripts(document))
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            document=document,
            math_font=_math_font(),
            script=Markup(text),
            script_hash=Markup(script_hash(text)),
        )
    )


def render_fragment(blocks: Sequence[Block]) -> str:
    """Return blocks as HTML without scripts, for another page such as a notebook."""
    return _environment().get_template("fragment.html.j2").render(blocks=blocks)


def render_plots(**values: object) -> str:
    """Return the page of plots; every value is escaped."""
    text = script(*PLOTS)
    page = _environment().get_template("plots.html.j2")
    return page.render(script=Markup(text), script_hash=Markup(script_hash(text)), **values)


def render_text(template: str, **values: object) -> str:
    """Return a text from one of cartlab's templates, without escaping."""
    return _environment().overlay(autoescape=False).get_template(template).render(**values)


def render_blocks(blocks: Sequence[Block]) -> Markup:
    """Return blocks for a page that has the report's style sheet and allows no inline styles."""
    plain = [
        replace(block, align=block.align.replace("d", "r")) if isinstance(block, Table) else block
        for block in blocks
    ]
    return Markup(_environment().get_template("blocks.html.j2").module.render_all(plain))  # type: ignore[attr-defined]


def render_drawing(svg: str) -> str:
    """Return a drawing as a separate file, with colours for light and dark pages."""
    css = (TEMPLATES / "report.css").read_text(encoding="utf-8")
    colours = css[: css.index("* {")] + "text { fill: var(--f-ink); }"
    return _coloured(svg).replace("</title>", f"</title><style>{colours}</style>", 1)


@cache
def script(*names: str) -> str:
    """Join the scripts of a page into one."""
    return "".join((TEMPLATES / name).read_text(encoding="utf-8") for name in names)


def script_hash(text: str) -> str:
    """Return the hash by which a page's security policy allows its script."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def every_hash() -> Iterable[str]:
    """Return the hashes of all scripts that a page may have."""
    for names in ((ALWAYS,), (ALWAYS, FINDER), PLOTS):
        yield script_hash(script(*names))


def _scripts(document: Document) -> list[str]:
    """Return the scripts that a document needs."""
    blocks = [block for section in document.sections for block in flat(section.blocks)]
    finder = any(isinstance(block, Table) and block.finder for block in blocks)
    return [ALWAYS, FINDER] if finder else [ALWAYS]


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "mathml": _mathml, "svg": _svg, "tails": _tails, "heads": _heads, "board": _board,
        "unbroken": unbroken, "breakable": breakable,
    }  # fmt: skip
    return environment


def _mathml(term: Term, display: bool = False, alt: str = "") -> Markup:
    mathml = to_mathml(term, display=display)  # `to_mathml` escapes all text
    return Markup(mathml.replace("<math", f'<math alttext="{escape(alt)}"', 1))


def _svg(picture: Picture) -> Markup:
    """Return the drawing in the colours of the page; matplotlib has escaped its text.

    The drawing's title becomes a label, because browsers show a title wherever the pointer rests.
    """
    named = f'<svg aria-label="{escape(picture.alt)}" '
    svg = _TITLE.sub("", picture.svg, count=1).replace("<svg ", named, 1)
    return Markup(_coloured(svg))


def _coloured(svg: str) -> str:
    svg = svg.replace("#ffffff", "var(--paper)")
    for colour, role in _ROLES.items():
        svg = svg.replace(colour, f"var(--f-{role})")
    return svg


def _tails(table: Table) -> list[str]:
    """Return each column's width from the decimal mark on; "" if it is not aligned on the mark."""
    columns = zip(*table.rows, strict=True)
    return [
        f"{math.ceil(max(_digits_wide(cell.parts[1]) for cell in column))}ch" if how == "d" else ""
        for how, column in zip(table.align, columns, strict=False)
    ]


def _heads(table: Table) -> list[str]:
    """Return the heading that a phone shows before each value of a row; "" for no heading."""
    return [plain(head.text) if table.is_wide else "" for head in table.head]


def _board(board: Tiles) -> str:
    """Return the style of a board: the length of its longest value, and the tiles per row."""
    return f"--least:{board.longest}ch;--across:{board.across}"


def _digits_wide(text: str) -> float:
    return sum(0.5 if c in _NARROW else 1.5 if c in _WIDE else 1.0 for c in text)


@cache
def _math_font() -> str:
    """Return the font for formulas; the fonts of many phones lack large brackets."""
    return base64.b64encode((TEMPLATES / "fonts" / "mathematics.woff").read_bytes()).decode()
