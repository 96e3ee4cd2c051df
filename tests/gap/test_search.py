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


def judged(*keys: tuple[str, int], chi: float, held: float, bic: float) -> Hypothesis:
    """Return a hypothesis with what it leaves of training and held-out runs."""
    effects = [SimpleNamespace(key=key, effect=find_effect(key[0])) for key in keys]
    structure: Any = SimpleNamespace(effects=effects, has_contact=("backlash", 0) in keys)
    fit: Any = SimpleNamespace(chi=chi, structure=structure)
    left: Any = SimpleNamespace(chi=held, run_chi=np.full(3, held))
    return Hypothesis(fit=fit, held=left, error=held**0.5, bic=bic, at_floor=max(chi, held) < 1.15)


@pytest.mark.parametrize(
    ("parent", "child", "worth"),
    [
        ((6.0, 11.0), (1.0, 1.9), True),  # noise alone is left with it
        ((6.0, 11.0), (1.0, 3.0), False),  # of the runs fitted only
        ((6.0, 11.0), (2.0, 2.0), False),  # less than there was: the rest of the bounce
        ((40.0, 60.0), (15.0, 14.0), True),  # half the error, where much is left
        ((40.0, 60.0), (15.0, 20.0), False),
        ((5.0, 1.0), (1.0, 0.9), True),  # the runs held out cannot tell
        ((5.0, 1.0), (2.0, 0.9), False),
    ],
)
def test_what_acts_beside_a_contact(parent, child, worth):
    """Its own law is known to a factor, so that others would mop up what it leaves."""
    alone = judged(("backlash", 0), chi=parent[0], held=parent[1], bic=0.0)
    both = judged(("backlash", 0), DELAY, chi=child[0], held=child[1], bic=-1000.0)
    study: Any = SimpleNamespace(explains=lambda h: h.error < 1.5)
    assert worth_it(both, alone, study) == worth


@pytest.mark.parametrize(
    ("first", "bic", "worth"),
    [
        (CUBIC, -110.0, True),
        (CUBIC, -90.0, False),  # too little for the criterion alone
        (("backlash", 0), -1000.0, False),  # the rest of the bounce
    ],
)
def test_what_acts_beside_what_may_be_all(first, bic, worth):
    """Runs held out that are at the noise cannot tell; the criterion must, the more clearly."""
    alone = judged(first, chi=1.1, held=1.05, bic=0.0)
    both = judged(first, DELAY, chi=1.0, held=1.04, bic=bic)
    study: Any = SimpleNamespace(explains=lambda h: True)
    assert worth_it(both, alone, study) == worth
