"""Draw random benches with hidden effects, and keep the rows of a study in a file."""

import argparse
import json
import re
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.ingest.read import read_data
from pipeline.output import write_file
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.effect import Effect, EffectTerm
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.emulator import TRUE_PERIOD
from pipeline.simulated.hidden import default_values, prepare_bench
from pipeline.submission import Submission

_SPREAD = 0.3  # scatter of the logarithms of masses, dampings and springs around a preset
USUAL = (0.6, 1.6)  # times the usual size of an effect
# In every driven run, this effect acts as damping of the first cart. A constant force is never
# drawn either, because cartlab finds it from the rest positions.
_UNSEEN = ("drive_damping",)
PAGE = Path(__file__).with_name("next.md")
Named = tuple[str, int]  # an effect and its place


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """A bench, with its springs and hidden effects."""

    bench: SimulatedBench
    springs: tuple[bool, ...]
    hidden: tuple[Named, ...]


def draw(seed: int, *, effects: int, sizes: tuple[float, float] = USUAL) -> Drawn:
    """Draw a bench near a preset with hidden effects, `sizes` times their usual size."""
    rng = np.random.default_rng(seed)
    preset = list(PRESETS)[int(rng.integers(3))]
    bench = prepare_bench(preset=preset, model=None, hide=[])
    m, c, k = (
        values * np.exp(rng.uniform(-_SPREAD, _SPREAD, values.size))
        for values in (bench.chain.m, bench.chain.c, bench.chain.k)
    )
    chain = Chain(m=m, c=c, k=k)
    bench = replace(bench, chain=chain, name=f"drawn-{seed}")
    springs = tuple(bool(one > 0) for one in chain.k)
    terms: list[EffectTerm] = []
    while len(terms) < effects:
        effect = CATALOGUE[int(rng.integers(len(CATALOGUE)))]
        places = effect.places(springs)
        if effect.only_rest or effect.key in _UNSEEN or not places:
            continue
        place = places[int(rng.integers(len(places)))]
        # The size of a limit or a stop is its distance, and a smaller distance has more effect.
        mine = sizes if effect.parameters[0].neutral is not None else USUAL
        term = _sized(effect, place, chain, float(np.exp(rng.uniform(*np.log(mine)))))
        if not any(_alike(term.effect, other.effect) for other in terms):
            terms.append(term)
    hidden = tuple(counted(term.effect, term.place, term.values[0]) for term in terms)
    return Drawn(bench=replace(bench, effects=tuple(terms)), springs=springs, hidden=hidden)


def counted(effect: Effect, place: int, value: float) -> Named:
    """Return the effect's key and place under which the study counts it.

    Effects that the data cannot separate share a key. The data show only ratios of the sensors'
    gains, so all sensors count as one. A lag much shorter than a tick of the bench counts as a
    delay.
    """
    if effect.same_as == effect.key:
        return effect.key, 0
    if effect.same_as and abs(value) < effect.same_below * TRUE_PERIOD:
        return min(effect.key, effect.same_as), place
    return effect.key, place


def acted(drawn: Drawn, submission: Submission) -> list[list]:
    """Return the hidden effects, sorted, without end stops that no cart has reached."""
    records = read_data(submission).records
    missed = set()
    for term in drawn.bench.effects:
        if term.effect.key == "end_stop":
            at = term.values[0]
            positions = [r.position(term.place) for r in records if term.place in r.carts]
            furthest = max((float(np.max(np.sign(at) * x)) for x in positions), default=0.0)
            if furthest < abs(at):
                missed.add((term.effect.key, term.place))
    return sorted(list(one) for one in drawn.hidden if one not in missed)


def _sized(effect: Effect, place: int, chain: Chain, share: float) -> EffectTerm:
    """Return an effect at a share of its usual size.

    Only the parameter that gives the effect its strength is scaled. For dry friction all forces
    are scaled together, because a static force below the sliding force is impossible.
    """
    values = default_values(effect, chain, place=place, travel=1.0)
    forces = [p.name for p in effect.parameters if p.unit == "input"] or [effect.names[0]]
    sized = set(forces if effect.family else forces[:1])
    return EffectTerm(
        effect=effect,
        place=place,
        values=tuple(
            none + share * (values[p.name] - none) if p.name in sized else values[p.name]
            for p in effect.parameters
            for none in [p.neutral or 0.0]
        ),
    )


def _alike(one: Effect, other: Effect) -> bool:
    """Return whether two effects may not be combined: the same family, or two contacts."""
    same_family = bool(one.family) and one.family == other.family
    return one.key == other.key or same_family or (one.contact and other.contact)


def kept_rows(
    path: Path, wanted: Iterable[int], make: Callable[[int], dict], *, until: float
) -> list[dict]:
    """Make the missing rows of a study, add them to its file as JSON lines, and return all rows.

    No new row is begun once the clock (`time.monotonic`) is past `until`.
    """
    rows = {}
    if path.exists():
        rows = {row["seed"]: row for row in map(json.loads, path.open(encoding="utf-8"))}
    with path.open("a", encoding="utf-8") as file:
        for seed in wanted:
            if seed not in rows and time.monotonic() < until:
                rows[seed] = {"seed": seed, **make(seed)}
                file.write(json.dumps(rows[seed]) + "\n")
                file.flush()
                print(rows[seed], flush=True)
    return [rows[seed] for seed in sorted(rows)]


def run_study(
    doc: str | None,
    name: str,
    path: Path,
    make: Callable[[int], dict],
    table: Callable[[list[dict]], str],
    *,
    first: int,
    count: int,
) -> None:
    """Read the command line, add the missing rows of a study, and write its table."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--count", type=int, default=count)
    parser.add_argument("--minutes", type=float, default=np.inf, help="begin no bench after")
    asked = parser.parse_args()
    end = time.monotonic() + 60 * asked.minutes
    seeds = range(first, first + asked.count)
    write_table(name, table(kept_rows(path, seeds, make, until=end)))


def wilson(hits: int, n: int) -> str:
    """Return a share with its 95 % interval (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    if not n:
        return "–"
    z, share = 1.96, hits / n
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    low, high = 100 * max(0.0, middle - half), 100 * min(1.0, middle + half)
    return f"{100 * share:.0f} % ({hits} of {n}; {low:.0f}–{high:.0f} %)"


def write_table(name: str, table: str) -> None:
    """Write a table between its marks in `benchmarks/next.md`."""
    page = PAGE.read_text(encoding="utf-8")
    between = rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)"
    write_file(PAGE, re.sub(between, rf"\1\n{table}\n\n\2", page, flags=re.DOTALL))
