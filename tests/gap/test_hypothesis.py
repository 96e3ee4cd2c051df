"""An effect is accepted only if it improves the fit enough."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pipeline.gap.judge import Hypothesis, Study, worth_it
from pipeline.plant.catalogue import find_effect
from tests.gap.begun import CUBIC, DELAY


def judged(
    *keys: tuple[str, int], chi: float, held: float, n_independent: float = 100.0
) -> Hypothesis:
    """Return a hypothesis with its errors at 1000 training and 1000 held-out points."""
    effects = [SimpleNamespace(key=key, effect=find_effect(key[0])) for key in keys]
    fit: Any = SimpleNamespace(chi=chi, structure=SimpleNamespace(effects=effects), n_points=1000.0)
    left: Any = SimpleNamespace(chi=held)
    return Hypothesis(
        fit=fit,
        held=left,
        error=held**0.5,
        bic=100.0 * float(np.log(chi)),
        n_independent=n_independent,
        n_held_independent=n_independent,
        at_floor=max(chi, held) < 1.15,
    )


@pytest.mark.parametrize(
    ("child", "worth"),
    [
        ({"chi": 2.0, "held": 2.0}, True),  # both kinds of runs improve by 100 ln 3
        (
            {"chi": 2.0, "held": 2.0, "n_independent": 5.0},
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
