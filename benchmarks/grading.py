"""How often a mistake gets its right name, and an honest team none: a class, by kind.

    python benchmarks/grading.py --start 50000 --count 300 --out grading.jsonl

Benches lie all over what a lab may have (`tests/helpers/grading_class.py`): 1 to 3 carts, damping
ratios from 0.003 to 0.15, 6 to 22 dwells, coarse and fine encoders, a trace of friction, two to
four digits. Each team is graded as it is, honest, and once more for a few kinds of mistake in turn,
made with what the team has in its own hands (`tests/helpers/grading_slips.py`). One JSON line a
grading; at the end a line a kind, with 95 % confidence intervals (Clopper and Pearson, 1934). Where
a number is two mistakes' as well, a flag says both: "or" counts those whose planted one is second.
"""

import argparse
import json
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy.stats import beta

from tests.helpers.grading_class import Team, make_team, with_spoilt_data, with_wrong_rubric
from tests.helpers.grading_slips import DOUBLE, OF_SEVERAL_CARTS, ONE_NUMBER, SLIPS

HONEST = "honest"
WRONG_RUBRIC = "honest, rubric lacks a spring"  # every so many teams, as each is analysed anew
DATA = "data_problem"
ANEW_EVERY = 5
ONE = "one number: "
KINDS = (
    *((code, (slip,)) for code, slip in SLIPS.items()),
    *((ONE + code, (slip,)) for code, slip in ONE_NUMBER.items()),
    *((" + ".join(codes), tuple(SLIPS[code] for code in codes)) for codes in DOUBLE),
)


def gradings(seed: int, *, slips: int) -> Iterator[tuple[str, Team, set[str]]]:
    """Yield (kind, team, codes it should get) of one bench."""
    team = make_team(seed)
    yield f"{HONEST}, {team.bench.chain.n} carts", team, set()
    for turn in range(slips):
        kind, made = KINDS[(seed * slips + turn) % len(KINDS)]
        codes = kind.removeprefix(ONE).split(" + ")
        if team.bench.chain.n == 1 and not OF_SEVERAL_CARTS.isdisjoint(codes):
            continue
        slipped = replace(team, rng=np.random.default_rng([9, seed, turn]))
        unchanged = False  # this team has no way to make one of them
        for slip in made:
            before, slipped = slipped, slip(slipped)
            unchanged |= slipped.submission is before.submission
        if unchanged:
            continue
        # Who hands in no recordings is told so as well.
        beside = {"missing"} if "initial_final_disagree" in codes else set()
        yield kind, slipped, {*codes, *beside}
    if seed % ANEW_EVERY == 0:
        yield DATA, with_spoilt_data(seed), {DATA}
    if seed % ANEW_EVERY == 1 and (other := with_wrong_rubric(seed)) is not None:
        yield WRONG_RUBRIC, other, set()


def interval(hits: int, count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a share."""
    low = beta.ppf(0.025, hits, count - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, count - hits) if hits < count else 1.0
    return float(low), float(high)


def main() -> None:
    parser = argparse.ArgumentParser(description="Name planted mistakes, flag nobody honest.")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--slips", type=int, default=4, help="mistakes made by each team")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows: list[dict] = []
    for seed in range(options.start, options.start + options.count):
        for kind, team, codes in gradings(seed, slips=options.slips):
            start = time.process_time()
            grade = team.grade()
            found = {flag.code for flag in grade.flags}
            rows.append(
                {
                    "seed": seed,
                    "kind": kind,
                    "codes": sorted(codes),
                    "found": sorted(found),
                    "or_else": sorted(
                        {c for f in grade.flags for c in f.evidence.get("or_else", ())}
                    ),
                    "points": grade.points / grade.out_of,
                    "messages": [flag.message for flag in grade.flags],
                    "seconds": time.process_time() - start,
                }
            )
            if found != codes:
                print(seed, kind, "->", sorted(found) or "no flag", team.bench, flush=True)
                for flag in grade.flags:
                    print("     ", flag.message, flush=True)
    if options.out:
        options.out.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    report(rows)


def report(rows: list[dict]) -> None:
    """Print a line a kind: how many got all their codes, others beside, none."""
    print(f"{'kind':44} teams  right code (95 %)         or  others too  no flag")
    kinds = dict.fromkeys(row["kind"] for row in rows)
    for kind in sorted(kinds, key=lambda k: (not k.startswith(HONEST), k)):
        print(_line(kind, [row for row in rows if row["kind"] == kind]))
    print(_line("all honest", [row for row in rows if not row["codes"]]))
    print(_line("all mistakes", [row for row in rows if row["codes"]]))
    seconds = [row["seconds"] for row in rows]
    print(f"CPU s a grading, recordings analysed: {np.median(seconds):.3f} in the median")


def _line(kind: str, rows: list[dict]) -> str:
    honest = not any(row["codes"] for row in rows)
    right = sum(set(row["codes"]) <= set(row["found"]) for row in rows)
    either = sum(set(row["codes"]) <= {*row["found"], *row["or_else"]} for row in rows) - right
    others = sum(bool(set(row["found"]) - set(row["codes"])) for row in rows)
    none = sum(not row["found"] for row in rows)
    hits = none if honest else right
    low, high = interval(hits, len(rows)) if rows else (0.0, 1.0)
    share = 100 * hits / max(len(rows), 1)
    shown = f"{hits:4d} = {share:5.1f} % ({100 * low:.1f}–{100 * high:.1f})"
    return f"{kind:44} {len(rows):5d}  {shown:26}{either:4d}  {others:6d}  {none:7d}"


if __name__ == "__main__":
    main()
