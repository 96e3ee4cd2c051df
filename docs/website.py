"""The site of `mkdocs build`: the repository's pages at their own paths, loading nothing else.

In the site each page has its path in the repository, so that one relative link serves both.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from griffe import Extension, Object
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from pipeline.plant.nonlinear.effects import CATALOGUE
from pipeline.words.math import to_mathml, to_tex

ROOT = Path(__file__).parents[1]
_SHOWN = (
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
    "docs/*.ipynb",
    "docs/*.json",
    "docs/website.css",
    "docs/images/**/*.*",
    "benchmarks/*.md",
    "benchmarks/figures/*",
    "firmware/*.md",
    "rubrics/*.md",
)
_OUTSIDE = r"""["']?((?:https?:)?//[^"')\s>]+)"""
# Parts that a browser fetches by itself to show a page; links wait for a click.
_FETCHED = re.compile(
    rf"<(?:script|img|iframe|source|video|audio|embed|object|use|image)\b[^>]*?"
    rf"\s(?:xlink:)?(?:src|srcset|href|data)={_OUTSIDE}"
    rf"|<link\b[^>]*?\shref={_OUTSIDE}"
    rf"|(?:url\(|@import)\s*{_OUTSIDE}"
)
# "name : meaning" in one line, as in docstrings here; types are in the annotations.
_ITEM = re.compile(r"^(\w[\w, ]*?) : (.+)$", re.MULTILINE)


class OneLineItems(Extension):
    """Bring one-line items of docstrings into the two lines that numpydoc expects."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring:
            obj.docstring.value = _ITEM.sub(r"\1\n    \2", obj.docstring.value)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Typeset formulas as the program does, and list the pages of the benchmarks."""
    fence = {"name": "math", "class": "math", "format": _formula}
    config.mdx_configs["pymdownx.superfences"] = {"custom_fences": [fence]}
    benchmarks = sorted(ROOT.glob("benchmarks/*.md"))
    config.nav = [
        *(config.nav or ()),
        {"Benchmarks": [path.relative_to(ROOT).as_posix() for path in benchmarks]},
    ]
    return config


def _formula(source: str, *_: Any, **__: Any) -> str:
    laws = {to_tex(effect.formula): effect.formula for effect in CATALOGUE}
    return to_mathml(laws[source.strip()], display=True)


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Put the repository's pages and pictures in place of the files of `docs/`."""
    theme = [file for file in files if file.src_dir != config.docs_dir]
    shown = sorted({path for pattern in _SHOWN for path in ROOT.glob(pattern)})
    return Files(
        theme
        + [
            File(
                path.relative_to(ROOT).as_posix(),
                src_dir=str(ROOT),
                dest_dir=config.site_dir,
                use_directory_urls=config.use_directory_urls,
            )
            for path in shown
        ]
    )


def on_post_build(*, config: MkDocsConfig) -> None:
    """Refuse a site that a browser could not show without the network."""
    found = list(fetched_from_outside(Path(config.site_dir)))
    if found:
        raise PluginError("loaded from outside: " + "; ".join(found))


def fetched_from_outside(site: Path) -> Iterator[str]:
    """Yield file and address of everything that pages, styles and drawings load from elsewhere."""
    for path in sorted(site.rglob("*")):
        if path.suffix in (".html", ".css", ".svg"):
            for match in _FETCHED.finditer(path.read_text(encoding="utf-8")):
                yield f"{path.relative_to(site)}: {next(filter(None, match.groups()))}"
