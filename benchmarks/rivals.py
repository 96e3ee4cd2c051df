"""How often a proposed experiment shows which hidden effect acts.

    python -m benchmarks.rivals [--count 480] [--minutes 60]

Each random bench has one or two small hidden effects and records one sweep, as `cartlab explore`
does first. If the verdict is "ambiguous" or "partial", the experiment that `cartlab gap` proposes
is recorded and the search repeated, at most twice. The search knows which springs exist.
An interrupted study continues where it stopped.
"""

import os
import tempfile
import time
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

from benchmarks.drawn import acted, counted, draw, run_study, wilson
from pipeline.errors import PipelineError
from pipeline.experiments.discriminate import propose_for
from pipeline.experiments.plan import load_plan
from pipeline.experiments.propose import renamed
from pipeline.gap.explain import investigate
from pipeline.gap.types import FoundEffect, Gap
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.virtual import VirtualBench, VirtualSession

ROWS = Path(__file__).with_name("rivals.jsonl")
FIRST_SEED = 80_000
SMALL = (0.02, 0.3)  # times the usual size; larger effects are named after one sweep
MORE = 2  # largest number of proposed experiments
OPEN = ("ambiguous", "partial")
BUDGET = 300.0  # s for one search, as in an exploration


def run(seed: int) -> dict:
    """Record a sweep; while several explanations remain, record the proposed experiment."""
    drawn = draw(seed, effects=1 + seed % 2, sizes=SMALL)
    bench = VirtualBench(drawn.bench, seed=seed)
    began, looks = time.process_time(), []
    row = {"carts": bench.description.carts, "hidden": sorted(map(list, drawn.hidden))}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "work"
        session = VirtualSession(folder, bench, springs=drawn.springs)
        try:
            session(["sweep"])
            plan = load_plan(load_submission(folder))
            while True:
                gap = look(folder)
                looks.append(told(gap))
                if gap.verdict not in OPEN or gap.proposal is None or len(looks) > MORE:
                    break
                taken = [e.id for e in load_submission(folder).experiments]
                proposed = renamed([gap.proposal.recording], taken=taken)
                bench.record(folder, proposed, limits=plan.limits)
            row["hidden"] = acted(drawn, load_submission(folder))
        except (PipelineError, AssertionError) as error:
            row["ended"] = f"{type(error).__name__}: {error}"[:200]
    return row | {"looks": looks, "cpu": round(time.process_time() - began, 1)}


def look(folder: Path) -> Gap:
    """Return the gap of these records, with a proposed experiment."""
    submission = load_submission(folder)
    gap = investigate(analyse(submission), progress=lambda text: None, budget=BUDGET)
    return propose_for(gap, submission)


def told(gap: Gap) -> dict:
    """Return a row with a gap's verdict, effects, remaining error and proposed recording."""
    return {
        "verdict": gap.verdict,
        "found": sorted(
            list(counted(f.effect, next(iter(f.where.values()), 0), first_of(f)))
            for f in gap.effects
        ),
        "left": round(gap.final / gap.noise_floor, 3),
        "proposed": gap.proposal and [gap.proposal.recording.id, gap.proposal.separation],
    }


def first_of(found: FoundEffect) -> float:
    """Return the first parameter of an effect."""
    return next(iter(found.parameters.values())).value


def right(row: dict, *, after: int) -> bool:
    """Return whether the hidden effects are named after at most `after` further experiments."""
    last = row["looks"][: after + 1][-1]
    return last["verdict"] == "named" and last["found"] == row["hidden"]


def table(rows: list[dict]) -> str:
    """Return the table of the study, in Markdown."""
    head = ["first verdict", "benches", "named after one more", "after two", "wrong name then"]
    lines = [head, ["---"] * len(head)]
    for words, verdicts in (("ambiguous", OPEN[:1]), ("partial", OPEN[1:]), ("either", OPEN)):
        mine = [row for row in rows if row["looks"] and row["looks"][0]["verdict"] in verdicts]
        n = len(mine)
        wrong = sum(
            row["looks"][-1]["verdict"] == "named" and not right(row, after=MORE) for row in mine
        )
        lines.append(
            [
                words,
                f"{n} of {len(rows)}",
                wilson(sum(right(row, after=1) for row in mine), n),
                wilson(sum(right(row, after=2) for row in mine), n),
                wilson(wrong, n),
            ]
        )
    failed = sum(not row["looks"] for row in rows)
    lines.append(["none: the first look failed", f"{failed} of {len(rows)}", "–", "–", "–"])
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


if __name__ == "__main__":
    run_study(__doc__, "rivals", ROWS, run, table, first=FIRST_SEED, count=480)
