"""A cart has the same colour in figures, on the live page, and in the desk's thumbnails."""

import re

from pipeline.report.figures import CARTS, MEASURED, MODEL, SECOND, THIRD
from pipeline.resources import TEMPLATES

ROLES = {MODEL: "model", SECOND: "second", THIRD: "third", MEASURED: "ink"}


def sheet(name: str) -> str:
    """Return a style sheet or a script as text."""
    return (TEMPLATES / name).read_text(encoding="utf-8")


def test_pages_have_the_colours_of_the_figures():
    """The report's style sheet gives each cart the colour that it has in figures."""
    rows = re.findall(r"--cart-(\d): var\(--f-(\w+)\);", sheet("report.css"))
    assert rows == [(str(n), ROLES[colour]) for n, (colour, *_) in enumerate(CARTS, start=1)]
    dashes = re.findall(r"--cart-(\d)-dash: ([\d ]+);", sheet("report.css"))
    assert [cart for cart, _ in dashes] == [str(n) for n in range(1, len(CARTS) + 1)]
    assert len({dash for _, dash in dashes}) == len(CARTS)


def test_other_pages_use_the_colours_of_the_style_sheet():
    """Other pages use the style sheet's colours for carts and define none."""
    desk = re.findall(r"\.thumb [^{]*\{[^}]*stroke: var\((--[\w-]+)\)", sheet("desk/desk.css"))
    assert desk == [f"--cart-{n}" for n in range(1, len(CARTS) + 1)]
    assert "colour: `--cart-${i + 1}`, dash: `--cart-${i + 1}-dash`" in sheet("live.js")
    for name in ("live.js", "charts.js", "plots.js"):
        assert re.findall(r"#[0-9a-f]{3,6}\b", sheet(name)) == []
