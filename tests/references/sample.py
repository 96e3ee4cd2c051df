"""The small sample, with committed facts."""

import json
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.references.cases import Case, gap_sample, sample
from tests.references.facts import Facts, differences, rounded

SAMPLE = Path(__file__).with_name("sample.json")
ACCEPT = "python -m tests.references accept"
# Another computer's linear algebra differs in the last bits, which a fit enlarges. A printed number
# has four digits.
_WITHIN = 1e-4
_DIGITS = 6
_NUMBERS = re.compile(r"\[\n[^\[\]{}]*\]")


def facts_of(cases: Callable[[Path], Iterator[Case]]) -> Facts:
    """Return the facts of some cases, rounded, as JSON would return them."""
    with tempfile.TemporaryDirectory() as scratch:
        home = Path(scratch)
        facts = {one.name: one.facts(home / one.name) for one in cases(home / "inputs")}
    return rounded(json.loads(json.dumps(facts)), digits=_DIGITS)


def moved(cases: Callable[[Path], Iterator[Case]]) -> list[str]:
    """Return a line for each fact of these cases that differs from the committed one."""
    new = facts_of(cases)
    old = {name: one for name, one in read_sample().items() if name in new}
    return list(differences(old, new, within=_WITHIN))


def read_sample() -> Facts:
    """Return the committed facts."""
    return json.loads(SAMPLE.read_text(encoding="utf-8"))


def accept() -> Path:
    """Write the committed facts again; return their file."""
    facts = facts_of(sample) | facts_of(gap_sample)
    text = json.dumps(facts, ensure_ascii=False, indent=0, separators=(",", ":"), sort_keys=True)
    SAMPLE.write_text(
        _NUMBERS.sub(lambda found: found[0].replace("\n", ""), text) + "\n",
        encoding="utf-8",
        newline="\n",
    )
    return SAMPLE
