"""Honest teams on benches with one effect of up to three times its usual size.

They report what they read from their own recordings by textbook methods. Other numbers are taken
from the pipeline.
"""

from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path

import numpy as np

from pipeline.grading.grade import Grade
from pipeline.grading.judge.run import grade_analysis, under_rubric, with_all_springs
from pipeline.grading.mistakes.state_model import own_chain
from pipeline.grading.rubric_file import load_rubric
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import Chain
from pipeline.plant.effect import Effect, EffectTerm
from pipeline.results import Analysis, Estimate
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.hidden import default_values, preset_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import Reported, Submission, load_submission
from pipeline.workflow import analyse
from tests.helpers.grading_class import designed, is_real, state_space, written
from tests.helpers.textbook_student import by_eye, final_table, initial_table

LEAST, MOST = 0.5, 3.0  # times the usual size, at least and at most
DIGITS = 3

# The parameter that makes an effect larger, if it is not the first one.
_GROWS = {
    "stiction": ("force", "static_force"),
    "backlash": ("gap",),
    "extra_mode": ("mass", "stiffness", "damping"),
}
_SHRINKS = {"saturation": "limit", "end_stop": "position"}


def draw_effect(chain: Chain, seed: int) -> EffectTerm:
    """Return the effect for a seed; seeds 0 to 18 give every effect once, then again 19 to 37."""
    rng = np.random.default_rng([16, seed, chain.n])
    turn, place = divmod(seed, len(CATALOGUE))
    effect = CATALOGUE[int(np.random.default_rng([16, turn]).permutation(len(CATALOGUE))[place])]
    places = {
        "input": [0],
        "cart": [*range(1, chain.n + 1)],
        "spring": [j for j, k in enumerate(chain.k, start=1) if k > 0],
    }[effect.place]
    at = int(rng.choice(places))
    size = MOST if seed % 3 == 0 else float(np.exp(rng.uniform(*np.log((LEAST, MOST)))))
    values = _sized(effect, default_values(effect, chain, place=at, travel=1.0), size)
    return EffectTerm(effect=effect, place=at, values=tuple(values[name] for name in effect.names))


def _sized(effect: Effect, usual: Mapping[str, float], size: float) -> dict[str, float]:
    values = dict(usual)
    if effect.key == "sensor_gain":  # a gain of one is no effect
        values["gain"] = 1 + (values["gain"] - 1) * size
    elif effect.key in _SHRINKS:
        values[_SHRINKS[effect.key]] /= size
    else:
        for name in _GROWS.get(effect.key, effect.names[:1]):
            values[name] *= size
    return values


def grade_honest_team(
    folder: Path, *, preset: str, seed: int
) -> tuple[Grade, Analysis, EffectTerm]:
    """Grade the honest team of a seed; return grade, analysis and hidden effect."""
    chain, rubric = preset_bench(preset).chain, load_rubric(Path(preset))
    term = draw_effect(chain, seed)
    write_submission(
        folder,
        SimulatedBench(chain=chain, effects=(term,)),
        seed=seed,
        compact=seed % 2 == 1,
        reported=True,
    )
    submission, _ = under_rubric(load_submission(folder), rubric)
    analysis = with_all_springs(submission, analyse(submission, design=False))[0]
    submission = submission.model_copy(update={"reported": textbook_report(submission, analysis)})
    graded = grade_analysis(submission, analysis, rubric=rubric, name="team")
    return graded.grade, analysis, term


def textbook_report(submission: Submission, analysis: Analysis) -> Reported:
    """Return the numbers that a student reads from these recordings, not the true numbers."""
    claimed, n = submission.reported, analysis.bench.n
    assert claimed is not None
    rows = {row.name: row for row in analysis.rows}
    before = {name: row.initial or row.final for name, row in rows.items()}
    after = {name: row.final or row.initial for name, row in rows.items()}
    careful = _careful(claimed.initial, before)
    first = {**careful, **_read(analysis, n, known=careful)}
    try:
        fitted = final_table(analysis.records, n, dict(first))
    except (ValueError, KeyError, IndexError, FloatingPointError, np.linalg.LinAlgError):
        fitted = {}
    careful = _careful(claimed.final, after)
    last = {**careful, **_possible(fitted, known=careful)}
    own = own_chain(last, n=n)
    space, feedback = claimed.state_space, claimed.feedback
    if own is not None and is_real(own):
        space = state_space(*own.state_space()[:2], digits=4)
        feedback = designed(submission, own) or feedback
    return claimed.model_copy(
        update={
            "initial": _typed(first),
            "final": _typed(last),
            "state_space": space,
            "feedback": feedback,
        }
    )


def _careful(
    claimed: Mapping[str, Decimal], found: Mapping[str, Estimate | None]
) -> dict[str, float]:
    known = {name: one.value for name, one in found.items() if one is not None and one.value > 0}
    return {name: known.get(name, float(typed)) for name, typed in claimed.items()}


def _read(analysis: Analysis, n: int, *, known: Mapping[str, float]) -> dict[str, float]:
    read = initial_table(analysis.records, n)
    try:
        read |= by_eye(analysis.records, n) if n > 1 else {}
    except ValueError:  # no dwell moves every cart far enough
        pass
    return _possible(read, known=known)


def _possible(table: Mapping[str, float], *, known: Mapping[str, float]) -> dict[str, float]:
    return {x: v for x, v in table.items() if x in known and np.isfinite(v) and v > 0}


def _typed(table: Mapping[str, float]) -> dict[str, Decimal]:
    return {name: written(value, DIGITS) for name, value in table.items()}
