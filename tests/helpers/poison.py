"""Damage good files at random, for tests of readers that must not trust their input.

All randomness comes from a `random.Random`, so a seed always gives the same case.
"""

import io
import json
import re
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from random import Random
from typing import Any

from pipeline.errors import PipelineError

# A damaged file may take no longer than this, even on a busy machine. A good one takes 2 ms.
MOST_TIME = 10.0  # s of processor time

Files = Mapping[str, bytes]

_MARKS = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "=cmd|'/C calc'!A0",
          "$x$", "[", "](", "`", "*", "|", "#", "\\", "\x00", "\r", "\x1b[31m", "\u202e", "\ufeff",
          "é", "{{ 7*7 }}", "%s", "'; DROP TABLE x;--", "../../etc/passwd", "CON", "nan", "-",
          "")  # fmt: skip
_NUMBERS = ("0", "-0.0", "-1", "1e12", "9.9e11", "-1e12", "1e-12", "1e29", "-9e29", "1.1e-30",
            "1e31", "1e300", "1e-300", "1e400", "nan", "inf", "9" * 40, "9" * 5_000, "0e2", "1_0",
            "1." + "3" * 200, "1,5", "3")  # fmt: skip
_SCALES = (1e-300, 1e-40, 1e-13, 1e-11, 1e11, 1e13, 1e40, 1e300)
_OTHER = ("true", "[]", "{}", "[[]]", "[1, 2, 3]", "2024-01-01", "''", "[" * 500, "{a = 1}")


