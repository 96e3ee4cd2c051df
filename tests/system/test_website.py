"""The website loads nothing from other hosts, and shows the program's own catalogue of effects."""

import pytest

from docs.effects_page import IMAGES, effects_page
from pipeline.plant.catalogue import CATALOGUE
from tests.helpers.places import ROOT


def test_the_page_of_effects_is_the_catalogue():
    """`docs/effects.md` is what `docs/effects_page.py` writes, and each effect has its picture."""
    page = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    assert page == effects_page(), "run python -m docs.effects_page"
    pictures = {path.stem for path in (ROOT / "docs" / IMAGES).iterdir()}
    assert pictures == {effect.key for effect in CATALOGUE}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.html", '<script async src="https://cdn.example.org/a.js"></script>'),
        ("a.html", "<link rel=stylesheet href=//fonts.example.org/css>"),
        ("a.html", '<p><img alt="" src="http://example.org/a.png"></p>'),
        ("a.css", '@import "https://example.org/a.css";'),
        ("a.css", "a { background: url(https://example.org/a.png) }"),
        ("a.svg", '<svg><image xlink:href="https://example.org/a.png"/></svg>'),
    ],
)
def test_loading_from_another_host_fails_the_build(name, text, tmp_path):
    """If a page would load a script, style, picture or font from another host, the build fails."""
    website = pytest.importorskip("docs.website", reason="the site needs cartlab[docs]")
    (tmp_path / name).write_text(text, encoding="utf-8")
    (found,) = website.fetched_from_outside(tmp_path)
    assert found.startswith(f"{name}: ")
    assert "example.org" in found


def test_links_and_local_files_are_allowed(tmp_path):
    """Links to other sites, namespaces and local files do not count as loading from outside."""
    website = pytest.importorskip("docs.website", reason="the site needs cartlab[docs]")
    (tmp_path / "a.html").write_text(
        '<a href="https://example.org">there</a> <img src="../a.png"> <script src="a.js"></script>'
        '<svg xmlns="http://www.w3.org/2000/svg"></svg>',
        encoding="utf-8",
    )
    assert list(website.fetched_from_outside(tmp_path)) == []
