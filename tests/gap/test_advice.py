"""The advice on the next recording follows from what is in doubt and from what is there."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.experiments.plan import Recording
from pipeline.gap.advice import advised
from pipeline.gap.types import (
    AlternativeModel,
    Gap,
    GapWindow,
    Prediction,
    Proposal,
    Trace,
    Verdict,
    read_gap,
)
from pipeline.json_files import json_text
from pipeline.plant.catalogue import CATALOGUE
from pipeline.results import Check
from pipeline.setup import Setup
from tests.helpers.gaps import CHAIN, make_gap, usual_terms

T: Array = np.arange(0.0, 8.0, 0.01)
INPUTS = {
    "decay": 0.0 * T,
    "step": np.where(T < 4.0, 0.05, 0.0),
    "ramp": 0.05 * np.sin(2 * np.pi * T / 8.0),
    "sweep": 0.05 * np.sin(2 * np.pi * T**2),
}
Run = tuple[str, Mapping[int, float]]  # kind, and how far each cart moves


def there(*runs: Run, sign: float = 1.0) -> tuple[Trace, ...]:
    """Return the traces of recordings."""
    return tuple(
        Trace(
            experiment=f"{kind}-{i}", cart=cart, held_out=i == 0, t=T, u=sign * INPUTS[kind],
            measured=far * np.cos(T) + 0.5, baseline=T, final=T, zero=0.5,
        )
        for i, (kind, reach) in enumerate(runs)
        for cart, far in reach.items()
    )  # fmt: skip


plausible = cache(make_gap)


def gap_of(verdict: Verdict, keys: Sequence[str], runs: Sequence[Run], *, rival: str = "") -> Gap:
    """Return a gap of these effects and recordings; the rival is as good as the last effect."""
    gap = plausible(verdict, tuple(keys))
    effects = gap.effects
    if effects:
        *others, last = effects
        rivals = tuple(
            replace(last.rivals[0], effect=term.effect, where=dict.fromkeys(term.where, 1))
            for term in (usual_terms(rival) if rival else ())
        )
        effects = (*others, replace(last, rivals=rivals))
    return replace(gap, effects=effects, traces=there(*runs), repeatability=0.02, contenders=())


CAUSE = Check(kind="springs", outcome="fail", message="a spring is missing")
BOTH = {1: 1.0, 2: 1.0}
FAR, NEAR = {1: 3.0, 2: 3.0}, {1: 0.3, 2: 0.3}
ALONE = {2: 1.0}


@pytest.mark.parametrize(
    ("one", "other", "runs", "differ_in", "wanted"),
    [
        # Not decays, if there is nothing else, but decays of another size.
        ("coulomb_friction", "quadratic_drag", [("decay", BOTH)], "motion",
         ("decay", "smaller", 1 / 3)),
        # With decays of two sizes, the cart must be driven.
        ("coulomb_friction", "quadratic_drag", [("decay", FAR), ("decay", NEAR)], "motion",
         ("first_input", None, None)),
        ("coulomb_friction", "quadratic_drag", [("decay", FAR), ("decay", NEAR), ("step", BOTH)],
         "motion", ("step", "smaller", 1 / 3)),
        ("quadratic_drag", "coulomb_friction", [("step", BOTH)], "motion",
         ("decay", "larger", 1.0)),
        # An effect of the drive shows beside free motion.
        ("dead_zone", "coulomb_friction", [("step", BOTH)], "drive", ("decay", None, None)),
        ("dead_zone", "coulomb_friction", [("step", BOTH), ("decay", BOTH)], "drive",
         ("step", "smaller", 1 / 3)),
        ("coulomb_friction", "load_friction", [("decay", BOTH)], "drive",
         ("first_input", None, None)),
        ("input_delay", "actuator_lag", [("step", BOTH)], "motion", ("step", "finer", None)),
        ("actuator_lag", "input_delay", [("step", BOTH)], "motion", ("sweep", None, None)),
        ("actuator_lag", "input_delay", [("sweep", BOTH)], "motion", ("sweep", "faster", None)),
        ("stiction", "cogging", [("step", BOTH)], "quantity", ("ramp", None, None)),
        ("stiction", "cogging", [("ramp", BOTH)], "quantity", ("held", None, None)),
        ("slack_spring", "cubic_spring", [("step", BOTH)], "motion", ("step", "both_signs", None)),
        ("coulomb_friction", "coulomb_friction", [("step", BOTH)], "place", ("held", None, None)),
        # If all recordings are there, only the difference is stated.
        ("stiction", "cogging", [("ramp", BOTH), ("ramp", ALONE)], "quantity", (None, None, None)),
    ],
)  # fmt: skip
def test_two_explanations_are_decided_by_what_is_not_there(one, other, runs, differ_in, wanted):
    """The advice names both effects, how they differ, and a kind of recording that is missing."""
    gap = advised(gap_of("ambiguous", (one,), runs, rival=other))

    advice = gap.advice
    assert advice is not None
    assert advice.aim == "decide"
    assert [[e.effect.key for e in side] for side in advice.between] == [[one], [other]]
    assert advice.differ_in == differ_in
    assert (advice.kind, advice.change) == wanted[:2]
    assert advice.reach == pytest.approx(wanted[2])
    assert set(advice.there) == {f"{k}-{i}" for i, (k, _) in enumerate(runs) if k == wanted[0]}
    assert not advice.repeat


@pytest.mark.parametrize(
    ("what", "runs", "wanted"),
    [
        ("velocity near zero", [("decay", BOTH)], ("decay", "smaller")),
        ("velocity near zero", [("decay", FAR), ("decay", NEAR)], ("first_input", None)),
        ("fast motion", [("step", BOTH)], ("decay", "larger")),
        ("large displacement, positive side", [("step", BOTH)], ("step", "both_signs")),
        ("after an edge of the input", [("step", BOTH)], ("step", "larger")),
        ("after an edge of the input", [("step", FAR), ("step", NEAR)], ("step", "finer")),
        ("input on", [("step", BOTH)], ("decay", None)),
        ("input off", [("decay", BOTH)], ("first_input", None)),
        ("throughout", [("decay", FAR), ("decay", NEAR), ("step", FAR), ("step", NEAR)],
         ("held", None)),
        ("throughout", [("decay", FAR), ("decay", NEAR), ("step", FAR), ("step", NEAR),
                         ("step", ALONE)], (None, None)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("verdict", ["partial", "unexplained"])
def test_what_remains_is_shown_where_it_is(verdict, what, runs, wanted):
    """The advice is about the cart and the motion in which the error is largest."""
    window = GapWindow(experiment="step-0", cart=2, start=0.0, end=1.0, what=what, share=0.9)
    even = replace(window, cart=1, what="throughout")
    gap = replace(gap_of(verdict, ("coulomb_friction",), runs), left=(even, window))
    runs_repeated, once = advised(gap), advised(replace(gap, repeatability=None))

    for found, repeat in ((runs_repeated, False), (once, True)):
        advice = found.advice
        assert advice is not None
        driven = any(kind != "decay" for kind, _ in runs)  # a hand cannot repeat a decay
        assert (advice.aim, advice.repeat) == ("explain", repeat and driven)
        assert (advice.kind, advice.change) == wanted
        if wanted[0] and what != "throughout":
            assert advice.cart == 2


@pytest.mark.parametrize(
    ("key", "error", "runs", "wanted"),
    [
        ("coulomb_friction", 0.2, [("decay", BOTH)], ("sharpen", "decay", "smaller")),
        ("coulomb_friction", 0.02, [("decay", BOTH)], ("check", "decay", "smaller")),
        ("coulomb_friction", 0.2, [("decay", FAR), ("decay", NEAR)],
         ("sharpen", "first_input", None)),
        # A sharp result, of which every kind of recording is there, needs nothing more.
        ("stiction", 0.02, [("ramp", BOTH)], None),
        ("actuator_lag", 0.02, [("sweep", BOTH)], None),
        ("actuator_lag", 0.2, [("sweep", BOTH)], ("sharpen", "sweep", "faster")),
        ("input_delay", 0.02, [("sweep", BOTH)], ("check", "step", None)),
        ("sensor_gain", 0.001, [("decay", BOTH)], ("check", "ruler", None)),
        ("sensor_gain", 0.02, [("decay", BOTH)], ("sharpen", "ruler", None)),  # of |1 − 0.97|
    ],
)  # fmt: skip
def test_a_named_effect_needs_more_only_if_it_is_unsure_or_untested(key, error, runs, wanted):
    """A parameter with a large error is sharpened; a sharp one is checked, or left alone."""
    gap = gap_of("named", (key,), runs)
    (found,) = gap.effects
    values = {n: replace(v, std=error * abs(v.value)) for n, v in found.parameters.items()}
    gap = advised(replace(gap, effects=(replace(found, parameters=values),)))

    if wanted is None:
        assert (gap.advice, gap.next_experiment) == (None, "")
        return
    advice = gap.advice
    assert advice is not None
    assert (advice.aim, advice.kind, advice.change) == wanted
    assert (advice.parameter in values) == (wanted[0] == "sharpen")
    assert [[e.effect.key for e in side] for side in advice.between] == [[key]]


def test_a_bench_with_one_cart_has_no_other_cart_to_hold():
    """Runs with other carts held are asked for only if there are other carts."""
    two = gap_of("named", ("force_offset",), [("decay", {1: 1.0})])
    one = replace(two, bench=Setup(springs=(True, True)))

    assert [found and found.kind for found in (advised(two).advice, advised(one).advice)] == [
        "held",
        None,
    ]


def test_no_effect_is_added_to_a_sufficient_linear_model_or_a_wrong_set_up():
    """A sufficient linear model is tested in a new range; a wrong set-up is first corrected."""
    enough = gap_of("none", (), [("step", BOTH)])
    advice = advised(enough).advice
    assert advice is not None
    assert (advice.aim, advice.kind, advice.change) == ("extend", "decay", "larger")
    every = [(kind, size) for kind in ("decay", "step") for size in (FAR, NEAR)]
    assert advised(gap_of("none", (), every)).advice is None
    cases: Mapping[Verdict, Sequence[str]] = {"unexplained": (), "named": ("stiction",), "none": ()}
    for verdict, keys in cases.items():
        wrong = advised(replace(gap_of(verdict, keys, [("step", BOTH)]), causes=(CAUSE,)))
        assert (wrong.advice, wrong.next_experiment) == (None, "")


@pytest.mark.parametrize("verdict", ["ambiguous", "partial", "named", "unexplained"])
@pytest.mark.parametrize(
    ("kind", "extra"),
    [
        ("step", {}),
        ("sweep", {"frequency_end": 7.25}),
        ("decay", {"release": 2, "note": "let go at 0.5"}),
    ],
)
def test_the_advice_describes_the_proposed_recording(verdict, kind, extra):
    """If a recording is proposed, the advice gives its kind, and by how much the models differ."""
    contenders = tuple(
        AlternativeModel(chain=CHAIN, terms=usual_terms(*keys), weight=0.5)
        for keys in (("quadratic_drag",), ("quadratic_drag", "cubic_spring"))
    )
    recording = Recording(
        id="apart", kind=kind, carts=(1, 2), wave="square", amplitude=0.123, frequency=0.4, **extra
    )
    moved = np.sin(T) + np.array([[0.0], [0.07]]) * (T > 5.0)
    prediction = Prediction(pair=(0, 1), cart=2, t=T, u=T, positions=moved)
    proposal = Proposal(recording=recording, limits=None, separation=4.0, prediction=prediction)
    gap = gap_of(verdict, ("coulomb_friction",), [("decay", FAR), ("decay", NEAR)])
    gap = advised(replace(gap, contenders=contenders, proposal=proposal))

    advice = gap.advice
    assert advice is not None
    assert (advice.kind, advice.cart, advice.change) == (kind, 2, None)
    assert advice.difference == pytest.approx(0.07)
    assert [[e.effect.key for e in side] for side in advice.between] == [["cubic_spring"], []]
    assert ("0.123" in gap.next_experiment) == (kind != "decay")
    assert ("7.25" in gap.next_experiment) == (kind == "sweep")
    assert "0.070" in gap.next_experiment
    assert ("go at 0.5" in gap.next_experiment) == (kind == "decay")
    assert json_text(read_gap(text := json_text(gap))) == text


@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
@pytest.mark.parametrize("verdict", ["named", "ambiguous"])
def test_every_effect_of_the_catalogue_has_its_words(effect, verdict):
    """There are words for each effect, beside each other one, whatever recordings there are."""
    for runs in ([("decay", BOTH)], [("step", BOTH)], [("sweep", FAR), ("step", NEAR)]):
        for rival in CATALOGUE if verdict == "ambiguous" else (effect,):
            gap = gap_of(verdict, (effect.key,), runs, rival=rival.key)
            found = advised(gap)
            assert (found.advice is None) == (found.next_experiment == "")
            assert found.advice is not None or verdict == "named"
            assert "{" not in found.next_experiment
