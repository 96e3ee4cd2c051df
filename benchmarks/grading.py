"""How often a mistake gets its right name and an honest team none, how fast, and what others do.

Benches lie all over what a lab may have (`tests/helpers/grading_class.py`). Each team is graded as
it is, honest, and once more for a few kinds of mistake in turn, made with what the team has in its
own hands (`tests/helpers/grading_slips.py`). To look into one kind:

    python -m benchmarks.grading --start 50000 --count 300 --out grading.jsonl

writes one JSON line a grading, and says of each that went wrong what was flagged.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy.stats import beta

from benchmarks import grading_notebooks as notebooks
from benchmarks.grading_batch import copies, grade, write_class
from benchmarks.grading_notebooks import COPIED, Graded, cartlab, nbgrader, otter, write_teams
from benchmarks.page import Table, installed, missing, share, spread
from tests.helpers.grading_class import Team, make_team, with_spoilt_data, with_wrong_rubric
from tests.helpers.grading_slips import DOUBLE, OF_SEVERAL_CARTS, ONE_NUMBER, SLIPS

TITLE = "Grading"
WORDS = """
Synthetic classes, as a mistake has to be known to be counted. In the first table no two benches
are alike: 1 to 3 carts, damping ratios from 0.003 to 0.15, 6 to 22 dwells, coarse and fine
encoders, a trace of friction, two to four digits; a team makes a mistake with its own recordings
and numbers. A kind with "+" is two mistakes in one table, one with "one number" touches a single
number of it.
"""
TOOLS = ("nbgrader", "otter-grader", "distributed")

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


def tables(*, quick: bool) -> list[Table]:
    """Return who is named, which copies are found, what a hand-in costs, what others make of it."""
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        return [
            mistakes(start=60_000, count=1 if quick else 40),
            copies(base / "copies", teams=2 if quick else 60),
            costs(
                base / "costs",
                teams=1 if quick else 24,
                ways=(*WAYS[4:6], WAYS[7]) if quick else WAYS,
            ),
            other_graders(base / "others", honest=1 if quick else 4, each=0 if quick else 2),
        ]


# ------------------------------------------------------------------------------ mistakes


def mistakes(*, start: int, count: int) -> Table:
    """Return how many teams of each kind got all their codes, and others beside."""
    rows = [row for seed in range(start, start + count) for row in graded(seed, slips=4)]
    kinds = dict.fromkeys(row["kind"] for row in rows)
    groups = {
        kind: [row for row in rows if row["kind"] == kind]
        for kind in sorted(kinds, key=lambda k: (not k.startswith(HONEST), k))
    }
    groups["**all honest**"] = [row for row in rows if not row["codes"]]
    groups["**all mistakes**"] = [row for row in rows if row["codes"]]
    seconds = spread(row["seconds"] for row in rows)
    return Table(
        title="Mistakes by their names",
        head=["kind", "right (95 %)", "or", "other flags too", "no flag"],
        rows=[[kind, *_line(group)] for kind, group in groups.items()],
        note=f"""
Right: all its flags (others beside them are counted apart), and of an honest team none; the
interval is that of Clopper and Pearson (1934). "Or": the number is two mistakes' as well, and the
flag says both, the planted one second. Once its recordings are analysed a grading took {seconds} s
of a core.
""",
    )


def graded(seed: int, *, slips: int) -> Iterator[dict[str, Any]]:
    """Yield what became of each grading of one bench."""
    for kind, team, codes in gradings(seed, slips=slips):
        start = time.process_time()
        grade = team.grade()
        seconds = time.process_time() - start
        or_else = {code for flag in grade.flags for code in flag.evidence.get("or_else", ())}
        yield {
            "seed": seed,
            "kind": kind,
            "codes": sorted(codes),
            "found": sorted({flag.code for flag in grade.flags}),
            "or_else": sorted(or_else),
            "points": grade.points / grade.out_of,
            "messages": [flag.message for flag in grade.flags],
            "seconds": seconds,
        }


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


def _line(rows: list[dict[str, Any]]) -> list[str]:
    honest = not any(row["codes"] for row in rows)
    right = sum(set(row["codes"]) <= set(row["found"]) for row in rows)
    either = sum(set(row["codes"]) <= {*row["found"], *row["or_else"]} for row in rows) - right
    others = sum(bool(set(row["found"]) - set(row["codes"])) for row in rows)
    none = sum(not row["found"] for row in rows)
    hits = none if honest else right
    low, high = interval(hits, len(rows)) if rows else (0.0, 1.0)
    said = f"{share(hits, len(rows))}, {100 * low:.0f}–{100 * high:.0f}"
    return [said, str(either), str(others), str(none)]


# ---------------------------------------------------------------------------------- cost


WAYS: tuple[tuple[str, dict[str, Any]], ...] = (
    *(("one worker", {"carts": carts}) for carts in (1, 2, 3)),
    ("the same with figures", {"figures": True}),
    ("2 workers", {"jobs": 2, "out": "again"}),
    ("the same again, nothing changed", {"jobs": 2, "out": "again"}),
    ("4 workers", {"jobs": 4}),
    *((f"Dask, {n} worker{'s' * (n > 1)}", {"dask": n}) for n in (1, 2, 4)),
)


def costs(base: Path, *, teams: int, ways: Sequence[tuple[str, dict[str, Any]]]) -> Table:
    """Return what a hand-in costs: by carts, by worker processes, here and on Dask, and again."""
    for carts in sorted({how.get("carts", 2) for _, how in ways}):
        write_class(base / f"{carts}", teams, preset=f"throne-{carts}dof")
    rows = []

    def measure(what: str, *, carts: int = 2, out: str = "", **how: Any) -> None:
        preset, out = f"throne-{carts}dof", out or f"out-{len(rows)}"
        cost = grade(base / f"{carts}", base / out, preset=preset, **how)
        each = "–" if "cluster" in how else f"{cost.cpu / teams:.2f}"
        here = f"{cost.parent / teams:.2f}"
        rows.append([what, str(carts), each, here, f"{cost.clock:.1f} s"])

    for what, how in ways:
        if "dask" not in how:
            measure(what, **how)
        elif installed("distributed"):
            with _dask(how["dask"]) as address:
                measure(what, cluster=address)
        else:
            rows.append(missing(what, columns=5))
    return Table(
        title=f"What a hand-in costs, {teams} of them",
        head=["how", "carts", "s of a core each", "of it in the client", "on the clock, all"],
        rows=rows,
        note="""
