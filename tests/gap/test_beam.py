"""The order of a search, as a table of hypotheses; and what it leaves out at its end."""

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
from pipeline.gap.search.beam import _exchanged, _leads_on, by_promise, prune, search
from pipeline.gap.search.grow import fit_whole
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, worth_it
from pipeline.gap.search.screen import candidates_at
from pipeline.plant.nonlinear.effects import CATALOGUE, find_effect
from tests.truth.bench import Hidden
from tests.truth.cases import make_case

COULOMB, DAHL = ("coulomb_friction", 1), ("presliding_friction", 1)
CUBIC, DELAY, LAG = ("cubic_spring", 1), ("input_delay", 0), ("actuator_lag", 0)
STUDY: Any = SimpleNamespace(explains=lambda h: False)


def hypothesis(*keys: tuple[str, int], error: float, bic: float, chi: float = 100.0) -> Any:
    """Return what the order of a search depends on: no fit is made here."""
    effects = [SimpleNamespace(key=key, effect=find_effect(key[0]), place=key[1]) for key in keys]
    fit = SimpleNamespace(chi=chi, structure=SimpleNamespace(effects=effects))
    return SimpleNamespace(key=frozenset(keys), error=error, bic=bic, fit=fit)


def order(*waiting: Any) -> list[set[tuple[str, int]]]:
    """Return the effects of those who are grown, in their order."""
    return [set(h.key) for h in by_promise(waiting, {h.key: h for h in waiting}, STUDY)]


def test_a_whole_that_explains_no_more_than_its_part_leads_astray():
    """By the criterion alone the whole would be grown; on runs not seen its part does as well."""
    part = hypothesis(DAHL, error=0.047, bic=-100)
    useless = hypothesis(DAHL, CUBIC, error=0.046, bic=-200)
    useful = hypothesis(DAHL, CUBIC, error=0.03, bic=-200)
    other = hypothesis(DELAY, error=0.08, bic=-10)
    assert order(part, useless, other) == [{DAHL}, {DELAY}]
    assert order(part, useful, other) == [{DAHL, CUBIC}, {DAHL}, {DELAY}]


def test_of_one_family_of_laws_the_best_is_grown():
    """Friction that yields before it slides stands for friction; what is hopeless is left."""
    plain = hypothesis(COULOMB, error=0.06, bic=-50)
    rich = hypothesis(DAHL, error=0.04, bic=-100)
    far = hypothesis(DELAY, error=0.1, bic=-20, chi=1000.0)
    assert order(plain, rich, far) == [{DAHL}]


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
    found = {h.key: h for h in search(judge(fit, study), study)}
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
        candidate, _ = candidates_at(effect, place, runs=study.training, chain=chain)[0]
        start = start.with_effect(candidate, values)
    rich = judge(fit_whole(start, study), study)

    pruned = prune(rich, study)

    assert rich.key == {DAHL, DELAY}
    assert pruned.key == {COULOMB, DELAY}
    assert pruned.error < 1.01 * rich.error


def test_which_of_two_lookalikes_came_first_does_not_stay():
    """A lag found before the spring that bends gives way to the delay that is there."""
    fit, study = begun(
        Hidden(effect="cubic_spring", place=1, parameters={"coefficient": 0.003}),
        Hidden(effect="input_delay", parameters={"delay": 0.014}),
    )

    def grown(model, key, *values):
        chain = model.structure.chain(model.theta)
        trials = candidates_at(find_effect(key[0]), key[1], runs=study.training, chain=chain)
        start = model.with_effect(trials[0][0], values)
        return judge(fit_whole(start, study), study, added=(trials[0][0],))

    lag, delay = grown(fit, LAG, 0.014), grown(fit, DELAY, 0.014)
    leader = grown(lag.fit, CUBIC, 0.003)
    seen = {h.key: h for h in (lag, delay, leader)}
    (other,) = _exchanged(leader, seen, study)
    assert other.key == {DELAY, CUBIC}
    assert other.bic < leader.bic - BIC_DROP
    for times, again in ((1.0, False), (3.0, True)):  # what ended in a poor valley has another go
        known: Any = SimpleNamespace(key=other.key, fit=SimpleNamespace(chi=times * leader.fit.chi))
        exchanged = [h.key for h in _exchanged(leader, seen | {other.key: known}, study)]
        assert exchanged == [other.key] * again


@pytest.mark.parametrize(("before", "leads"), [(57.0, True), (15.0, False)])
def test_behind_a_contact_that_explains_most_is_looked_for_more(before, leads):
    """However little it leaves: what is there beside it may leave noise alone."""
    alone = judged(("backlash", 0), chi=6.0, held=11.0, bic=0.0)
    alone = replace(alone, added=tuple(alone.fit.structure.effects))
    assert _leads_on(alone, before) == leads


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
