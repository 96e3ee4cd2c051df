"""Grade a class: what a batch costs, and what a kill destroys.

    python -m benchmarks.grading_batch [--kills 300]

The command kills the grader with -9 at random moments, and compares the result with that of an
undisturbed run. It works on a copy of the code, because a grade depends on the code that made it.
The tables are part of `benchmarks/grading.py`.
"""

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from pipeline.grading.batch.grade_class import Options, grade_class
from pipeline.grading.grade import grade_text
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.simulated.submission import Students, write_submission

ROOT = Path(__file__).parents[1]
PRESET = "throne-2dof"


def write_class(folder: Path, teams: int, *, preset: str = PRESET) -> None:
    for seed in range(teams):
        write_submission(
            folder / f"team-{seed:03d}",
            preset,
            seed=seed,
            compact=True,
            reported=True,
            students=Students(authors=(f"s{seed}",)),
        )


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Seconds on the clock, and processor seconds of this process and of its workers."""

    clock: float
    parent: float
    workers: float

    @property
    def cpu(self) -> float:
        """Processor seconds of all processes together."""
        return self.parent + self.workers


@contextmanager
def measured(costs: list[Cost]) -> Iterator[None]:
    """Append the cost of the work in this block to `costs`."""
    process = psutil.Process()
    start, before = time.perf_counter(), process.cpu_times()
    yield
    after = process.cpu_times()
    children = (after.children_user + after.children_system) - (
        before.children_user + before.children_system
    )
    costs.append(
        Cost(
            clock=time.perf_counter() - start,
            parent=after.user + after.system - before.user - before.system,
            workers=children,
        )
    )


def grade(
    folder: Path,
    out: Path,
    *,
    preset: str,
    figures: bool = False,
) -> Cost:
    """Grade a class with one worker, and write all files."""
    costs: list[Cost] = []
    with measured(costs):
        grade_class(
            [folder],
            rubric_file=Path(preset),
            out=out,
            options=Options(jobs=1, figures=figures),
        )
    return costs[0]


def kills(base: Path, *, count: int) -> None:
    write_class(base / "class", 6)
    times, lost = random.Random(1), 0
    frozen = base / "frozen"
    for name in ("pipeline", "templates", "rubrics", "submissions"):
        shutil.copytree(ROOT / name, frozen / name, ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pipeline", "grade", str(base / "class"), "--rubric", PRESET]
    for number in range(count):
        out = base / f"out-{number % 10}"
        process = subprocess.Popen(
            [*command, "--jobs", "2", "--out", str(out)], stderr=subprocess.DEVNULL, cwd=frozen
        )
        time.sleep(times.uniform(0.2, 8.0))
        process.kill()
        process.wait()
    whole = _graded(command, base / "whole", frozen)
    for number in range(min(10, count)):
        rows = _graded(command, base / f"out-{number}", frozen)
        lost += rows != whole
        for name in sorted(n for n in rows | whole if rows.get(n) != whole.get(n)):
            print(f"out-{number}: {name} differs")
    print(f"{count} kills: {lost} of {min(10, count)} gradebooks differ from a run left alone")


def _graded(command: list[str], out: Path, code: Path) -> dict[str, bytes]:
    command = [*command, "--jobs", "2", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True, cwd=code)
    files = {
        p.relative_to(out).as_posix(): p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.suffix != ".sqlite"
    }
    with Gradebook(out) as book:
        rows = {f"row {e.submission}": grade_text(e.grade).encode() for e in book.entries()}
    return files | rows


def main() -> None:
    """Kill batches at random moments, and print the results."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--kills", type=int, default=300)
    with tempfile.TemporaryDirectory() as folder:
        kills(Path(folder), count=parser.parse_args().kills)


if __name__ == "__main__":
    main()
