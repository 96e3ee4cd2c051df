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
    """One example: a preset, a seed, and the text of its students."""

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
            notes="""\
## Discussion

Cart 1 sits between two springs. We let it go by hand twice and found a damping ratio near 0.1
both times, and the Bode fit agrees with it. Only the sum of the two spring constants can be found
from our data, because both push on the same cart.

The static gain from the steps and from the fit differ by less than one percent. Near the
resonance we had to turn the input down to 6 mV to stay within 1 cm.

Under state feedback the cart settles about where the model says. It does **not** settle exactly
there, which we put down to the error of our static gain.
""",
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
            notes="""\
## Discussion

There is no spring between the wall and cart 1 on our bench, so cart 1 only feels the spring to
cart 2. That is why K_1 is larger than K_2.

- We guessed 0.10 for both damping ratios of the two-cart system, as in the handout. For the first
  resonance this was a good guess, for the second it was three times too much.
- The null of cart 1 lies at the frequency that cart 2 has on its own, as it should: there cart 2
  works as an absorber.
- Above the second resonance cart 2 moves less and less, so we had to turn the input up to 0.3 V.

In closed loop cart 2 follows the step, while cart 1 goes half as far again to get it there.
""",
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
            notes="""\
## Discussion

We fitted cart 3 first, then cart 2, then cart 1. Our first estimates of the gains and of the
frequencies were within a few percent of the fit. The damping ratios were not: we had guessed 0.10
for all of them and found 0.25 for the slowest resonance but only 0.03 for the fastest.

The 4 Hz run shows what steady state means. For the first two seconds the carts still swing at
their own frequencies on top of the 4 Hz, and reading an amplitude there gives a wrong gain.

We controlled cart 2. It follows the 1 cm step well; cart 3 goes only half as far, which no
controller can change, because at rest the springs alone decide where cart 3 stands.

## zeta_a

Below 7 rad/s all three carts show it: they rise to only about twice their static gain there. With
0.10 they would have risen to five times, so the two or three dwells nearest to 7 rad/s would do.
""",
        ),
    ),
)


def write_examples(folder: Path) -> None:
    """Write every example into its own folder in `folder`; the bytes are always the same."""
    for example in CATALOGUE:
        write_submission(
            folder / example.folder,
            example.preset,
            seed=example.seed,
            compact=True,
            reported=True,
            students=example.students,
        )


if __name__ == "__main__":
    write_examples(EXAMPLES)
