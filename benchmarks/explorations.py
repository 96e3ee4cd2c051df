"""How well benches investigate themselves: effects named, errors stated and time needed.

    python -m benchmarks.explorations [--count 100] [--minutes 60]

Each random bench has one to three carts and up to two hidden effects. It has the carts, encoders
and controller of the emulator, simulated tick by tick without a serial line. `cartlab explore`
knows which springs exist, and aims at an error of 1 % in all parameters within ten minutes. An
interrupted study continues where it stopped.
"""

import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import json

import numpy as np

from benchmarks.drawn import Drawn, acted, counted, draw, run_study, wilson
from pipeline.bench.raw import known_commands
from pipeline.errors import DataError, PipelineError
from pipeline.experiments.exploration import Exploration
from pipeline.experiments.information import ErrorGoal
from pipeline.experiments.plan import session_time
from pipeline.experiments.propose import extend_plan, propose_plan
from pipeline.plant.catalogue import find_effect
from pipeline.report.exploration import write_diary
from pipeline.submission import load_submission
from tests.helpers.virtual import LimitPassed, VirtualBench, VirtualSession

ROWS = Path(__file__).with_name("explorations.jsonl")
FIRST_SEED = 71_000
ALLOWED = 600.0  # in s of bench time
SCALE = "sensor_gain"


def run(seed: int) -> dict:
    """Explore one bench; return the verdict and the hidden effects."""
    drawn = draw(seed, effects=seed % 3)
    bench = VirtualBench(drawn.bench, seed=seed)
    began = time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "work"
        session = VirtualSession(folder, bench, springs=drawn.springs)
        row = {"carts": bench.description.carts, "hidden": sorted(map(list, drawn.hidden))}
        try:
            turns = Exploration(
                write_diary=write_diary,
                known_commands=known_commands,
                folder=folder,
                record=session,
                goal=ErrorGoal(),
                seconds=ALLOWED,
                announce=lambda text: None,
            ).run()
        except (PipelineError, AssertionError) as error:
            return row | {"ended": f"{type(error).__name__}: {error}"[:200]}
        submission = load_submission(folder)
        row["hidden"] = acted(drawn, submission)
        # The next proposal of `cartlab plan`: decays by hand and dwells, but no sweep and no steps.
        plan = propose_plan(submission, bench=bench.description)
        try:
            fixed = session_time(extend_plan(plan, submission).recordings)
        except DataError:
            fixed = None  # dwells need a linear chain, but none fits these records
        gap_file = folder / "gap" / "gap.json"
        gap = json.loads(gap_file.read_text(encoding="utf-8")) if gap_file.exists() else {}
    found = [counted_of(effect) for effect in gap.get("effects", ())]
    last = turns[-1].gap
    return row | {
        "verdicts": [turn.gap.verdict if turn.gap else "" for turn in turns],
        "recorded": [list(turn.recorded) for turn in turns],
        "found": sorted(map(list, found)),
        "reached": turns[-1].reached,
        "left": (last.final or 0.0) / (last.noise_floor or 1.0) if last else 0.0,
        "errors": off(gap, drawn),
        "worst": max(e or np.inf for e in turns[-1].errors.values()),
        "seconds": turns[-1].seconds,
        "fixed": fixed,
        "said": turns[-1].summary[:300],
        "cpu": round(time.process_time() - began, 1),
    }


def named_of(effect: dict) -> tuple[str, int]:
    """Return an effect of gap.json and its place."""
    return effect["effect"], next(iter(effect["where"].values()), 0)


def counted_of(effect: dict) -> tuple[str, int]:
    """Return an effect of gap.json and its place, as counted in the study."""
    key, place = named_of(effect)
    first = next(iter(effect["parameters"].values()))["value"]
    return counted(find_effect(key), place, first)


def off(gap: dict, drawn: Drawn) -> dict[str, float]:
    """Return the errors of all chain and effect parameters, in standard errors."""
    chain, errors = drawn.bench.chain, {}
    terms = {(term.effect.key, term.place): term for term in drawn.bench.effects}
    named = {named_of(effect) for effect in gap.get("effects", ())}
    if any(key == SCALE and (key, place) not in named for key, place in terms):
        return {}  # another chain moves in the same way if a sensor's scale is wrong
    if chain.n == 1:  # only the sum of the two springs matters
        chain = replace(chain, k=np.array([chain.k.sum(), 0.0]))
    for letter in "mck":
        for i, true in enumerate(getattr(chain, letter), start=1):
            std = gap.get("chain_std", {}).get(f"{letter}_{i}")
            if std:
                found = gap["chain"][letter][i - 1]
                errors[f"{letter}_{i}"] = (found - float(true)) / std
    for effect in gap.get("effects", ()):
        term = terms.get(named_of(effect))
        for name, true in term.effect.named(term.values).items() if term else ():
            value = effect["parameters"].get(name)
            if value and value.get("std"):
                error = value["value"] - true
                if value["unit"] == "rad":
                    error = (error + np.pi) % (2 * np.pi) - np.pi
                errors[f"{effect['effect']}.{name}"] = error / value["std"]
    return {name: round(float(value), 3) for name, value in errors.items()}


def right(row: dict) -> bool:
    """Return whether exactly the hidden effects are named."""
    verdict = "named" if row["hidden"] else "none"
    return row.get("verdicts", [""])[-1] == verdict and row["found"] == row["hidden"]


def table(rows: list[dict]) -> str:
    """Return the table of the study, in Markdown."""
    head = ["hidden", "benches", "rightly named", "wrongly named", "within 2 standard errors"]
    head += ["1 % reached", "time, median", "over that of decays and dwells"]
    head += ["a limit passed", "another error"]
    lines = [head, ["---"] * len(head)]
    for words, mine in (
        *(
            (("none", "one", "two")[n], [r for r in rows if len(r["hidden"]) == n])
            for n in range(3)
        ),
        ("all", rows),
    ):
        done = [row for row in mine if "verdicts" in row]
        if not done:
            continue
        named = [row for row in done if row["verdicts"][-1] in ("named", "none")]
        z = np.array([z for row in done for z in row["errors"].values()])
        ended = [row["ended"] for row in mine if "ended" in row]
        passed = sum(why.startswith(LimitPassed.__name__) for why in ended)
        lines.append(
            [
                words,
                str(len(mine)),
                wilson(sum(map(right, done)), len(mine)),
                wilson(sum(not right(row) for row in named), len(mine)),
                wilson(int(np.sum(np.abs(z) < 2)), z.size),
                wilson(sum(row["reached"] for row in done), len(mine)),
                f"{np.median([row['seconds'] for row in done]):.0f} s",
                f"{np.median([row['seconds'] / row['fixed'] for row in done if row['fixed']]):.2f}",
                str(passed),
                str(len(ended) - passed),
            ]
        )
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


if __name__ == "__main__":
    run_study(__doc__, "explorations", ROWS, run, table, first=FIRST_SEED, count=100)
