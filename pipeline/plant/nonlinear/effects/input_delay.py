"""Delay of the input."""

from pipeline.plant.limits import MUCH_SHORTER
from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Built

EFFECT = Effect(
    key="input_delay",
    title="Delay of the input",
    sentence="The force comes later (or earlier) than the logged input says.",
    place="input",
    law=Built("delay", r"u(t) \to u(t - T)"),
    parameters=(
        Parameter(
            "delay",
            "T",
            "s",
            scale=lambda s: s.sample_time,
            trials=(0.3, 1.5),
            signed=True,
            neutral=0.0,
        ),
    ),
    fingerprint="Every motion starts late by the same time; free decays show nothing.",
    deciding_run="A sharp edge of the input at a high sample rate.",
    reference="K. J. Åström, B. Wittenmark, Computer-Controlled Systems, section 2.3",
    axis="time",
    equivalent="A lag much shorter than the sample time.",
    same_as="actuator_lag",
    same_below=MUCH_SHORTER,
)
