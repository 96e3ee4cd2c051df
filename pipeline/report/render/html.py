"""A document as one self-contained HTML file: nothing loaded from anywhere, one script of ours.

The page's policy knows the script by its hash.
"""

import base64
import hashlib
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from pipeline.report.document import Block, Document, Picture, Table, Tiles, flat
from pipeline.report.figures.style import MEASURED, MODEL, QUIET, SECOND, SHADE, THIRD
from pipeline.report.figures.ticks import GRID
from pipeline.resources import TEMPLATES
from pipeline.words.math import Term, to_mathml
from pipeline.words.numbers import unbroken
from pipeline.words.spans import plain

# The style sheet says what each colour is in light and in dark.
_ROLES = {
    MEASURED: "ink", MODEL: "model", SECOND: "second", THIRD: "third", QUIET: "quiet",
    SHADE: "shade", GRID: "grid", "#444444": "axis", "#555555": "mark",
}  # fmt: skip
ALWAYS, EXPLORE, FINDER = "page.js", "explore.js", "finder.js"
_SOMETIMES = (EXPLORE, FINDER)
PLOTS = ("uplot.min.js", "plots.js")  # of the page of plots, which has no others
_TITLE = re.compile(r"<title>.*?</title>", re.DOTALL)
_NARROW = " .,()"  # half a digit wide
_WIDE = "±×%"  # wider than a digit


def render_html(document: Document) -> str:
    """Return the page; every text is escaped, only our own SVG, MathML and script are not."""
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
    """Return blocks as a piece of a page that is not ours, such as a notebook; no script."""
    return _environment().get_template("fragment.html.j2").render(blocks=blocks)


def render_plots(**values: object) -> str:
    """Return the page of plots to look through; every value is escaped."""
    text = script(*PLOTS)
    page = _environment().get_template("plots.html.j2")
    return page.render(script=Markup(text), script_hash=Markup(script_hash(text)), **values)


def render_text(template: str, **values: object) -> str:
    """Return a text of ours, nothing in it escaped."""
    return _environment().overlay(autoescape=False).get_template(template).render(**values)


def render_blocks(blocks: Sequence[Block]) -> Markup:
    """Return blocks for a page that has the report's style sheet, and allows no style in itself."""
    plain = [
        replace(block, align=block.align.replace("d", "r")) if isinstance(block, Table) else block
        for block in blocks
    ]
    return Markup(_environment().get_template("blocks.html.j2").module.render_all(plain))  # type: ignore[attr-defined]


def render_drawing(svg: str) -> str:
    """Return a drawing as a file of its own, in the colours of the page by day and by night."""
    css = (TEMPLATES / "report.css").read_text(encoding="utf-8")
    colours = css[: css.index("* {")] + "text { fill: var(--f-ink); }"
    return _coloured(svg).replace("</title>", f"</title><style>{colours}</style>", 1)


@cache
def script(*names: str) -> str:
    """Join scripts into the one of a page."""
    return "".join((TEMPLATES / name).read_text(encoding="utf-8") for name in names)


def script_hash(text: str) -> str:
    """Return the hash by which a page's policy knows its one script."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def every_hash() -> Iterable[str]:
    """Return the hashes of all that may be a page's script."""
    for n in range(len(_SOMETIMES) + 1):
        for names in combinations(_SOMETIMES, n):
            yield script_hash(script(ALWAYS, *names))
    yield script_hash(script(*PLOTS))


def _scripts(document: Document) -> list[str]:
    """Return the scripts that a page has something for."""
    blocks = [block for section in document.sections for block in flat(section.blocks)]
    names = [ALWAYS]
    if any(isinstance(block, Picture) for block in blocks):
        names.append(EXPLORE)
    if any(isinstance(block, Table) and block.finder for block in blocks):
        names.append(FINDER)
    return names


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
        "unbroken": unbroken,
    }  # fmt: skip
    return environment


def _mathml(term: Term, display: bool = False, alt: str = "") -> Markup:
    mathml = to_mathml(term, display=display)  # every leaf is escaped
    return Markup(mathml.replace("<math", f'<math alttext="{escape(alt)}"', 1))


def _svg(picture: Picture) -> Markup:
    """Return the drawing, which matplotlib has escaped, in the colours of the page.

    Its title becomes a label: browsers show a title wherever the pointer rests.
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
    """Return the width from the decimal mark on for each column, "" without decimals."""
    columns = zip(*table.rows, strict=True)
    return [
        f"{math.ceil(max(_digits_wide(cell.parts[1]) for cell in column))}ch" if how == "d" else ""
        for how, column in zip(table.align, columns, strict=False)
    ]


def _heads(table: Table) -> list[str]:
    """Return the heading that a phone shows before each value of a row, or ""."""
    return [plain(head.text) if table.told else "" for head in table.head]


def _board(board: Tiles) -> str:
    """Return how a board is laid out: letters of the longest value, and tiles side by side."""
    return f"--least:{board.longest}ch;--across:{board.across}"


def _digits_wide(text: str) -> float:
    return sum(0.5 if c in _NARROW else 1.5 if c in _WIDE else 1.0 for c in text)


@cache
def _math_font() -> str:
    """Return the font of the formulas; without it many phones cannot grow brackets."""
    return base64.b64encode((TEMPLATES / "fonts" / "mathematics.woff").read_bytes()).decode()
