"""A sensor with its own scale."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import BuiltLaw, Growth
from pipeline.words.math import row

EFFECT = Effect(
    key="sensor_gain",
    title="A sensor with a scale of its own",
    sentence="One encoder reads more (or less) than the others for the same motion.",
    place="cart",
    law=BuiltLaw("reading", row("y", "=", "g", "x")),
    growth=Growth(("e",), {"g": "1 + e"}, signed=True),
    parameters=(EffectParameter("gain", "g", "", scale="1", typical=0.97, neutral=1.0),),
    fingerprint="The carts' amplitudes are in a ratio that no chain of springs gives.",
    deciding_run="Move the carts by a ruler and read the encoders.",
    reference="statics of the chain",
    axis="position",
    fewest_carts=2,
    same_as="sensor_gain",
    equivalent="Another cart's gain: only ratios show, and none without a spring at both ends.",
)
