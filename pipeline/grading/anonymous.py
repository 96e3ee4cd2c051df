"""Results without names, and the key that reveals them."""

import hashlib
import re
from base64 import b32encode
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pipeline.grading.grade import Grade
from pipeline.grading.table import csv_text

KEY_FILE = "anonymous-key.csv"
_PREFIX = "anon-"
_SHORTEST = 6  # letters: a thousand submissions rarely need one more
_STRANGER = "another submission"


def pseudonyms(first_keys: Mapping[str, str]) -> dict[str, str]:
    """Return a name for each submission that says nothing about it.

    Parameters
    ----------
    first_keys : by submission, the hash of what was first handed in: whoever has not seen that
        cannot work the name out, and a later hand-in does not change it.
    """
    hashes = {
        name: b32encode(hashlib.sha256(f"anonymous {key}".encode()).digest()).decode().lower()
        for name, key in first_keys.items()
    }
    length = _SHORTEST
    while max(Counter(code[:length] for code in hashes.values()).values(), default=1) > 1:
        length += 1
    return {name: f"{_PREFIX}{code[:length]}" for name, code in hashes.items()}


def anonymise(grade: Grade, names: Mapping[str, str]) -> Grade:
    """Return the grade without authors, and with the names of submissions replaced everywhere.

    What students call their runs and files stays.
    """
    mentioned = {grade.submission: names[grade.submission]}
    for flag in grade.flags:
        if flag.code == "shared_data":
            for other in flag.evidence.get("submissions", ()):
                mentioned[other] = names.get(other, _STRANGER)
    longest_first = sorted(mentioned, key=len, reverse=True)
    pattern = re.compile(rf"(?<!\w)(?:{'|'.join(map(re.escape, longest_first))})(?!\w)")

    def hidden(value: Any) -> Any:
        if isinstance(value, str):
            return pattern.sub(lambda match: mentioned[match[0]], value)
        if isinstance(value, Mapping):
            return {key: hidden(item) for key, item in value.items()}
        return [hidden(item) for item in value] if isinstance(value, list | tuple) else value

    return replace(
        grade,
        submission=names[grade.submission],
        authors=(),
        reason=hidden(grade.reason),
        notes=tuple(hidden(grade.notes)),
        criteria=tuple(replace(c, message=hidden(c.message)) for c in grade.criteria),
        flags=tuple(
            replace(flag, message=hidden(flag.message), evidence=hidden(flag.evidence))
            for flag in grade.flags
        ),
    )


def key_text(names: Mapping[str, str], authors: Mapping[str, tuple[str, ...]]) -> str:
    """Return the key as CSV: for each name that stands in for one, whose it is."""
    rows = sorted((names[name], name, " ".join(authors[name])) for name in names)
    return csv_text(("anonymous", "submission", "authors"), rows)
