"""How fast a batch is, what it stands, and how well shared recordings are found.

    python -m benchmarks.grading_batch speed [--preset throne-2dof] [--teams 40] [--copies 1000]
    python -m benchmarks.grading_batch kills [--kills 300]
    python -m benchmarks.grading_batch shared [--teams 200]

`speed`: submissions a second of one core's time, two jobs against one, a run with nothing changed,
memory over a long run; on a busy machine believe the times of the processor.
`kills`: kill -9 at random moments, then compare with a run left alone; all of it on a copy of the
code, as a grade belongs to the code that made it.
`shared`: honest teams on one bench (a third of them with hidden friction) and disguised copies.
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

from pipeline.grading.batch.grade_class import grade_class
from pipeline.grading.batch.runner import Limits, grade_batch, run_here
from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradings import Member
from pipeline.grading.intake.hand_ins import find_hand_ins
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.similarity.prints import fingerprint
from pipeline.grading.similarity.shared import find_shared
from pipeline.ingest.read import read_data
from pipeline.results import Record
from pipeline.schemas.grade import grade_text
from pipeline.submission import load_submission
from pipeline.synthesis import COUNT, write_submission
from pipeline.synthesis.hidden import prepare_bench, write_bench

ROOT = Path(__file__).parents[1]
PRESET = "throne-2dof"
# Noise added to a copy, in encoder steps, and what else is done to it.
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


def write_class(folder: Path, teams: int, *, preset: str = PRESET) -> None:
    for seed in range(teams):
        write_submission(
            folder / f"team-{seed:03d}",
            chain=preset,
            seed=seed,
            authors=(f"s{seed}",),
            compact=True,
            reported=True,
        )


@dataclass(frozen=True, kw_only=True)
class Cost:
    """Seconds on the clock, and of the processor: this process and its workers."""

    clock: float
    parent: float
    workers: float

    @property
    def cpu(self) -> float:
        """Seconds of the processor, all processes together."""
        return self.parent + self.workers

    def __str__(self) -> str:
        return f"{self.clock:.1f} s, {self.cpu:.1f} s of the processor, {self.parent:.2f} here"


@contextmanager
def measured(costs: list[Cost]) -> Iterator[None]:
    """Add what a stretch of work costs."""
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


def grade(folder: Path, out: Path, *, preset: str, jobs: int) -> Cost:
    """Grade a class without figures, all files written."""
    costs: list[Cost] = []
    with measured(costs):
        grade_class(
            [folder],
            rubric_file=Path(preset),
            out=out,
            jobs=jobs,
            cluster=None,
            limits=Limits(),
            figures=False,
            progress=lambda *_: None,
        )
    return costs[0]


def memory(folder: Path, out: Path, *, preset: str) -> tuple[Cost, list[float]]:
    """Grade a class with two jobs; return the MB that all processes held after each hand-in.

    Only the grading: of copies all recordings are shared, and naming them would take the time.
    """
    process, costs, used = psutil.Process(), [], []

    def progress(done: int, total: int, last: str) -> None:
        family = (process, *process.children())
        used.append(sum(p.memory_info().rss for p in family) / 1e6)

    scratch = out / "scratch"
    scratch.mkdir(parents=True)
    with Gradebook(out, create=True) as book, measured(costs):
        grade_batch(
            find_hand_ins([folder], scratch=scratch),
            rubric=load_rubric(Path(preset)),
            book=book,
            scratch=scratch,
            execute=run_here(jobs=2),
            progress=progress,
        )
    return costs[0], used


def speed(base: Path, *, preset: str, teams: int, copies: int) -> None:
    write_class(base / "class", teams, preset=preset)
    one = grade(base / "class", base / "one", preset=preset, jobs=1)
    two = grade(base / "class", base / "two", preset=preset, jobs=2)
    again = grade(base / "class", base / "two", preset=preset, jobs=2)
    print(f"{teams} submissions, {preset}, one job: {one}: {teams / one.cpu:.2f} a second and core")
    print(f"two jobs: {two}: {one.clock / two.clock:.2f} times as fast")
    print(f"nothing changed: {again}: {one.cpu / again.cpu:.0f} times less of the processor")
    if copies:
        for number in range(copies):
            source = base / "class" / f"team-{number % teams:03d}"
            target = base / "many" / f"team-{number:04d}"
            shutil.copytree(source, target)
            (target / "notes.md").write_text(f"number {number}", encoding="utf-8")
        cost, used = memory(base / "many", base / "out-many", preset=preset)
        marks = [used[round(share * (copies - 1))] for share in (0.1, 0.25, 0.5, 0.75, 1.0)]
        print(f"{copies} in one run: {cost}; MB at 10, 25, 50, 75, 100 %:", *map(round, marks))


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


def shared(base: Path, *, teams: int) -> None:
    records: list[tuple[Record, ...]] = []
    for seed in range(teams):
        folder = base / str(seed)
        if seed % 3:
            write_submission(folder, chain=PRESET, seed=seed, compact=True)
        else:
            friction = prepare_bench(
                preset=PRESET, model=None, hide=["coulomb_friction:cart=1,force=0.004"]
            )
            write_bench(folder, friction, seed=seed, reported=False)
        records.append(read_data(load_submission(folder)).records)
        shutil.rmtree(folder)

    def prints(name: str, of: tuple[Record, ...]) -> Member:
        return Member(submission=name, authors=(name,), fingerprints=fingerprint(of))

    honest = [prints(str(i), of) for i, of in enumerate(records)]
    start = time.process_time()
    found = find_shared(honest)
    pairs = teams * (teams - 1) // 2
    print(f"{teams} honest teams: {sum(map(len, found.values())) // 2} false pairs of {pairs}, "
          f"{time.process_time() - start:.1f} s")  # fmt: skip
    rng = np.random.default_rng(5)
    for name, options in DISGUISES.items():
        hits: dict[str, list[bool]] = defaultdict(list)
        for number in range(min(teams - 1, 20)):
            own, other = records[number], records[number + 1]
            whole = tuple(disguised(r, rng, **options) for r in own)
            hits["whole"].append(bool(find_shared([honest[number], prints("w", whole)])))
            for kind in ("decay", "step", "sweep", "closed_loop"):
                one = disguised(next(r for r in own if r.kind == kind), rng, **options)
                mixed = prints("m", (*other[:6], one))
                hits[kind].append("m" in find_shared([honest[number], mixed]))
        shares = ", ".join(f"{k} {100 * np.mean(v):.0f} %" for k, v in hits.items())
        print(f"{name}: {shares}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("speed", "kills", "shared"))
    parser.add_argument("--preset", default=PRESET)
    parser.add_argument("--teams", type=int, default=40)
    parser.add_argument("--copies", type=int, default=0)
    parser.add_argument("--kills", type=int, default=300)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        if options.what == "speed":
            speed(base, preset=options.preset, teams=options.teams, copies=options.copies)
        elif options.what == "kills":
            kills(base, count=options.kills)
        else:
            shared(base, teams=options.teams)


if __name__ == "__main__":
    main()
