"""The worked examples in `submissions/`.

`python -m pipeline.simulated.examples` writes them again.
"""

import re
import shutil
import tempfile
from dataclasses import dataclass
from math import pi
from pathlib import Path

from pipeline.resources import EXAMPLES
from pipeline.simulated.submission import Students, write_submission

PRESET = "throne-1dof"
# The planted mistake of each submission, to compare with the result of grading.
PLANTED = (
    "team-2 gives its frequencies in Hz",
    "team-3 hands in one of team-2's recordings as its own",
)
_TEAMS = ("team-1", "team-2", "team-3")
_COPIED = Path("data", "decay-1b.csv")
_FREQUENCY = re.compile(r"^omega_n = (.+)$", re.MULTILINE)


def write_class(folder: Path) -> None:
    """Write three submissions from one bench into a new `folder`, all of them or nothing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".class-") as scratch:
        teams = Path(scratch) / "class"
        for seed, team in enumerate(_TEAMS, start=1):
            write_submission(teams / team, PRESET, seed=seed, compact=True, reported=True)
        _in_hertz(teams / "team-2" / "submission.toml")
        shutil.copyfile(teams / "team-2" / _COPIED, teams / "team-3" / _COPIED)
        teams.rename(folder)


def _in_hertz(file: Path) -> None:
    """Divide the reported frequencies by 2π, like a team that forgets the factor."""
    text = file.read_text(encoding="utf-8")
    slip = _FREQUENCY.sub(lambda found: f"omega_n = {float(found[1]) / (2 * pi):.3g}", text)
    file.write_text(slip, encoding="utf-8", newline="\n")


@dataclass(frozen=True, kw_only=True)
class Example:
    """One example: a preset, a seed and its students. Their text is in the folder itself."""

    folder: str
    preset: str
    seed: int
    students: Students


CATALOGUE = (
    Example(
        folder="one-cart",
        preset="throne-1dof",
        seed=11,
        students=Students(
            title="One-cart system, bench 2",
            authors=("s1011", "s1012"),
            springs=(True, True),
        ),
    ),
    Example(
        folder="two-cart",
        preset="throne-2dof",
        seed=22,
        students=Students(
            title="Two-cart system, bench 4",
            authors=("s1024", "s1031"),
            springs=(False, True, True),
        ),
    ),
    Example(
        folder="three-cart",
        preset="throne-3dof",
        seed=33,
        students=Students(
            title="Three-cart system, bench 7",
            authors=("s1042", "s1043", "s1057"),
            springs=(False, True, True, True),
        ),
    ),
)


def write_examples(folder: Path) -> None:
    """Write every example into its own folder in `folder`; the bytes are always the same.

    Their notes are those of the present examples.
    """
    for example in CATALOGUE:
        notes, own = (EXAMPLES / example.folder / "notes.md").read_bytes(), folder / example.folder
        write_submission(
            own,
            example.preset,
            seed=example.seed,
            compact=True,
            reported=True,
            students=example.students,
        )
        (own / "notes.md").write_bytes(notes)


if __name__ == "__main__":
    write_examples(EXAMPLES)
