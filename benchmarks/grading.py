"""How often grading names mistakes and spares honest teams, what it costs, and other graders.

Benches cover everything that a lab may have (`tests/helpers/grading_class.py`). Each team is graded
as it is, and then with a few kinds of mistakes in its own recordings and numbers
(`tests/helpers/grading_slips.py`). The command for a closer look:

    python -m benchmarks.grading --start 50000 --count 300 --out grading.jsonl

It writes one JSON line per grading, and prints the flags of each grading that is wrong.
"""

import argparse
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy.stats import beta

from benchmarks import grading_notebooks as notebooks
from benchmarks.grading_batch import grade, write_class
from benchmarks.grading_notebooks import COPIED, Graded, cartlab, nbgrader, otter, write_teams
from benchmarks.grading_points import points
from benchmarks.page import Table, missing, share, spread
from tests.helpers.grading_class import Team, make_team, with_spoilt_data, with_wrong_rubric
from tests.helpers.grading_slips import DOUBLE, OF_SEVERAL_CARTS, ONE_NUMBER, SLIPS

TITLE = "Grading"
WORDS = """
**Does an honest team keep all its points, and is each mistake named correctly?** The classes are
simulated, so every mistake is known.
"""
TOOLS = ("nbgrader", "otter-grader")

HONEST = "honest"
WRONG_RUBRIC = "honest, rubric lacks a spring"  # tested on one of ANEW_EVERY benches
DATA = "data_problem"
ANEW_EVERY = 5
ONE = "one number: "
MISTAKE, ONE_WORDS, TWO_WORDS = (
    "one mistake",
    "one mistake in one number",
    "two mistakes in a table",
)
DATA_WORDS = "spoilt recordings"
GROUPS = (HONEST, WRONG_RUBRIC, MISTAKE, ONE_WORDS, TWO_WORDS, DATA_WORDS)
KINDS = (
    *((code, (slip,)) for code, slip in SLIPS.items()),
    *((ONE + code, (slip,)) for code, slip in ONE_NUMBER.items()),
    *((" + ".join(codes), tuple(SLIPS[code] for code in codes)) for codes in DOUBLE),
)


def tables(*, quick: bool) -> list[Table]:
    """Return mistakes named, points, the cost of a submission, and other graders."""
    with tempfile.TemporaryDirectory() as folder:
        base = Path(folder)
        return [
            mistakes(start=60_000, count=1 if quick else 40),
            points([gradings(960_000 + n, slips=4) for n in range(1 if quick else 40)]),
            costs(
                base / "costs",
                teams=1 if quick else 24,
                ways=WAYS[3:] if quick else WAYS,
            ),
            other_graders(base / "others", honest=1 if quick else 4, each=0 if quick else 2),
        ]


# ------------------------------------------------------------------------------ mistakes


def mistakes(*, start: int, count: int) -> Table:
    """Return how many teams with each kind of mistake got exactly the right flags."""
    rows = [row for seed in range(start, start + count) for row in graded(seed, slips=4)]
    return named_mistakes(rows)


