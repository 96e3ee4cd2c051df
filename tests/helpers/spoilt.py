"""Spoil the recordings and the text of a good submission."""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipeline.arrays import Array

Columns = dict[str, Array]
Spoil = Callable[[Columns], Columns]


def files(folder: Path, start: str = "") -> list[Path]:
    """Return the recordings of a submission whose names begin so."""
    return sorted((folder / "data").glob(f"{start}*.csv"))


def spoil(paths: Sequence[Path], how: Spoil) -> set[str]:
    """Change data files and write them again; return the names of their experiments."""
    for path in paths:
        with path.open(encoding="utf-8", newline="") as text:
            heading, *rows = csv.reader(text)
        values = how(dict(zip(heading, np.array(rows, dtype=np.float64).T, strict=True)))
        rows = np.array([*values.values()]).T.tolist()
        lines = [",".join(heading), *(",".join(map(repr, row)) for row in rows)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {path.stem for path in paths}


def times(factor: float, *names: str) -> Spoil:
    """Multiply some columns, where they are."""
    return lambda columns: {
        name: factor * values if name in names else values for name, values in columns.items()
    }


def change(folder: Path, old: str, new: str, count: int = -1) -> None:
    """Change the text of `submission.toml`."""
    path = folder / "submission.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, count), encoding="utf-8", newline="\n")
