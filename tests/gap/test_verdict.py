"""What a search accepts, and its verdicts, from a table of hypotheses with their errors."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.explain import _is_rugged
from pipeline.gap.judge import Hypothesis, Study, _may_be_zero, reach_verdict, worth_it
from pipeline.gap.summary import list_effects
from pipeline.plant.catalogue import find_effect
from pipeline.setup import Units

FLOOR = 0.01
COULOMB, SECOND = ("coulomb_friction", 1), ("coulomb_friction", 2)
DELAY, CUBIC, DRAG, DEAD = (
    ("input_delay", 0),
    ("cubic_spring", 1),
    ("quadratic_drag", 1),
    ("dead_zone", 0),
)


def hypothesis(
    *keys: tuple[str, int],
    error: float,
    bic: float,
    held: float = 1.0,
    n_points: int = 100_000,
    independent: tuple[float, float] = (10_000.0, 1_000.0),
) -> Hypothesis:
    """Return a hypothesis with the attributes that a verdict needs, without a fit."""
    effects = [SimpleNamespace(key=key, effect=find_effect(key[0])) for key in keys]
    structure = SimpleNamespace(effects=effects)
    fit: Any = SimpleNamespace(chi=1.0, n_points=n_points, structure=structure)
    left: Any = SimpleNamespace(chi=held, n_points=n_points)
    return Hypothesis(
        fit=fit,
        held=left,
        error=error,
        bic=bic,
        n_independent=independent[0],
        n_held_independent=independent[1],
        at_floor=False,
    )


def judged(
    *keys: tuple[str, int], chi: float, held: float, independent: float = 100.0
) -> Hypothesis:
    """Return a hypothesis with its errors at 1000 training and 1000 held-out points."""
    both = (independent, independent)
    bic = 100.0 * float(np.log(chi))
    return hypothesis(*keys, error=held**0.5, bic=bic, held=held, n_points=1000, independent=both)


STUDY: Any = SimpleNamespace(
    floor=FLOOR, repeatability=0.0, training=(), explains=lambda h: h.error <= 2 * FLOOR
)
LINEAR = hypothesis(error=0.3, bic=0.0)


OTHER_CART = hypothesis(SECOND, error=0.25, bic=-50)


def verdict_on(*steps: Any, others: tuple[Any, ...] = ()) -> tuple[str, set[Any], list[Any]]:
    """Return the verdict, the accepted effects, and the rivals."""
    path = (LINEAR, *steps)
    verdict, stand, close = reach_verdict(path, [*path, *others], study=STUDY, sample_time=0.01)
    assert [len(h.key) for h in stand] == list(range(len(stand)))  # one effect at each step
    return verdict, set(stand[-1].key), close


def test_an_effect_that_a_later_one_makes_needless_is_removed():
    """If the effect found second explains as much without the first, the first is removed."""
    delay = hypothesis(DELAY, error=0.25, bic=-10)
    both = hypothesis(DELAY, COULOMB, error=0.2, bic=-500)
    three = hypothesis(DELAY, COULOMB, CUBIC, error=0.195, bic=-600)
    alone = hypothesis(COULOMB, error=0.2, bic=-505)
    poor = hypothesis(COULOMB, error=0.28, bic=-5)
    assert verdict_on(delay, both, three, others=(poor,))[:2] == ("partial", {DELAY, COULOMB})
    assert verdict_on(delay, both, three, others=(alone,))[:2] == ("partial", {COULOMB})


@pytest.mark.parametrize(
    ("rival", "bic", "verdict"),
    [
        ((("stiction", 1), ("stiction", 2)), -999.5, "named"),  # a richer form of the same laws
        ((DRAG, DEAD), -999.5, "ambiguous"),
        ((DRAG, SECOND), -999.5, "ambiguous"),
        ((DRAG, DEAD), -960.0, "named"),  # much less likely
    ],
)
def test_two_effects_with_equal_rivals_are_ambiguous(rival, bic, verdict):
    """Equally good rivals make the verdict "ambiguous", except richer forms of the same laws."""
    one = hypothesis(COULOMB, error=0.2, bic=-100)
    both = hypothesis(COULOMB, SECOND, error=0.015, bic=-1000)
    same = hypothesis(*rival, error=0.015, bic=bic)
    said, stand, close = verdict_on(one, both, others=(same, OTHER_CART))
    assert (said, stand) == (verdict, {COULOMB, SECOND})
    assert close == ([same] if verdict == "ambiguous" else [])


@pytest.mark.parametrize(("held", "verdict"), [(1.0, "ambiguous"), (1.05, "named")])
def test_held_out_runs_are_evidence_too(held: float, verdict: str):
    """A rival is excluded by training and held-out runs together."""
    drag = hypothesis(DRAG, error=0.01, bic=-1000)
    cubic = hypothesis(CUBIC, error=0.01, bic=-970, held=held)
    assert verdict_on(drag, others=(cubic,))[0] == verdict


@pytest.mark.parametrize(("after", "verdict"), [(0.0149, "none"), (0.011, "named")])
def test_a_sufficient_linear_model_needs_no_effect(after, verdict):
    """Where the linear model is near the noise, an effect must lower the error by a tenth."""
    near = hypothesis(error=0.015, bic=0.0)
    child = hypothesis(CUBIC, error=after, bic=-400)

    said, path, _ = reach_verdict((near, child), [near, child], study=STUDY, sample_time=0.01)

    assert (said, len(path)) == (verdict, 1 if verdict == "none" else 2)


@pytest.mark.parametrize(
    ("child", "worth"),
    [
        ({"chi": 2.0, "held": 2.0}, True),  # both kinds of runs improve by 100 ln 3
        (
            {"chi": 2.0, "held": 2.0, "independent": 5.0},
            False,
        ),  # few residuals are independent, because they oscillate
        ({"chi": 1.0, "held": 7.0}, False),  # improves only the training runs
        ({"chi": 5.6, "held": 5.7}, False),  # improves too little for the criterion
    ],
)
def test_an_effect_must_improve_training_and_held_out_runs(child, worth):
    """An effect must clearly improve training and held-out runs; few residuals are not enough."""
    parent = judged(CUBIC, chi=6.0, held=6.0)
    both = judged(CUBIC, DELAY, **child)
    study: Any = SimpleNamespace(explains=lambda h: True)
    assert worth_it(both, parent, study) == worth


@pytest.mark.parametrize(
    ("error", "contact", "repeatability", "said"),
    [(0.014, False, 0.0, True), (0.012, False, 0.0, False), (0.014, True, 0.0, False),
     (0.014, False, 0.01, False)],
)  # fmt: skip
def test_more_than_noise_may_mean_missing_effects(error, contact, repeatability, said):
    """An error above the noise means missing effects, except with contacts or poor repeats."""
    chosen: Any = SimpleNamespace(error=error, has_contact=contact)
    study: Any = SimpleNamespace(floor=0.01, repeatability=repeatability)
    assert Study.may_be_half(study, chosen) == said


@pytest.mark.parametrize(
    ("error", "repeatability", "explained"),
    [(0.0199, 0.0, True), (0.0201, 0.0, False), (0.0299, 0.02, True), (0.0301, 0.02, False)],
)
def test_noise_and_repeats_excuse_an_error(error, repeatability, explained):
    """`explains` allows twice the noise or 1.5 times the repeats, whichever is larger."""
    study: Any = SimpleNamespace(floor=0.01, repeatability=repeatability)
    assert Study.explains(study, SimpleNamespace(error=error)) == explained  # type: ignore[arg-type]


def test_an_effect_that_all_explanations_share_is_certain():
    """Two explanations, equally good, share the friction: only the other effect is in doubt."""
    alone = hypothesis(COULOMB, error=0.2, bic=-500)
    drag, delay = (hypothesis(COULOMB, key, error=0.01, bic=-900) for key in (DRAG, DELAY))
    terms = [
        SimpleNamespace(effect=effect, where={}, values=np.ones(len(effect.parameters)))
        for effect in (find_effect(COULOMB[0]), find_effect(DRAG[0]))
    ]
    structure = drag.fit.structure
    final: Any = SimpleNamespace(structure=structure, covariance=None, terms=terms, chi=1.0)
    found = [LINEAR, alone, drag, delay]
    friction, second = list_effects(
        (LINEAR, alone, drag), final, found, Units(position="cm", input="V")
    )
    assert (friction.confidence, second.confidence) == (1.0, 0.5)
    assert [rival.confidence for rival in second.rivals] == [0.5]


@pytest.mark.parametrize(
    ("key", "sure", "without", "zero"),
    [
        (COULOMB, 2.9, 0.039, True),
        (COULOMB, 3.1, 0.039, False),  # far enough from zero
        (COULOMB, 0.5, 0.041, False),  # it halves the error
        (COULOMB, 0.5, np.inf, True),  # a refit that diverges proves nothing
        (("backlash", 0), 0.5, 0.041, True),  # nor does one in a narrow minimum
    ],
)
def test_an_effect_that_halves_the_error_is_not_zero(key, sure, without, zero):
    """An effect within three standard errors of zero goes, unless it halves the error of 2 %."""
    chosen = hypothesis(key, error=0.02, bic=0.0)
    structure: Any = chosen.fit.structure
    structure.has_play = key[0] == "backlash"
    assert _may_be_zero(sure, hypothesis(error=without, bic=0.0), chosen) == zero


@pytest.mark.parametrize(
    ("play", "contact", "chi", "rugged"),
    [
        (True, True, 1.0, True),
        (False, True, 1.14, False),
        (False, True, 1.16, True),
        (False, False, 9.0, False),
    ],
)
def test_only_a_contact_makes_the_cost_rugged(play, contact, chi, rugged):
    """Backlash always does, an end stop while the error exceeds the noise."""
    structure = SimpleNamespace(has_play=play, has_contact=contact)
    fit: Any = SimpleNamespace(structure=structure, chi=chi)
    assert _is_rugged(fit) == rugged
