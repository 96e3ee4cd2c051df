"""The scripts of a page, and the hashes by which its policy knows them."""

import base64
import hashlib
from collections.abc import Iterable
from functools import cache
from itertools import combinations

from pipeline.resources import TEMPLATES

ALWAYS, EXPLORE, FINDER = "page.js", "explore.js", "finder.js"
_SOMETIMES = (EXPLORE, FINDER)


@cache
def script(*names: str) -> str:
    """Return scripts as the one that stands in a page."""
    return "".join((TEMPLATES / name).read_text(encoding="utf-8") for name in names)


def script_hash(text: str) -> str:
    """Return the hash by which a page's policy knows its one script."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


def every_hash() -> Iterable[str]:
    """Return the hashes of all that may be a page's script."""
    for n in range(len(_SOMETIMES) + 1):
        for names in combinations(_SOMETIMES, n):
            yield script_hash(script(ALWAYS, *names))
