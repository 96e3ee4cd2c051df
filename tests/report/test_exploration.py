"""The diary of an exploration lists its turns and their explanations."""

import re
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from pipeline.experiments.exploration import Turn, deciding_trace, name_model
from pipeline.gap.types import AlternativeModel, Gap
from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain, EffectTerm
from pipeline.report.exploration import write_diary
from tests.helpers.gaps import make_gap, two_cart_analysis


def make_turn(gap: Gap | None = None) -> Turn:
    """Return a turn with this gap."""
    return Turn(
        seconds=30.0,
        recorded=("step-1",),
        errors={"K_1": 0.01},
        reached=False,
        summary="K_1 is known to ± 1 % only",
        gap=gap,
    )


def test_the_diary_marks_the_explanation_in_the_model(tmp_path):
    """The diary marks the explanation that the model uses, and gives each explanation's weight.

    A weight far below the best is written as under 1 %; a single explanation has no weight.
    """
    named = make_gap()
    one, other = (
        AlternativeModel(chain=model.chain, terms=model.terms, weight=weight)
        for model, weight in ((named.model, 1e-7), (named.linear, 1.0))
    )
    disputed = replace(named, verdict="ambiguous", contenders=(one, other))
    turns = [make_turn(disputed), make_turn(named)]
    page = write_diary(turns, two_cart_analysis(), tmp_path, wanted=0.01).read_text("utf-8")
    _, explained = page.replace("\u00a0", " ").split('<section id="explanations"')
    first, second = re.findall(r"<td[^>]*>(Dry[^<]*)", explained)
    assert re.findall(r"\((?:in the model, )?(?:under )?\d+ %\)", first) == [
        "(in the model, under 1 %)",
        "(100 %)",
    ]
    assert "%" not in second


def test_effects_have_their_usual_names_in_the_diary():
    """Effects have their usual names in the diary, and each effect's cart is named once."""
    chain = PRESETS["throne-1dof"]
    mass, friction = (
        EffectTerm(effect=effect, place=1, values=tuple(1.0 for _ in effect.names))
        for effect in (find_effect("extra_mode"), find_effect("coulomb_friction"))
    )
    told = name_model(AugmentedChain(chain=chain, terms=(mass, friction)))
    assert told == "a hidden mass on a cart (cart 1) and dry (Coulomb) friction on cart 1"


def test_the_diary_gives_the_answer_first(tmp_path):
    """The diary gives parameters and effects first, then each turn with its deciding recording."""
    gap = make_gap()
    runs = {trace.experiment for trace in gap.traces}
    turns = [
        replace(make_turn(), seconds=20.0, recorded=(run,), gap=gap) for run in sorted(runs)[:1]
    ]
    turns.append(replace(turns[0], seconds=50.0, recorded=("another",)))

    page = write_diary(turns, two_cart_analysis(), tmp_path, wanted=0.01).read_text("utf-8")

    titles = re.findall(r"<h[23][^>]*>([^<]+)", page)
    assert titles[:2] == ["Results", "Turn by turn"]
    assert re.findall(r"\d+", titles[2])[:2] == ["1", "20"]
    answer, story = page.split('<section id="turns"')
    assert "Coulomb" in answer

    decided = deciding_trace(gap, turns[0].recorded)
    assert decided is not None
    assert f"Cart {decided.cart} in {turns[0].recorded[0]}" in story
    over_time = [svg for svg in story.split("<svg ") if "time at the bench [s]" in svg]
    assert len(over_time) == 2
    for svg in over_time:
        times = [float(label) for label in re.findall(r"middle[^>]*>([\d.]+)<", svg)]
        values = [float(label) for label in re.findall(r"end[^>]*>([\d.]+)<", svg)]
        assert min(times) == 0.0
        powers = np.log10([min(values), max(values)])
        assert_allclose(powers, np.round(powers), atol=1e-9)
