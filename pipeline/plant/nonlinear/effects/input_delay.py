"""Delay of the input."""

from pipeline.plant.limits import MUCH_SHORTER
from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import BuiltLaw
from pipeline.words.math import parens, row

EFFECT = Effect(
    key="input_delay",
    title="Delay of the input",
    sentence="The force comes later (or earlier) than the logged input says.",
    place="input",
    law=BuiltLaw("delay", row("u", parens("t"), "→", "u", parens("t", "−", "T"))),
    parameters=(
        EffectParameter(
            "delay", "T", "s", scale="sample_time", typical=1.5, signed=True, neutral=0.0
        ),
    ),
    fingerprint="Every driven motion starts late by the same time. Free decays fit the linear "
    "model.",
    deciding_run="A step at a high sample rate: the cart starts to move some time after the edge.",
    reference="K. J. Åström, B. Wittenmark, Computer-Controlled Systems, section 2.3",
    axis="time",
    equivalent="A first-order lag whose time constant is much shorter than a sample.",
    same_as="actuator_lag",
    same_below=MUCH_SHORTER,
)
