"""All tools that learn models get the same records and the same measure of error."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.black_boxes import TOOLS, Model, Part, best, error
from benchmarks.page import installed, significant
from pipeline.arrays import Array
from pipeline.gap.parameters import Candidate, Structure, fresh_nuisance, simulate_run
from pipeline.gap.parameters import GapModel as FitModel
from pipeline.gap.runs import make_run
from pipeline.gap.types import Gap
from pipeline.plant.effect import AugmentedChain
from pipeline.results import Record

OURS, LINEAR_CART = "cartlab", "linear"


@dataclass(frozen=True, kw_only=True)
class Answer:
    """One tool's result on one bench; the model is None if all of the tool's models diverge."""

    model: Model | None
    error: float
    seconds: float


def part_of(record: Record, *, first: int = 48) -> Part:
    """Return a record in the form that all tools get; a decay begins at its release."""
    run = make_run(record, n=1)
    u = np.zeros(record.t.size) if record.u is None else record.u
    return Part(
        dt=record.sample_time,
        u=u[-run.t.size :],
        y=run.y[0],
        held=record.hold == "zero_order",
        first=first,
        source=run,
    )


def start_at(model: AugmentedChain, *, springs: tuple[bool, ...]) -> FitModel:
    """Return a model in the form used by the fits: its structure and its vector of parameters."""
    structure = Structure(springs=springs)
    for term in model.terms:
        signs = tuple(float(np.sign(v) or 1.0) for v in term.values)
        sizes = tuple(abs(v) for v in term.values)
        structure = structure.with_effect(
            Candidate(effect=term.effect, place=term.place, signs=signs, scales=sizes)
        )
    return structure.start(model.chain, [term.values for term in model.terms])


def ours(model: AugmentedChain, gap: Gap, *, springs: tuple[bool, ...]) -> Model:
    """Return cartlab's model in a form that runs freely, without any fit to the record.

    The zero of the encoder is the mean over the training records.
    """
    of = start_at(model, springs=springs)
    zero = np.array([np.mean([trace.zero for trace in gap.traces if not trace.held_out])])

    def run(part: Part) -> Array:
        own = replace(part.source, zero=zero)
        return simulate_run(of, own, fresh_nuisance(own))[0]

    return Model(run=run, every=1, words=words_of(gap))


def words_of(gap: Gap) -> str:
    """Return the effects found, with their parameters."""
    found = [
        f"{f.effect.key.replace('_', ' ')} ("
        + ", ".join(
            f"{name.replace('_', ' ')} {v.value:.3g}{f' ± {v.std:.1g}' if v.std else ''} {v.unit}"
            for name, v in f.parameters.items()
        )
        + ")"
        for f in gap.effects
    ]
    return f"**{gap.verdict}**: {', '.join(found) or 'nothing beside the linear cart'}"


def others(
    training: Sequence[Part],
    choosing: Sequence[Part],
    judged: Sequence[Part],
    *,
    settings: Mapping[str, dict[str, tuple[int, ...]]] | None = None,
) -> Iterator[tuple[str, Answer]]:
    """Yield each installed tool's model, chosen by its error on the held-out records.

    If `settings` is given, only the tools that it names are run.
    """
    for name, tool, learn in TOOLS:
        if installed(tool) and (settings is None or name in settings):
            began = time.process_time()
            model = best(learn(training, **(settings or {}).get(name, {})), choosing)
            seconds = time.process_time() - began
            off = np.inf if model is None else error(model, judged) if judged else np.nan
            yield name, Answer(model=model, error=off, seconds=seconds)


def percent(value: float) -> str:
    """Return a share of the motion in percent."""
    return f"{significant(100 * value)} %" if np.isfinite(value) else "diverges"


def left_out(what: str, *, quick: bool, columns: int) -> list[str]:
    """Return a row that says why a part was not measured."""
    why = "in a quick run" if quick else "its recordings are not on this machine"
    return [what, f"left out: {why}", *[""] * (columns - 2)]
