"""A document as one self-contained HTML file: no script, nothing loaded from anywhere."""

import base64

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from pipeline.report.document import Document, Picture
from pipeline.report.mathematics import Term, to_mathml
from pipeline.resources import TEMPLATES


def render_html(document: Document) -> str:
    """Return the page; every text is escaped, only our own SVG and MathML are not."""
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["mathml"] = _mathml
    environment.filters["svg"] = _svg
    return environment.get_template("report.html.j2").render(
        document=document, math_font=_math_font()
    )


def _mathml(math: Term, display: bool = False) -> Markup:
    return Markup(to_mathml(math, display=display))  # every leaf is escaped


def _svg(picture: Picture) -> Markup:
    return Markup(picture.svg)  # drawn by matplotlib, which escapes all text


def _math_font() -> str:
    """Return the font of the formulas: many phones have none, and brackets would not grow."""
    return base64.b64encode((TEMPLATES / "fonts" / "mathematics.woff").read_bytes()).decode()
