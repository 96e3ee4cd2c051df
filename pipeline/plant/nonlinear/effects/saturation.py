"""Saturation of the input."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Input

EFFECT = Effect(
    key="saturation",
    title="Saturation of the input",
    sentence="The amplifier clips: above a limit more input gives no more force.",
    place="input",
    law=Input("clip(u, -L, L)"),
    parameters=(
        Parameter("limit", "L", "input", scale=lambda s: s.input, trials=(0.97, 0.85, 0.65, 0.45)),
    ),
    fingerprint="Large inputs move the cart less than in proportion.",
    deciding_run="Steps of three sizes: the level stops growing.",
    reference="K. J. Åström, R. M. Murray, Feedback Systems, section 10.5",
    axis="input",
)
