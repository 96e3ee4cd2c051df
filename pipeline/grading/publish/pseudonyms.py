"""Pseudonyms: how they are made, how they replace names in a grade, and the key to them.

The key is a file, and commands accept pseudonyms in place of names.
"""

import hashlib
from base64 import b32encode
from collections import Counter
from collections.abc import Mapping
from typing import Any

from pipeline.grading.grade import Flag, Grade
from pipeline.grading.gradebook.events import Event, hidden_reason
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.similarity.shared_flag import shared_message
from pipeline.output import csv_text

KEY_FILE = "anonymous-key.csv"
_PREFIX = "anon-"
_SHORTEST = 6  # characters: rarely too few, even for a thousand submissions
STRANGER = "another submission"


def pseudonyms(first_keys: Mapping[str, str]) -> dict[str, str]:
    """Return a pseudonym for each submission.

    Parameters
    ----------
    first_keys : for each submission, the hash of its first version. So later versions keep the
        pseudonym, and nobody can compute it from the name.
    """
    hashes = {
        name: b32encode(hashlib.sha256(f"anonymous {key}".encode()).digest()).decode().lower()
        for name, key in first_keys.items()
    }
    length = _SHORTEST
    while max(Counter(code[:length] for code in hashes.values()).values(), default=1) > 1:
        length += 1
    return {name: f"{_PREFIX}{code[:length]}" for name, code in hashes.items()}


def pseudonyms_in(book: Gradebook) -> dict[str, str]:
    """Return the pseudonym of each submission of a class list."""
    return pseudonyms({entry.submission: entry.first_key for entry in book.entries()})


def is_pseudonym(name: str) -> bool:
    """Return whether a name looks like a pseudonym."""
    return name.startswith(_PREFIX)


def anonymise(grade: Grade, names: Mapping[str, str]) -> Grade:
    """Return the grade without the names of submissions and authors.

    These names also occur in two texts: in the flag for shared data, and in the reason why a
    submission could not be graded. In the reason they precede file names, because platforms put the
    student's name into the name of an archive. Names that students gave to runs and files stay.
    """
    own = names[grade.submission]
    hidden = {
        "submission": own,
        "authors": (),
        "reason": hidden_reason(grade.reason, grade.submission, own),
        "flags": tuple(
            _hidden(flag, names) if flag.code == "shared_data" else flag for flag in grade.flags
        ),
    }
    return grade.model_copy(update=hidden)


def _hidden(flag: Flag, names: Mapping[str, str]) -> Flag:
    """Return a flag for shared data with pseudonyms instead of names."""
    others = list(dict.fromkeys(names.get(o, STRANGER) for o in flag.evidence["submissions"]))
    evidence: dict[str, Any] = {"submissions": others}
    for kind in ("recordings", "tables"):
        evidence[kind] = [
            {**one, "submission": names.get(one["submission"], STRANGER)}
            for one in flag.evidence.get(kind, ())
        ]
    return Flag(
        code=flag.code,
        parameters=flag.parameters,
        message=shared_message(evidence),
        evidence=evidence,
    )


def key_text(names: Mapping[str, str], authors: Mapping[str, tuple[str, ...]]) -> str:
    """Return the key as CSV: submission and authors of each pseudonym."""
    rows = sorted((names[name], name, " ".join(authors[name])) for name in names)
    return csv_text(("anonymous", "submission", "authors"), rows)


def resolve_pseudonym(book: Gradebook, team: str) -> str:
    """Return the submission that a pseudonym stands for; any other name is returned unchanged."""
    if not is_pseudonym(team):
        return team
    return {shown: name for name, shown in pseudonyms_in(book).items()}.get(team, team)


def history_of(book: Gradebook, team: str) -> tuple[str, list[Event]]:
    """Return the history of a team, under the name that was asked for.

    If `team` is a pseudonym, the events contain no real names.

    Raises
    ------
    ConfigError : there is no such submission, or there are several.
    """
    hidden = is_pseudonym(team)
    return book.history(resolve_pseudonym(book, team), shown_as=team if hidden else "")
