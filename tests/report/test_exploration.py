"""The diary of an exploration: what each turn says, and how its explanations are told apart."""

import re

from pipeline.bench.explore.words import model_words
from pipeline.plant.linear.presets import PRESETS
from pipeline.plant.nonlinear.effects import AugmentedChain, Term, find_effect
from pipeline.report.exploration.page import write_diary
from pipeline.report.exploration.turn import Explanation, Turn
from tests.helpers.analysis_factory import make_analysis


def make_turn(*weights: float) -> Turn:
    """Return a turn with explanations of these weights, that of the model first."""
    return Turn(
        seconds=30.0,
        recorded=("step-1",),
        errors={"K_1": 0.01},
        verdict="ambiguous" if len(weights) > 1 else "named",
        explanations=tuple(
            Explanation(name=f"effect {i}", weight=weight) for i, weight in enumerate(weights)
        ),
        left=0.1,
        floor=0.01,
        reached=False,
        said="K_1 is known to ± 1 % only",
    )


def test_the_explanation_in_the_model_is_told_from_what_the_criterion_prefers(tmp_path):
    """One that the criterion gives next to nothing has under 1 %; of one alone none is told."""
    turns = [make_turn(1e-7, 1.0), make_turn(1.0)]
    page = write_diary(turns, make_analysis(1), tmp_path, wanted=0.01).read_text(encoding="utf-8")
    told = re.findall(r"Effect 0[^<]*", page)
    assert told == ["Effect 0 (in the model, under 1 %); effect 1 (100 %)", "Effect 0"]


def test_effects_are_called_what_they_are_called_elsewhere():
    """Names of people keep their capitals, and what is on a cart is not on it twice."""
    chain = PRESETS["throne-1dof"]
    mass, friction = (
        Term(effect=effect, place=1, values=tuple(1.0 for _ in effect.names))
        for effect in (find_effect("extra_mode"), find_effect("coulomb_friction"))
    )
    told = model_words(AugmentedChain(chain=chain, terms=(mass, friction)))
    assert told == "a hidden mass on a cart (cart 1) and dry (Coulomb) friction on cart 1"
