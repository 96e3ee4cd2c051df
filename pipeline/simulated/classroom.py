"""A small class that shows grading: an honest team, one mistake, one copied recording."""

import re
import shutil
import tempfile
from math import pi
from pathlib import Path

from pipeline.simulated.submission import write_submission

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