def named_mistakes(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the study, made from its rows."""
    groups: dict[str, list[dict[str, Any]]] = {name: [] for name in GROUPS}
    for row in rows:
        groups[_group(row["kind"])].append(row)
    groups["**all honest**"] = [row for row in rows if not row["codes"]]
    groups["**all mistakes**"] = [row for row in rows if row["codes"]]
    missed = Counter(row["kind"] for row in rows if not _is_right(row))
    of = Counter(row["kind"] for row in rows)
    listed = [f"`{kind}` ({n} of {of[kind]})" for kind, n in missed.most_common() if n > 1]
    listed.append(f"{sum(n == 1 for n in missed.values())} kinds once")
    benches = len({row["seed"] for row in rows})
    slight = len({row["seed"] for row in rows if row.get("friction")})
    return Table(
        title="Mistakes by their names",
        head=["teams", "right (95 %)", "named as the alternative", "other flags too", "no flag"],
        rows=[[name, *_line(group)] for name, group in groups.items() if group],
        note=_MISTAKES.format(
            benches=benches,
            slight=slight,
            missed=", ".join(listed),
            seconds=spread(row["seconds"] for row in rows),
        ),
    )


def _group(kind: str) -> str:
    """Return the row of the table to which a kind of mistake belongs."""
    if kind.startswith(HONEST):
        return WRONG_RUBRIC if kind == WRONG_RUBRIC else HONEST
    if kind == DATA:
        return DATA_WORDS
    if kind.startswith(ONE):
        return ONE_WORDS
    return TWO_WORDS if " + " in kind else MISTAKE


def _is_right(row: dict[str, Any]) -> bool:
    """Return whether a mistake got all its flags, or an honest team no flag."""
    if not row["codes"]:
        return not row["found"]
    return set(row["codes"]) <= set(row["found"])


_MISTAKES = """
{benches} different benches, {slight} of them slightly nonlinear (dry friction up to 2 % of the
force of a small step). They have 1 to 3 carts, ζ from 0.003 to 0.15, 6 to 22 dwells, coarse or
fine encoders and two to four digits. Each team is graded without mistakes, and with up to four
mistakes made with its own recordings. Right: every planted mistake has its flag, and a team
without mistakes has no flag (interval of Clopper and Pearson, 1934). "Named as the alternative":
two mistakes explain the number, and the flag names the planted one second. Not always right:
{missed}. A grading took {seconds} s of a core after the analysis.
"""


def graded(seed: int, *, slips: int) -> Iterator[dict[str, Any]]:
    """Yield the result of each grading of one bench."""
    for kind, team, codes in gradings(seed, slips=slips):
        start = time.process_time()
        grade = team.grade()
        seconds = time.process_time() - start
        or_else = {code for flag in grade.flags for code in flag.evidence.get("or_else", ())}
        yield {
            "seed": seed,
            "kind": kind,
            "friction": bool(team.bench.friction),
            "codes": sorted(codes),
            "found": sorted({flag.code for flag in grade.flags}),
            "or_else": sorted(or_else),
            "points": grade.points / grade.out_of,
            "messages": [flag.message for flag in grade.flags],
            "seconds": seconds,
        }


def gradings(seed: int, *, slips: int) -> Iterator[tuple[str, Team, set[str]]]:
    """Yield (kind, team, right codes) for one bench."""
    team = make_team(seed)
    yield f"{HONEST}, {team.bench.chain.n} carts", team, set()
    for turn in range(slips):
        kind, made = KINDS[(seed * slips + turn) % len(KINDS)]
        codes = kind.removeprefix(ONE).split(" + ")
        if team.bench.chain.n == 1 and not OF_SEVERAL_CARTS.isdisjoint(codes):
            continue
        slipped = replace(team, rng=np.random.default_rng([9, seed, turn]))
        unchanged = False  # the team cannot make one of the mistakes
        for slip in made:
            before, slipped = slipped, slip(slipped)
            unchanged |= slipped.submission is before.submission
        if unchanged:
            continue
        # A team without recordings also gets the flag for missing ones.
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
    *(("grade", {"carts": carts}) for carts in (1, 2, 3)),
    ("grade with figures", {"figures": True, "out": "again"}),
    ("grade again, nothing changed", {"figures": True, "out": "again"}),
)


def costs(base: Path, *, teams: int, ways: Sequence[tuple[str, dict[str, Any]]]) -> Table:
    """Return the cost of a submission: by number of carts, with figures, and when graded again."""
    for carts in sorted({how.get("carts", 2) for _, how in ways}):
        write_class(base / f"{carts}", teams, preset=f"throne-{carts}dof")
    rows = []
    for what, how in ways:
        carts, out = how.get("carts", 2), how.get("out") or f"out-{len(rows)}"
        cost = grade(
            base / f"{carts}",
            base / out,
            preset=f"throne-{carts}dof",
            figures=how.get("figures", False),
        )
        each, here = f"{cost.cpu / teams:.2f}", f"{cost.parent / teams:.2f}"
        rows.append([what, str(carts), each, here])
    return Table(
        title=f"What a submission costs ({teams} submissions)",
        head=["command", "carts", "s of a core each", "of it in the client"],
        rows=rows,
        note="""
One worker, its start included. The client copies, hashes and stores submissions, compares
recordings and writes the pages of the class. [scaling.md](scaling.md) has more workers, and
clusters.
""",
    )


# --------------------------------------------------------------------------------- others


def other_graders(base: Path, *, honest: int, each: int) -> Table:
    """Return the results of nbgrader and otter-grader for the same one-cart class."""
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
        better="""
**Others are better** at variety: they grade any question for which a test can be written, in
several languages. Students can run tests before they submit, and nbgrader has a page for grading
by hand. Their tests do not name mistakes and do not compare submissions.
""",
        note=f"""
One cart: {honest} honest teams, {each} each with {codes}, and {each} that submit two decays of
another team. The notebook has the six numbers of the two tables. Its tests recompute each number
from the team's recordings (`benchmarks/lab_reference.py`) and allow 5 to 15 %. nbgrader runs
`autograde` and `generate_feedback`; otter runs `otter run` for each submission, because `otter
grade` needs Docker. Only cartlab also grades the state model, the controller and the closed loop.
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


# --------------------------------------------------------------------------- a closer look


def main() -> None:
    parser = argparse.ArgumentParser(description="Count mistakes named and honest teams flagged.")
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
