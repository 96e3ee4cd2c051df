"""A class in which each team has a bench of its own, some copy, and one run grades all.

    python -m benchmarks.answer_key [TEAMS]

Of six teams, four are honest. One hands in its own recordings with the neighbour's numbers, and one
hands in the neighbour's recordings and numbers. The answer key judges all. The table shows their
points under the shipped rubric, and under one with tolerances for true values.
"""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.grading.batch.grade_class import Options, grade_class
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.judge.award import read_findings, recompute_points
from pipeline.grading.rubric import Rubric
from pipeline.json_files import json_text
from pipeline.resources import RUBRICS
from pipeline.simulated.answer_key import AnswerKey, changing_key, draw_bench
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import Students, write_submission

PRESET = "throne-2dof"
KINDS = ("honest", "honest", "honest", "numbers copied", "honest", "all copied")
TIGHT = {
    "full_percent": 2.0, "none_percent": 6.0,
    "damping_full_percent": 20.0, "damping_none_percent": 60.0,
}  # fmt: skip
_TABLES = "[reported.initial]"


def main() -> None:
    """Print the points of each kind of team."""
    teams = int(sys.argv[1]) if len(sys.argv) > 1 else 120
    with tempfile.TemporaryDirectory() as folder:
        for kind, shipped, tight in points_of_class(Path(folder), teams=teams):
            print(f"{kind:15} {shipped:6.2f} {tight:6.2f}")


def points_of_class(folder: Path, *, teams: int) -> Iterator[tuple[str, float, float]]:
    """Yield the kind of each team, and its points under the shipped and the tight rubric."""
    _hand_in(folder, teams=teams)
    out = folder / "grades"
    options = Options(jobs=2, figures=False, key=str(folder / "key.json"))
    grade_class(
        [folder / "class"], rubric_file=RUBRICS / f"{PRESET}.toml", out=out, options=options
    )
    with Gradebook(out) as book:
        tight = with_tolerances(book.rubric)
        for number, entry in enumerate(book.entries()):
            findings = read_findings(book.findings(entry))
            again = recompute_points(entry.grade, findings, rubric=tight)
            yield KINDS[number % len(KINDS)], entry.grade.points, again.points


def with_tolerances(rubric: Rubric) -> Rubric:
    """Return the rubric with tolerances for numbers that are compared with true values."""
    criteria = tuple(
        one.model_copy(update=TIGHT) if one.check in ("initial", "final") else one
        for one in rubric.criteria
    )
    return rubric.model_copy(update={"criteria": criteria})


def _hand_in(folder: Path, *, teams: int) -> None:
    """Write the submissions of a class, and the answer key beside them."""
    bench, names = prepare_bench(preset=PRESET), [f"team-{i:03d}" for i in range(teams)]
    key_file = folder / "key.json"
    key_file.write_text(json_text(AnswerKey(secret=PRESET, teams={})), "utf-8")  # always the same
    with changing_key(key_file) as key:
        for name in names:
            rng = key.generator(name, seed=0)
            own, answers = draw_bench(bench, percent=20, rng=rng)
            key.enter(name, answers)
            seed, students = int(rng.integers(2**63)), Students(is_anonymous=True)
            at = folder / "class" / name
            write_submission(at, own, seed=seed, compact=True, reported=True, students=students)
    tomls = {name: folder / "class" / name / "submission.toml" for name in names}
    texts = {name: path.read_text("utf-8") for name, path in tomls.items()}
    for number, (neighbour, name) in enumerate(pairwise(names), start=1):
        kind = KINDS[number % len(KINDS)]
        if kind == "numbers copied":
            measured = texts[name].partition(_TABLES)[0]
            tables = "".join(texts[neighbour].partition(_TABLES)[1:])
            tomls[name].write_text(measured + tables, "utf-8")
        if kind == "all copied":
            shutil.rmtree(folder / "class" / name)
            shutil.copytree(folder / "class" / neighbour, folder / "class" / name)


def summarise(points: list[tuple[str, float, float]]) -> dict[str, np.ndarray]:
    """Return the points under both rubrics, shape (n, 2), of each kind of team."""
    return {kind: np.array([p for k, *p in points if k == kind]) for kind in dict.fromkeys(KINDS)}


if __name__ == "__main__":
    main()