All processes together, the start of the workers included; the client hashes, stores, compares the
recordings and writes the class's pages. Processors of the workers on a Dask cluster are not the
client's children. The clock has in it whatever else the machine did, which was not the same from
row to row: it does not tell one way from another. What workers and a cluster bring is simulated in
[scaling.md](scaling.md) with the costs of a core.
""",
    )


@contextmanager
def _dask(workers: int) -> Iterator[str]:
    """Yield the address of a cluster on this machine: one thread in each of so many processes."""
    from distributed import LocalCluster

    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=":0")
    try:
        yield cluster.scheduler_address
    finally:
        cluster.close()


# --------------------------------------------------------------------------------- others


def other_graders(base: Path, *, honest: int, each: int) -> Table:
    """Return what nbgrader and otter-grader make of the same one-cart class."""
    base.mkdir(parents=True)
    slips = write_teams(base / "class", honest=honest, each=each)
    rows = []
    for name, grader in (("cartlab", cartlab), ("nbgrader", nbgrader), ("otter-grader", otter)):
        done = grader(base / "class", base)
        rows.append([name, *_judged(done, slips)] if done else missing(name, columns=6))
    codes = ", ".join(f"`{code}`" for code in notebooks.SLIPS)
    return Table(
        title=f"The same {len(slips)} teams in a notebook",
        head=["grader", "s of a core each", "wrong numbers cost points", "said which mistake",
              "copied recordings found", "honest teams that lost points"],
        rows=rows,
        note=f"""
One cart; {honest} honest teams, {each} each with {codes}, and {each} that hand in
two decays of another team. The notebook holds the six numbers of the two tables; a test for each
recomputes it from the team's own recordings (`benchmarks/lab_reference.py`, what a TA would write
with numpy and scipy) and allows 5 to 15 %. nbgrader: `autograde` and `generate_feedback` over
the class; otter: `otter run` for each hand-in, as its `otter grade` needs Docker (and then shares
the work among containers). cartlab grades the state model, the controller and the closed loop
besides, which the notebook does not ask for. What the others do better: they grade any question
that a test can be written for, in several languages, give students tests to run before they hand
in, and nbgrader has a page to grade by hand. They name no mistake because a test says what its
author wrote, and compare no hand-ins with each other.
""",
    )  # fmt: skip


def _judged(done: Graded, slips: dict[str, str]) -> list[str]:
    honest = [team for team, slip in slips.items() if not slip]
    copied = [team for team, slip in slips.items() if slip == COPIED]
    wrong = [team for team, slip in slips.items() if slip and slip != COPIED]
    named = sum(slips[team] in done.named.get(team, ()) for team in wrong)
    found = sum("shared_data" in done.named.get(team, ()) for team in copied)
    return [
        f"{done.cost.cpu / len(slips):.2f}",
        share(sum(team in done.lost for team in wrong), len(wrong)),
        share(named, len(wrong)),
        share(found, len(copied)),
        share(sum(team in done.lost for team in honest), len(honest)),
    ]


# ----------------------------------------------------------------------------- to look into


def main() -> None:
    parser = argparse.ArgumentParser(description="Name planted mistakes, flag nobody honest.")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--slips", type=int, default=4, help="mistakes made by each team")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    with options.out.open("w", encoding="utf-8") as file:
        for seed in range(options.start, options.start + options.count):
            for row in graded(seed, slips=options.slips):
                file.write(json.dumps(row) + "\n")
                if row["found"] != row["codes"]:
                    print(seed, row["kind"], "->", row["found"] or "no flag", flush=True)
                    print(*(f"      {said}" for said in row["messages"]), sep="\n", flush=True)


if __name__ == "__main__":
    main()
