"""What axe finds wrong with a page for those who see it badly, or not at all."""

from typing import Any, NamedTuple

from axe_playwright_python.sync_playwright import Axe

_RUN = "rules => axe.run({resultTypes: ['violations'], ...rules}).then(found => found.violations)"


class Violation(NamedTuple):
    """A rule that a page breaks, by day or by night, and the first elements that do."""

    scheme: str
    rule: str
    impact: str
    targets: list[Any]


def violations(page: Any) -> list[Violation]:
    """Return what axe finds by day, and in the colours by night: nothing else differs then."""
    page.evaluate(Axe().axe_script)
    found = []
    for scheme, rules in (("light", {}), ("dark", {"runOnly": ["color-contrast"]})):
        page.emulate_media(color_scheme=scheme)
        for one in page.evaluate(_RUN, rules):
            targets = [node["target"] for node in one["nodes"]][:3]
            found.append(Violation(scheme, one["id"], one["impact"], targets))
    return found
