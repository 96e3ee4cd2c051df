"""Find the faults of a page for readers with poor or no sight, with the program axe."""

from typing import Any, NamedTuple

from axe_playwright_python.sync_playwright import Axe

# Figures are images with their own text, and the rows of a table are similar, as are formulas.
# Without the drawings, the rows after the fourth and the formulas after the tenth, axe takes a
# tenth of the time. All are put back afterwards.
_THIN = """() => {
  const spare = document.querySelectorAll('figure svg > *, tbody tr:nth-child(n + 5)');
  const formulas = [...document.querySelectorAll('math')].slice(10);
  window.spare = [...spare, ...formulas].map((it) => [it, it.previousSibling, it.parentNode]);
  for (const [it] of window.spare) it.remove();
}"""
_WHOLE = """() => {
  for (const [it, before, parent] of window.spare)
    parent.insertBefore(it, before ? before.nextSibling : parent.firstChild);
}"""
_RUN = "rules => axe.run({resultTypes: ['violations'], ...rules}).then(found => found.violations)"


class Violation(NamedTuple):
    """A rule that a page breaks, in light or dark mode, and the first elements that break it."""

    scheme: str
    rule: str
    impact: str
    targets: list[Any]


def violations(page: Any) -> list[Violation]:
    """Return the faults found by axe in light mode, and the faults of contrast in dark mode."""
    if not page.evaluate("'axe' in window"):
        page.evaluate(Axe().axe_script)
    page.evaluate(_THIN)
    found = []
    for scheme, rules in (("light", {}), ("dark", {"runOnly": ["color-contrast"]})):
        page.emulate_media(color_scheme=scheme)
        for one in page.evaluate(_RUN, rules):
            targets = [node["target"] for node in one["nodes"]][:3]
            found.append(Violation(scheme, one["id"], one["impact"], targets))
    page.evaluate(_WHOLE)
    return found
