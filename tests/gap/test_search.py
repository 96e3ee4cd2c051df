"""A search: what it leaves out at its end, and what must be worth it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.data.runs import make_run
from pipeline.gap.data.sides import split
from pipeline.gap.fit.baseline import fit_baseline
from pipeline.gap.fit.levenberg_marquardt import Fit
from pipeline.gap.limits import BIC_DROP
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, worth_it
from pipeline.gap.search.search import SURE, prune, search, sureness
from pipeline.gap.search.translate import make_candidate
from pipeline.gap.search.whole import fit_whole
from pipeline.plant.nonlinear.effects import CATALOGUE, find_effect
from tests.truth.bench import Hidden
from tests.truth.cases import make_case

COULOMB, DAHL = ("coulomb_friction", 1), ("presliding_friction", 1)
CUBIC, DELAY = ("cubic_spring", 1), ("input_delay", 0)


def begun(*hidden: Hidden, rate: float = 113.1) -> tuple[Fit, Study]:
    """Return the linear fit and the study of one cart with these effects."""
    case = make_case(seed=46, n=1, effects=hidden, rate=rate)
    runs = [make_run(record, n=1) for record in case.records]
    teach, tell = split(runs)
    fit, training = fit_baseline([runs[i] for i in teach], springs=case.springs, start=None)
    study = Study(
        training=tuple(training),
        held_out=tuple(replace(runs[i], sigma=training[0].sigma) for i in tell),
        springs=case.springs,
        catalogue=CATALOGUE,
        repeatability=0.0,
        mapper=map,
        tell=print,
    )
    return fit, study


def test_what_hides_below_the_floor_is_looked_for():
    """Hardly any friction, beside a delay that alone leaves what may be noise."""
    fit, study = begun(
        Hidden(effect="coulomb_friction", place=1, parameters={"force": 2.4e-6}),
        Hidden(effect="input_delay", parameters={"delay": 0.014}),
        rate=884.7,
    )
    _, judged = search(judge(fit, study), study)
    found = {h.key: h for h in judged}
    alone, both = found[frozenset({DELAY})], found[frozenset({DELAY, COULOMB})]
    assert alone.at_floor
    assert both.bic < alone.bic - BIC_DROP


def test_a_richer_law_that_explains_no_more_gives_way():
    """Dry friction that yields over next to nothing is plain dry friction."""
    fit, study = begun(
        Hidden(effect="coulomb_friction", place=1, parameters={"force": 0.0006}),
        Hidden(effect="input_delay", parameters={"delay": 0.015}),
    )
    chain = fit.structure.chain(fit.theta)
    start = fit
    for key, values in (("input_delay", (0.015,)), ("presliding_friction", (0.0006, 1e-4))):
        effect = find_effect(key)
        place = 0 if effect.place == "input" else 1
        candidate = make_candidate(effect, place, values, runs=study.training, chain=chain)
        start = start.with_effect(candidate, values)
    rich = judge(fit_whole(start, study), study)

    pruned = prune(rich, study, [judge(fit, study)])

    assert rich.key == {DAHL, DELAY}
    assert pruned.key == {COULOMB, DELAY}
    assert pruned.error < 1.01 * rich.error


@pytest.mark.parametrize(("value", "nothing"), [(0.015, False), (1e-4, True)])
def test_what_is_nothing_within_its_error_is_told(value, nothing):
    """A delay is named where it is three standard errors from none."""
    fit, study = begun(Hidden(effect="input_delay", parameters={"delay": 0.015}))
    chain = fit.structure.chain(fit.theta)
    delay = make_candidate(
        find_effect("input_delay"), 0, (value,), runs=study.training, chain=chain
    )
    model = fit.with_effect(delay, (value,))
    known = replace(fit, structure=model.structure, theta=model.theta)
    sure = np.diag(np.full(model.theta.size, (1e-3 / delay.scales[0]) ** 2))

    (found,) = sureness(replace(known, covariance=sure))
    assert (found < SURE) == nothing
    assert sureness(known) == [np.inf]  # without an error nothing is said


def judged(*keys: tuple[str, int], chi: float, held: float, news: float = 100.0) -> Hypothesis:
    """Return a hypothesis with what it leaves of 1000 training and 1000 held-out points."""
    effects = [SimpleNamespace(key=key, effect=find_effect(key[0])) for key in keys]
    fit: Any = SimpleNamespace(chi=chi, structure=SimpleNamespace(effects=effects), n_points=1000.0)
    left: Any = SimpleNamespace(chi=held)
    return Hypothesis(
        fit=fit,
        held=left,
        error=held**0.5,
        bic=100.0 * float(np.log(chi)),
        news=news,
        held_news=news,
        at_floor=max(chi, held) < 1.15,
    )


@pytest.mark.parametrize(
    ("child", "worth"),
    [
        ({"chi": 2.0, "held": 2.0}, True),  # 100 ln 3 on either side
        ({"chi": 2.0, "held": 2.0, "news": 5.0}, False),  # what is left swings: little is news
        ({"chi": 1.0, "held": 7.0}, False),  # of the runs fitted only
        ({"chi": 5.6, "held": 5.7}, False),  # too little for the criterion
    ],
)
def test_an_effect_is_worth_it_by_independent_residuals(child, worth):
    """Of the runs fitted and of those held out; of what the fuller model leaves."""
    parent = judged(CUBIC, chi=6.0, held=6.0)
    both = judged(CUBIC, DELAY, **child)
    study: Any = SimpleNamespace(explains=lambda h: True)
    assert worth_it(both, parent, study) == worth
