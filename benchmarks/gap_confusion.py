"""How often the gap workflow names the hidden effects: confusion matrix, remaining errors, times.

    python benchmarks/gap_confusion.py singles --count 300 --jobs 2 --out singles.jsonl

Benches are random, and are simulated by an independent program (tests/truth). Thresholds were set
on seeds that `--report` does not use. A run that was stopped continues where it stopped;
its file has one JSON line per case.
"""

import argparse
import json
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# Several cases run at the same time, so each gets one BLAS thread. Set before numpy is loaded.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

DEVELOPMENT, REPORT = 10_000, 900_000
SUITES = [
    "singles", "small", "tiny", "weak", "dirt", "pairs", "clean", "clean-dirt", "wide", "wide-pairs"
]  # fmt: skip
SEVERITY = {"small": 0.3, "weak": 0.2, "tiny": 0.05}
# On one cart, two of these would act as a single law of friction, so they are never paired.
DRY = ("coulomb_friction", "stiction", "presliding_friction")


def plan(suite: str, index: int) -> tuple[int, tuple[str, ...], float, bool]:
    """Return a case's number of carts, effects and severity, and whether its records are dirty."""
    from tests.truth.cases import EFFECTS

    rng = np.random.default_rng([SUITES.index(suite), index])
    n = 1 + index % 3
    pool = [e for e in EFFECTS if not (n == 1 and e in ("coupling_damper", "sensor_gain"))]
    if suite.startswith("clean"):
        return n, (), 1.0, suite == "clean-dirt"
    dirty = suite.startswith("wide") and bool((index // 3) % 2)
    if suite.endswith("pairs"):
        while True:
            first, second = rng.choice(pool, 2, replace=False)
            if not (first in DRY and second in DRY) and "backlash" not in (first, second):
                return n, (str(first), str(second)), 1.0, dirty
    effect = pool[(index // 3) % len(pool)]
    return n, (effect,), SEVERITY.get(suite, 1.0), suite == "dirt" or dirty


def run_case(job: tuple[str, int, int]) -> dict:
    """Make one case, explain its gap, and return the result together with the hidden effects."""
    suite, index, base = job
    from pipeline.gap.explain import explain_gap
    from pipeline.setup import Setup
    from tests.truth.cases import make_case

    n, effects, severity, dirt = plan(suite, index)
    case = make_case(
        seed=base + index,
        n=n,
        effects=effects,
        severity=severity,
        dirt=dirt,
        wide=suite.startswith("wide"),
    )
    wall, cpu = time.perf_counter(), time.process_time()
    gap = explain_gap(case.records, Setup(springs=case.springs))
    truth = sorted((h.effect, h.place) for h in case.hidden)
    found = sorted((f.effect.key, next(iter(f.where.values()), 0)) for f in gap.effects)
    listed = set(found) | {
        (r.effect.key, next(iter(r.where.values()), 0)) for f in gap.effects for r in f.rivals
    }
    z = []
    for hidden in case.hidden:
        for f in gap.effects:
            if (f.effect.key, next(iter(f.where.values()), 0)) == (hidden.effect, hidden.place):
                for name, true in hidden.parameters.items():
                    if name not in f.parameters:  # internal to a contact, and not reported
                        continue
                    value = f.parameters[name]
                    z.append((value.value - float(true)) / value.std if value.std else None)
    return {
        "suite": suite,
        "base": base,
        "index": index,
        "n": n,
        "truth": truth,
        "hidden": [{k: float(v) for k, v in h.parameters.items()} for h in case.hidden],
        "found": found,
        "verdict": gap.verdict,
        "outcome": outcome(truth, found, listed, gap.verdict, gap.baseline / gap.noise_floor),
        "baseline": gap.baseline / gap.noise_floor,
        "final": gap.final / gap.noise_floor,
        "z": z,
        "rate": 1.0 / case.records[0].sample_time,
        "wall": time.perf_counter() - wall,
        "cpu": time.process_time() - cpu,
    }


def outcome(truth: list, found: list, listed: set, verdict: str, baseline: float) -> str:
    """Classify a case; "equivalent" means that no data can separate the answer from the truth."""
    if verdict == "unexplained":
        return "unexplained"
    if verdict == "partial":
        return "partial, right" if set(found) <= set(map(tuple, truth)) else "partial, wrong"
    if found == truth:
        return "ambiguous, right first" if verdict == "ambiguous" else "exact"
    if not found:
        # A sensor gain that a linear chain reproduces exactly does not count as hidden.
        invisible = all(effect == "sensor_gain" for effect, _ in truth)
        return "equivalent" if invisible and baseline < 1.1 else "missed"
    missing, extra = set(map(tuple, truth)) - set(found), set(found) - set(map(tuple, truth))
    if {e for e, _ in missing} <= {"sensor_gain"} and {e for e, _ in extra} <= {"sensor_gain"}:
        return "equivalent"
    if verdict == "ambiguous" and missing <= listed and len(extra) == len(missing):
        return "ambiguous, right listed"
    if not missing:
        return "spurious extra" if truth else "false positive"
    return "partly" if len(missing) < len(truth) and not extra else "wrong"


def main() -> None:
    parser = argparse.ArgumentParser(description="Confusion matrix of the gap workflow.")
    parser.add_argument("suite", choices=SUITES)
    parser.add_argument("--count", type=int, default=48)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--report", action="store_true", help="the seeds results are quoted for")
    parser.add_argument("--base", type=int, help="other seeds: the first of them")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    base = options.base or (REPORT if options.report else DEVELOPMENT)
    rows = [json.loads(line) for line in options.out.open()] if options.out.exists() else []
    rows = [row for row in rows if row["suite"] == options.suite and row["base"] == base]
    done = {row["index"] for row in rows}
    wanted = range(options.start, options.start + options.count)
    jobs = [(options.suite, i, base) for i in wanted if i not in done]
    with ProcessPoolExecutor(options.jobs) as pool, options.out.open("a") as out:
        for row in pool.map(run_case, jobs):
            out.write(json.dumps(row) + "\n")
            out.flush()
            rows.append(row)
            if row["outcome"] != "exact":
                print(
                    row["index"],
                    row["n"],
                    row["outcome"],
                    row["truth"],
                    row["found"],
                    f"x{row['baseline']:.1f} -> x{row['final']:.2f}",
                    flush=True,
                )
    summarise(rows)


def _name(row: dict) -> str:
    return " + ".join(effect for effect, _ in row["truth"]) or "nothing"


def summarise(rows: list[dict]) -> None:
    """Print outcomes and times by effect and carts, the remaining error, and coverage."""
    outcomes = Counter(row["outcome"] for row in rows)
    print(f"\n{len(rows)} cases: " + ", ".join(f"{k} {v}" for k, v in outcomes.most_common()))
    by_effect: dict[str, Counter] = {}
    for row in rows:
        by_effect.setdefault(_name(row), Counter())[row["outcome"]] += 1
    if len(by_effect) < 25:
        for name, counts in sorted(by_effect.items()):
            times = [
                np.median(cpu)
                for n in (1, 2, 3)
                if (cpu := [r["cpu"] for r in rows if r["n"] == n and _name(r) == name])
            ]
            print(
                f"  {name:22s} "
                + ", ".join(f"{k} {v}" for k, v in counts.most_common())
                + "; s: "
                + ", ".join(f"{t:.1f}" for t in times)
            )
    near = [row["final"] <= 2.0 for row in rows]
    print(f"at most twice the noise left: {sum(near)} of {len(near)}")
    final = np.array([row["final"] for row in rows if row["verdict"] in ("named", "ambiguous")])
    if final.size:
        print(
            f"gap after / floor: median {np.median(final):.3f}, 90 % {np.quantile(final, 0.9):.3f}"
        )
    z = np.array(
        [v for row in rows if row["outcome"] == "exact" for v in row["z"] if v is not None]
    )
    if z.size:
        print(f"parameters within 2 standard errors: {np.mean(np.abs(z) < 2):.1%} of {z.size}")
    for n in (1, 2, 3):
        cpu = [row["cpu"] for row in rows if row["n"] == n]
        if cpu:
            print(f"{n} carts: median {np.median(cpu):.1f} s of one core, most {max(cpu):.1f} s")


if __name__ == "__main__":
    main()
