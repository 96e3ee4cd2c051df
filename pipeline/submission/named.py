"""Whose a submission is, where nothing else of it can be read."""

import re
from pathlib import Path

from pipeline.submission.load import MAX_TOML_BYTES, NAME

_TABLE = re.compile(r"\s*\[+\s*([\w.-]+)")
_ID = re.compile(r"""\s*id\s*=\s*["'“”„]?([^"'“”#]+)""")


def named_authors(folder: Path) -> tuple[str, ...]:
    """Return the ids under `[[authors]]` line by line, so that no slip elsewhere hides them.

    Raises
    ------
    OSError : the file cannot be read.
    """
    with (folder / NAME).open(encoding="utf-8-sig", errors="replace") as file:
        text = file.read(MAX_TOML_BYTES)
    found, table = [], ""
    for line in text.splitlines():
        if heading := _TABLE.match(line):
            table = heading[1]
        elif table == "authors" and (id_ := _ID.match(line)):
            found.append(id_[1].strip())
    return tuple(dict.fromkeys(found))
