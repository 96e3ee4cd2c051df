"""Hooks of `mkdocs build`, which makes a website that loads nothing from other hosts.

Each page has the same path in the site as in the repository, so relative links work in both.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from griffe import Extension, Object
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from pipeline.plant.catalogue import CATALOGUE
from pipeline.words.math import to_mathml, to_tex

ROOT = Path(__file__).parents[1]
_SHOWN = (
    "README.md",
    "AGENTS.md",
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
# Parts of a page that a browser loads by itself, unlike links.
_FETCHED = re.compile(
    rf"<(?:script|img|iframe|source|video|audio|embed|object|use|image)\b[^>]*?"
    rf"\s(?:xlink:)?(?:src|srcset|href|data)={_OUTSIDE}"
    rf"|<link\b[^>]*?\shref={_OUTSIDE}"
    rf"|(?:url\(|@import)\s*{_OUTSIDE}"
)
# Docstrings of this project describe an argument in one line, "name : meaning", without types.
_ITEM = re.compile(r"^(\w[\w, ]*?) : (.+)$", re.MULTILINE)


class OneLineItems(Extension):
    """Split one-line items of docstrings into the two lines that numpydoc expects."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring:
            obj.docstring.value = _ITEM.sub(r"\1\n    \2", obj.docstring.value)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Typeset formulas as the program does, and add the benchmarks to the navigation."""
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
    """Use pages and pictures of the whole repository instead of the files in `docs/`."""
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
    """Fail if the site would load anything from another host."""
    found = list(fetched_from_outside(Path(config.site_dir)))
    if found:
        raise PluginError("loaded from outside: " + "; ".join(found))


def fetched_from_outside(site: Path) -> Iterator[str]:
    """Yield file and address of everything that the site would load from another host."""
    for path in sorted(site.rglob("*")):
        if path.suffix in (".html", ".css", ".svg"):
            for match in _FETCHED.finditer(path.read_text(encoding="utf-8")):
                yield f"{path.relative_to(site)}: {next(filter(None, match.groups()))}"
