"""Do rubrics that `cartlab new-rubric` writes give a class the points of the shipped ones?"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.grading import gradings
from benchmarks.page import Table, share
from pipeline.grading.new_rubric import new_rubric
from pipeline.grading.rubric import Rubric
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.grading_class import rubric_of

TITLE = "New rubrics"
WORDS = """
**Does a rubric written from a reference submission give the points of the shipped rubric?** The
reference is a simulated submission of each preset, without reported numbers.
"""
TOOLS = ()
CLOSE = 0.5  # points of 20
Points = tuple[bool, float, float]  # whether the team is honest, and its points of 20 under both


def tables(*, quick: bool) -> list[Table]:
    """Return how close the points of simulated teams are under both rubrics."""
    benches = 1 if quick else 6
    rows = []
    for carts in (1, 2, 3):
        # The carts of a bench follow from its seed.
        seeds = range(970_000 + (carts - 1 - 970_000) % 3, 970_000 + 3 * benches, 3)
        points = compare(written(f"throne-{carts}dof"), seeds=seeds, slips=1 if quick else 4)
        rows.append([f"throne-{carts}dof", *_line(points)])
    return [
        Table(
            title="Points under a new rubric and under the shipped one",
            head=[
                "reference",
                "honest teams within 0.5 of 20",
                "teams with mistakes within 0.5 of 20",
                "largest difference",
                "honest teams with all points: new, shipped",
            ],
            rows=rows,
            note=f"""
{benches} benches for each reference, as in [Grading](README.md): each with an honest team and up to
four mistakes. Both rubrics get the springs of the bench, and require at most 6 dwells.
""",
        )
    ]


def written(preset: str) -> Rubric:
    """Return the rubric that is written from a simulated submission of a preset."""
    with tempfile.TemporaryDirectory() as folder:
        write_submission(Path(folder), preset, seed=7)
        submission = load_submission(Path(folder))
        return new_rubric(submission, analyse(submission, design=False), source=preset).rubric


def compare(rubric: Rubric, *, seeds: Sequence[int], slips: int) -> list[Points]:
    """Return the points of each team of the study under the shipped rubric and another one."""
    found = []
    for seed in seeds:
        for _, team, codes in gradings(seed, slips=slips):
            shipped = team.grade()
            new = replace(team, rubric=rubric_of(team.bench, rubric)).grade()
            both = (20 * one.points / one.out_of for one in (new, shipped))
            found.append((not codes, *both))
    return found


def _line(points: Sequence[Points]) -> list[str]:
    honest = [one for one in points if one[0]]
    others = [one for one in points if not one[0]]
    return [
        *(share(sum(is_close(one) for one in some), len(some)) for some in (honest, others)),
        f"{max(abs(new - shipped) for _, new, shipped in points):.2f}",
        ", ".join(share(sum(one[i] == 20 for one in honest), len(honest)) for i in (1, 2)),
    ]


def is_close(points: Points) -> bool:
    """Return whether both rubrics give a team nearly the same points."""
    _, new, shipped = points
    return abs(new - shipped) <= CLOSE
