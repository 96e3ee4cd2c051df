"""Judge a team by the true values of its own bench, which an answer key holds.

A number that somebody copies from another team is then wrong, whatever the recordings show.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import TypeAdapter

from pipeline.errors import ConfigError
from pipeline.grading import limits
from pipeline.grading.gradings import HandIn
from pipeline.grading.reference import TRUE, Reference, References, recompute
from pipeline.ingest.columns import conversion
from pipeline.json_files import json_text
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.plant.effect import EffectTerm, evaluate
from pipeline.results import Analysis, Finding
from pipeline.simulated.answer_key import TeamBench, changing_key, draw_bench, read_key
from pipeline.submission import System, load_submission
from pipeline.words.progress import Progress

if TYPE_CHECKING:
    from pipeline.simulated.bench import SimulatedBench


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueBench:
    """The bench of a team, in the units of its submission.

    Attributes
    ----------
    found : the values that an analysis of the recordings of this bench gives.
    effects : the hidden effects; None if their units do not convert to those of the submission.
    """

    chain: Chain
    parameters: Mapping[str, float]
    found: Mapping[str, float]
    effects: Sequence[EffectTerm] | None
    is_linear: bool

    @classmethod
    def read(cls, text: str, system: System) -> "TrueBench":
        """Return the bench that `with_benches` turned into text."""
        bench = TypeAdapter(TeamBench).validate_json(text)
        length = conversion(bench.units.position, system.position.unit)
        drive = conversion(bench.units.input, system.input.unit)
        gain = (length or 1.0) / (drive or 1.0)
        chain = bench.model.chain

        def scaled(values: Mapping[str, float]) -> dict[str, float]:
            return {n: v * gain if read_name(n).is_gain else v for n, v in values.items()}

        return cls(
            chain=Chain(m=chain.m / gain, c=chain.c / gain, k=chain.k / gain),
            parameters=scaled(bench.parameters),
            found=scaled(bench.found),
            effects=[_converted(term, length, drive) for term in bench.model.terms]
            if length and drive
            else None,
            is_linear=not bench.model.terms,
        )

    def shows_in(self, measured: References) -> bool:
        """Return whether recordings are of this bench: three of four numbers agree with it."""
        expected = {**self.parameters, **self.found}
        apart = [
            abs(np.log(one.value / expected[name]))
            for name, one in measured.final.items()
            if name in expected and not read_name(name).is_damping and one.value > 0
        ]
        limit = limits.OTHER_BENCH if self.is_linear else limits.OTHER_BENCH_WITH_EFFECTS
        return not apart or bool(np.percentile(apart, 75) <= np.log(limit))

    def references(self, references: References, *, is_own: bool) -> References:
        """Return references at the true values.

        Their bounds include what recordings of this bench show, so that honest readings are right.
        """

        def true(name: str, one: Reference) -> Reference:
            value = self.parameters.get(name)
            if value is None:
                return one
            if is_own:
                return replace(one.including(value), value=value, source=TRUE)
            return Reference.at(value, source=TRUE).including(self.found.get(name, value))

        def table(of: Mapping[str, Reference]) -> dict[str, Reference]:
            return {name: true(name, one) for name, one in of.items()}

        return References(initial=table(references.initial), final=table(references.final))


def _converted(term: EffectTerm, length: float, drive: float) -> EffectTerm:
    """Return an effect in other units of length and input, given the size of the old ones."""
    sizes = {"position": length, "input": drive, "s": 1.0, "rad": 1.0}

    def factor(unit: str) -> float:  # of input s^2/position, say
        return evaluate(unit.replace(" ", "*").replace("^", "**") or "1", sizes)

    parts = zip(term.values, term.effect.parameters, strict=True)
    return replace(term, values=tuple(value * factor(one.unit) for value, one in parts))


def recordings_of_others(analysis: Analysis) -> dict[str, Finding]:
    """Return the finding of each recording if the recordings are not of the team's bench."""
    ids = [record.id for record in analysis.records]
    return {id_: Finding(code="other_bench", run=id_, excludes="wrong") for id_ in ids}


def write_team(
    out: Path,
    prepare: "Callable[[np.random.Generator], SimulatedBench]",
    *,
    percent: float,
    key: Path,
    seed: int,
    reported: bool,
    progress: Progress,
) -> None:
    """Write the submission of a team, whose bench only the answer key knows.

    Parameters
    ----------
    prepare : function that returns the bench to vary; it may draw what is hidden in it.

    Raises
    ------
    ConfigError : the key is in the team's folder or no key, or has another bench for the team.
    """
    from pipeline.simulated.submission import Students, write_submission
    from pipeline.workflow import analyse

    team = out.resolve().name
    if key.resolve().is_relative_to(out.resolve()):
        raise ConfigError(f"{key}: is in the team's folder; students would read it")
    with changing_key(key) as answer_key:
        rng = answer_key.generator(team, seed=seed)
        own, answers = draw_bench(prepare(rng), percent=percent, rng=rng)
        answer_key.enter(team, answers)
        progress(f"simulating the experiments of {team}")
        noise = int(rng.integers(2**63))
        students = Students(title="Identification of carts on springs", is_anonymous=True)
        write_submission(out, own, seed=noise, reported=reported, students=students)
        analysis = analyse(load_submission(out), design=False, progress=progress)
        found = {name: one.value for name, one in recompute(analysis).final.items()}
        answer_key.teams[team] = replace(answers, found=found)


def with_benches(hand_ins: Sequence[HandIn], key: Path) -> tuple[list[HandIn], tuple[str, ...]]:
    """Return the hand-ins with their benches, and the names of those that the key lacks.

    Raises
    ------
    ConfigError : the file is not an answer key.
    """
    teams = {name.casefold(): json_text(one) for name, one in read_key(key).teams.items()}
    found = [replace(one, bench=teams.get(one.id.casefold(), "")) for one in hand_ins]
    return found, tuple(one.id for one in found if not one.bench)
