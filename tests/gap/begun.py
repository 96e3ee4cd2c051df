"""One cart with hidden effects, ready for a search: the linear fit and the study."""

from dataclasses import replace

from pipeline.gap.fit import GapFit, fit_baseline
from pipeline.gap.judge import Study, make_candidate
from pipeline.gap.parameters import GapModel
from pipeline.gap.runs import make_run, split
from pipeline.plant.catalogue import CATALOGUE, find_effect
from tests.truth.bench import Hidden
from tests.truth.cases import make_case

COULOMB, DAHL = ("coulomb_friction", 1), ("presliding_friction", 1)
CUBIC, DELAY = ("cubic_spring", 1), ("input_delay", 0)


def begun(*hidden: Hidden, rate: float = 113.1) -> tuple[GapFit, Study]:
    """Return the linear fit and the study of one cart with these effects."""
    case = make_case(seed=46, n=1, effects=hidden, rate=rate)
    runs = [make_run(record, n=1) for record in case.records]
    teach, judge_by = split(runs)
    fit, training = fit_baseline([runs[i] for i in teach], springs=case.springs, start=None)
    study = Study(
        training=tuple(training),
        held_out=tuple(replace(runs[i], sigma=training[0].sigma) for i in judge_by),
        springs=case.springs,
        catalogue=CATALOGUE,
    )
    return fit, study


def with_effects(
    model: GapModel, study: Study, *effects: tuple[tuple[str, int], tuple[float, ...]]
) -> GapModel:
    """Return a model with further effects, each with its name, place and values."""
    chain = model.structure.chain(model.theta)
    for (key, place), values in effects:
        effect = make_candidate(find_effect(key), place, values, runs=study.training, chain=chain)
        model = model.with_effect(effect, values)
    return model
