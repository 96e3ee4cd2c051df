"""Keep what the program says of many inputs, and compare it with what another version says.

    python -m tests.references save FOLDER       in the old checkout: some minutes
    python -m tests.references compare FOLDER    in the new one; lists each fact that differs
    python -m tests.references accept            write the sample of the tests again

Recordings are simulated once, by `save`, so that a change of the simulator shows only where it is
tested. Name beginnings of cases (`report`, `gap/cubic`) to run only those.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

from tests.references.cases import Case, everything
from tests.references.facts import differences
from tests.references.sample import accept

_WITHIN = 1e-6  # share of a number by which it may move between two versions on one machine


def main() -> int:
    """Save, compare or accept; return 1 if a fact differs."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("save", "compare", "accept"))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("cases", nargs="*", help="beginnings of names of cases")
    parser.add_argument("--within", type=float, default=_WITHIN, help="allowed change, as a share")
    asked = parser.parse_args()
    if asked.what == "accept":
        sys.stdout.write(f"wrote {accept()}\n")
        return 0
    if asked.folder is None:
        parser.error("needs a folder")
    folder = asked.folder.resolve()
    chosen = [
        one
        for one in everything(folder / "inputs")
        if one.name.startswith(tuple(asked.cases) or ("",))
    ]
    if asked.what == "save":
        save(chosen, folder / "facts")
        return 0
    return compare(chosen, folder / "facts", within=asked.within)


def save(cases: Iterable[Case], folder: Path) -> None:
    """Write the facts of each case to a file."""
    for one in cases:
        file = folder / f"{one.name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(_facts(one), ensure_ascii=False, indent=1), encoding="utf-8")


def compare(cases: Iterable[Case], folder: Path, *, within: float) -> int:
    """Write a line for each fact that differs from the saved ones; return 1 if any does."""
    found = 0
    for one in cases:
        old = json.loads((folder / f"{one.name}.json").read_text(encoding="utf-8"))
        for line in differences(old, _facts(one), within=within):
            sys.stdout.write(f"{one.name}: {line}\n")
            found += 1
    sys.stdout.write(f"{found} differences\n")
    return min(found, 1)


def _facts(one: Case) -> object:
    with tempfile.TemporaryDirectory() as scratch:
        return json.loads(json.dumps(one.facts(Path(scratch))))


if __name__ == "__main__":
    sys.exit(main())
