"""Find copied submissions in simulated classes, and count honest pairs that are flagged.

    python -m benchmarks.copies CACHE [--seed 5000] [--classes 15] [--honest] [--copies]

A class is twelve teams on one bench. Every third honest class mixes teams of several benches, two
or more of them on the same one. The motion of a class is simulated once for each seed and kept in
the folder CACHE, so use other seeds for development than for a report.
"""

import argparse
import pickle
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.grading.gradings import Grading
from pipeline.grading.similarity.copies import find_copies
from pipeline.grading.similarity.fingerprints import fingerprint
from pipeline.results import Record
from pipeline.simulated.bench import COUNT
from pipeline.simulated.hidden import prepare_bench
from tests.helpers.bench_classes import Moved, move_class, read_class

TEAMS = 12
BENCHES = [
    ("throne-1dof", ""),
    ("throne-2dof", ""),
    ("throne-3dof", ""),
    ("throne-1dof", "backlash"),
    ("throne-3dof", "backlash"),
    ("throne-2dof", "coulomb_friction"),
    ("throne-3dof", "saturation"),
    ("throne-2dof", "stiction"),
    ("throne-1dof", "cubic_spring"),
    ("throne-3dof", "slack_spring"),
    ("throne-2dof", "actuator_lag"),
    ("throne-3dof", "input_delay"),
    ("throne-1dof", "coulomb_friction"),
    ("throne-2dof", "dead_zone"),
    ("throne-2dof", "backlash"),
]
# Encoder noise in counts, and encoder steps.
READ = [(0.2, COUNT), (0.04, COUNT), (0.2, 1 / 50)]
DISGUISES = {
    "noise 0.3": {"noise": 0.3},
    "noise 1": {"noise": 1.0},
    "noise 3": {"noise": 3.0},
    "noise 1, smoothed over 5": {"noise": 1.0, "smooth": 5},
    "noise 3, smoothed over 5": {"noise": 3.0, "smooth": 5},
    "noise 1, cut to 80 %, × -1.3": {"noise": 1.0, "keep": 0.8, "scale": -1.3},
    "noise 3, cut to 80 %, × -1.3": {"noise": 3.0, "keep": 0.8, "scale": -1.3},
    "noise 0.3, resampled × 2": {"noise": 0.3, "double": True},
    "half and half": {"blend": 0.5},
    "half and half, noise 1": {"blend": 0.5, "noise": 1.0},
}

Team = Sequence[Record]


def moved_class(cache: Path, number: int, *, seed: int) -> Moved:
    """Return the motion of a class on one bench, from the cache if it is there."""
    file = cache / f"{seed}-{number}.pickle"
    preset, effect = BENCHES[number % len(BENCHES)]
    if not file.exists():
        first = seed + 100 * number
        moved = move_class(preset, effect, seeds=range(first, first + TEAMS))
        cache.mkdir(parents=True, exist_ok=True)
        file.write_bytes(pickle.dumps(moved.teams))
    bench = prepare_bench(preset=preset, hide=(effect,) if effect else ())
    return Moved(bench=bench, teams=pickle.loads(file.read_bytes()))


def disguised(
    team: Team, other: Team, rng: np.random.Generator, *, noise: float = 0.0, smooth: int = 1,
    keep: float = 1.0, scale: float = 1.0, double: bool = False, blend: float = 0.0,
    count: float = COUNT,
) -> list[Record]:  # fmt: skip
    """Return a copy of a team's recordings; `blend` is the share of the other team's."""
    made = []
    for one, beside in zip(team, other, strict=True):
        n = min(one.t.size, beside.t.size) if blend else one.t.size
        t, y = one.t[:n], np.array(one.y[:, :n])
        if blend:
            y = (1 - blend) * y + blend * beside.y[:, :n]
        y += noise * count * rng.standard_normal(y.shape)
        y = np.array([np.convolve(row, np.full(smooth, 1 / smooth), "same") for row in y])
        if double:
            fine = np.linspace(t[0], t[-1], 2 * n - 1)
            t, y = fine, np.array([np.interp(fine, t, row) for row in y])
        start = int(rng.integers(0, round((1 - keep) * t.size) + 1))
        part = slice(start, start + round(keep * t.size))
        u, reference = (
            None if x is None else np.interp(t[part], one.t, x) for x in (one.u, one.reference)
        )
        made.append(replace(one, t=t[part], y=scale * y[:, part], u=u, reference=reference))
    return made


def member(name: str, team: Team) -> Grading:
    return Grading(submission=name, authors=(f"s-{name}",), fingerprints=fingerprint(team))


def honest_class(cache: Path, number: int, *, seed: int, classes: int) -> list[Grading]:
    """Return a class of honest teams; every third one mixes the teams of several benches."""
    noise, count = READ[number % len(READ)]
    at = number % classes
    if number % 3 < 2:
        teams = read_class(
            moved_class(cache, at, seed=seed), seed=seed + number, noise=noise, count=count
        )
    else:
        preset = BENCHES[at % len(BENCHES)][0]
        same = [k for k in range(classes) if BENCHES[k % len(BENCHES)][0] == preset]
        read = [read_class(moved_class(cache, k, seed=seed), seed=seed + number + k) for k in same]
        teams = [read[i // 2 % len(read)][i] for i in range(TEAMS)]
    return [member(str(i), team) for i, team in enumerate(teams)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cache", type=Path)
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--classes", type=int, default=len(BENCHES))
    parser.add_argument("--honest", type=int, default=0, help="number of honest classes")
    parser.add_argument("--copies", action="store_true")
    asked = parser.parse_args()
    flagged = 0
    for number in range(asked.honest):
        batch = honest_class(asked.cache, number, seed=asked.seed, classes=asked.classes)
        found = find_copies(batch)
        flagged += bool(found)
        print(f"honest class {number + 1}: {sorted(found)}", flush=True)
    if asked.honest:
        print(f"{flagged} of {asked.honest} honest classes have a flag")
    hits: dict[str, list[bool]] = defaultdict(list)
    for number in range(asked.classes if asked.copies else 0):
        teams = read_class(moved_class(asked.cache, number, seed=asked.seed), seed=asked.seed)
        honest = [member(str(i), team) for i, team in enumerate(teams)]
        rng = np.random.default_rng([asked.seed, number])
        for name, how in DISGUISES.items():
            copy = member("copy", disguised(teams[0], teams[1], rng, **how))
            expected = {"0", "1", "copy"} if "blend" in how else {"0", "copy"}
            found = set(find_copies([honest[0], copy, *honest[1:]]))
            hits[name].append("copy" in found and found <= expected)
        print(number, BENCHES[number % len(BENCHES)], {k: v[-1] for k, v in hits.items()})
    for name, found in hits.items():
        print(f"{name}: {sum(found)} of {len(found)}")


if __name__ == "__main__":
    main()