def damaged(raw: bytes, rng: Random, *, hits: int = 3, more: Sequence[bytes] = ()) -> bytes:
    """Cut, flip, insert, remove or repeat bytes of a file up to this many times.

    `more` are further bytes to insert.
    """
    for _ in range(rng.randint(1, hits)):
        at, n = rng.randrange(len(raw) + 1), rng.randint(1, 60)
        junk = rng.choice([*map(str.encode, (*_MARKS, *_NUMBERS[:20])), *more, rng.randbytes(n)])
        raw = rng.choice([
            raw[:at],
            raw[:at] + junk + raw[at:],
            raw[:at] + junk + raw[at + len(junk) :],
            raw[:at] + raw[at + n :],
            raw[:at] + raw[at // 2 :],
        ])  # fmt: skip
    return raw


def text(rng: Random) -> str:
    """Return a text with markup, a formula or control characters, or a very long one."""
    return rng.choice(_MARKS) * rng.choice([1, 1, 1, 3, 50, 5_000])


def toml_value(rng: Random) -> str:
    """Return a TOML value that a parser accepts in most cases."""
    kind = rng.randrange(4)
    return (
        json.dumps(text(rng)) if kind == 0
        else rng.choice(_OTHER) if kind == 1
        else rng.choice(_NUMBERS)
    )  # fmt: skip


def poisoned_toml(toml: str, rng: Random) -> str:
    """Give a key of a TOML text another value, or remove, double or rename it."""
    lines = toml.split("\n")
    keys = [i for i, line in enumerate(lines) if re.match(r"\s*\w+ = ", line)]
    for i in rng.sample(keys, k=min(len(keys), rng.choice([1, 1, 2, 4]))):
        key, _, value = lines[i].partition(" = ")
        if number := re.search(r"-?\d[\d.e+-]*", value) if rng.random() < 0.4 else None:
            new = value[: number.start()] + rng.choice(_NUMBERS) + value[number.end() :]
        else:
            new = toml_value(rng)
        lines[i] = rng.choice(
            [f"{key} = {new}"] * 6 + ["", f"{lines[i]}\n{lines[i]}", f"x = {new}"]
        )
    return "\n".join(lines)


def poisoned_table(table: str, rng: Random) -> str:
    """Change numbers in a column of a CSV file, its rows or its headings."""
    head, *rows = [line.split(",") for line in table.splitlines()]
    column, scale = rng.randrange(len(head)), rng.choice(_SCALES)
    at, what = rng.randrange(1, len(rows)), rng.randrange(8)
    for i, row in enumerate(rows):
        if what == 0:
            row[column] = f"{float(row[column]) * scale:.9g}"
        elif what == 1:
            row[column] = rng.choice(["0", "1e11", "-1e11"]) if i % 2 else "3"
        elif what == 2 and i >= at:
            row[column] = rows[at][column]
        elif what == 3:
            row[column] = "0"
    if what == 4:
        rows = rows[: rng.choice([0, 1, 2, 8, 40])]
    elif what == 5:
        rows[at][column] = rng.choice(_NUMBERS)
    elif what == 6:
        head[column] = text(rng)
    elif what == 7:
        rng.shuffle(rng.choice([head, rows]))
    return "\n".join(map(",".join, [head, *rows])) + "\n"


def poisoned_json(document: Any, rng: Random) -> Any:
    """Replace a few values at any depth of the document in place."""
    for _ in range(rng.choice([1, 1, 2, 5])):
        here: Any = document
        while True:
            keys = list(here) if isinstance(here, dict) else list(range(len(here)))
            if not keys:
                break
            key = rng.choice(keys)
            if isinstance(here[key], dict | list) and here[key] and rng.random() < 0.9:
                here = here[key]
                continue
            another = deepcopy(rng.choice(list(document.values())))
            here[key] = rng.choice([None, True, -1, 0, 3, 1e308, 1e-308, 10**400, [], {}, [[]], "1",
                                    text(rng), another])  # fmt: skip
            break
    return document


def poisoned(good: Files, rng: Random) -> dict[str, bytes]:
    """Return the files of a submission with some of them damaged."""
    files = dict(good)
    tables = sorted(name for name in files if name.endswith(".csv"))
    steps: tuple[Callable[[], object], ...] = (
        lambda: _change(files, "submission.toml", poisoned_toml, rng),
        lambda: _change(files, "submission.toml", poisoned_toml, rng),
        lambda: _change(files, rng.choice(tables), poisoned_table, rng),
        lambda: _change(files, rng.choice(tables), poisoned_table, rng),
        lambda: _damage(files, rng.choice([*tables, "submission.toml"]), rng),
        lambda: files.update({"notes.md": _notes(rng)}),
        lambda: files.update({rng.choice(["gap.json", "data/x.zip", "a.7z"]): rng.randbytes(500)}),
        lambda: files.pop(rng.choice(sorted(files))),
    )  # fmt: skip
    for _ in range(rng.choice([1, 1, 2, 3])):
        step = rng.choice(steps)
        if set(tables) | {"submission.toml"} <= set(files):
            step()
    return files


def _notes(rng: Random) -> bytes:
    words = (text(rng) + rng.choice("\n  ") for _ in range(rng.choice([1, 9, 2_000])))
    return "".join(words).encode("utf-8", "replace")


def _change(
    files: dict[str, bytes], name: str, change: Callable[[str, Random], str], rng: Random
) -> None:
    files[name] = change(files[name].decode("utf-8", "replace"), rng).encode("utf-8", "replace")


def _damage(files: dict[str, bytes], name: str, rng: Random) -> None:
    files[name] = damaged(files[name], rng)


def zipped(files: Files, rng: Random) -> bytes:
    """Return the files as an archive that may itself be damaged."""
    buffer = io.BytesIO()
    method = rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA])
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, raw in files.items():
            archive.writestr(
                rng.choice([name, f"team/{name}"]) if rng.random() < 0.1 else name, raw
            )
    raw = buffer.getvalue()
    return damaged(raw, rng) if rng.random() < 0.5 else raw


@contextmanager
def few_lines_at_most(most: int = 1) -> Iterator[None]:
    """Accept an error of few lines, and fail on any other exception."""
    message = ""
    began = time.process_time()
    try:
        yield
    except PipelineError as error:
        message = str(error)
    lines = message.splitlines()
    assert len(lines) <= most
    assert all(len(line) < 1_000 for line in lines)
    assert time.process_time() - began < MOST_TIME
