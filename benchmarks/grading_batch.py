"""Grade a class: what a batch costs, which disguised copies are found, and what a kill destroys.

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
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil

from benchmarks.page import Table
from pipeline.grading.batch.grade_class import Options, grade_class
from pipeline.grading.grade import grade_text
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradings import Member
from pipeline.grading.similarity.prints import fingerprint
from pipeline.grading.similarity.shared import find_shared
from pipeline.ingest.read import read_data
from pipeline.results import Record
from pipeline.simulated.bench import COUNT
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import Students, write_submission
from pipeline.submission import load_submission

ROOT = Path(__file__).parents[1]
PRESET = "throne-2dof"
# Noise added to a copy in encoder steps, and other changes of the copy.
DISGUISES = {
    "as it is": {},
    "cut to 60 %": {"keep": 0.6},
    "shifted, in mm": {"scale": 10.0, "later": 2.5},
    "cut, turned round": {"keep": 0.8, "scale": -1.0},
    "noise 0.5": {"noise": 0.5},
    "noise 1": {"noise": 1.0},
    "noise 1, cut, rescaled": {"noise": 1.0, "keep": 0.8, "scale": 1.3},
    "noise 2": {"noise": 2.0},
}
IN_CLASS = 10  # honest teams in a class, besides the original and its copy
COPIED_KINDS = ("decay", "step", "sweep", "closed_loop")


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


def disguised(
    record: Record,
    rng: np.random.Generator,
    *,
    noise: float = 0.0,
    scale: float = 1.0,
    keep: float = 1.0,
    later: float = 0.0,
) -> Record:
    n = record.t.size
    start = int(rng.integers(0, round((1 - keep) * n) + 1))
    part = slice(start, start + round(keep * n))
    y = (np.array(record.y) + noise * COUNT * rng.standard_normal(record.y.shape)) * scale
    return replace(
        record,
        id=f"copy of {record.id}",
        t=record.t[part] + later,
        u=None if record.u is None else record.u[part],
        y=y[:, part],
        reference=None,
    )


def copies(base: Path, *, teams: int) -> Table:
    """Return which disguised copies are found, and how many honest pairs are flagged."""
    records: list[tuple[Record, ...]] = []
    for seed in range(teams):
        folder = base / str(seed)
        if seed % 3:
            write_submission(folder, PRESET, seed=seed, compact=True)
        else:
            friction = prepare_bench(
                preset=PRESET, model=None, hide=["coulomb_friction:cart=1,force=0.004"]
            )
            write_submission(folder, friction, seed=seed, reported=False)
        records.append(read_data(load_submission(folder)).records)
        shutil.rmtree(folder)

    def prints(name: str, of: tuple[Record, ...]) -> Member:
        return Member(submission=name, authors=(name,), fingerprints=fingerprint(of))

    honest = [prints(str(i), of) for i, of in enumerate(records)]
    false, pairs = sum(map(len, find_shared(honest).values())) // 2, teams * (teams - 1) // 2
    rng, rows = np.random.default_rng(5), []
    for name, options in DISGUISES.items():
        hits: dict[str, list[bool]] = defaultdict(list)
        for number in range(min(teams - 1, 20)):
            own, other = records[number], records[number + 1]
            rest = [*honest[number + 2 :], *honest[:number]][:IN_CLASS]
            whole = tuple(disguised(r, rng, **options) for r in own)
            hits["whole"].append("w" in find_shared([honest[number], prints("w", whole), *rest]))
            for kind in COPIED_KINDS:
                one = disguised(next(r for r in own if r.kind == kind), rng, **options)
                mixed = prints("m", (*other[:6], one))
                hits[kind].append("m" in find_shared([honest[number], mixed, *rest]))
        rows.append([name, *(f"{100 * np.mean(found):.0f} %" for found in hits.values())])
    return Table(
        title="Copied recordings",
        head=["disguise", "all of them", *(f"one {kind}" for kind in COPIED_KINDS)],
        rows=rows,
        note=f"""
{teams} honest teams on one bench of two carts, a third of them with hidden friction: {false} of
{pairs} pairs were flagged. Then {min(teams - 1, 20)} teams are copied, each in a class of
{min(teams, IN_CLASS + 2)}. The copying team takes all recordings, or one that it puts among six
of its own. Added noise is in encoder counts.
""",
    )


def main() -> None:
    """Kill batches at random moments, and print the results."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--kills", type=int, default=300)
    with tempfile.TemporaryDirectory() as folder:
        kills(Path(folder), count=parser.parse_args().kills)


if __name__ == "__main__":
    main()
