"""A sensor with a scale of its own."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Built, Growth

EFFECT = Effect(
    key="sensor_gain",
    title="A sensor with a scale of its own",
    sentence="One encoder reads more (or less) than the others for the same motion.",
    place="cart",
    law=Built("reading", "y = g x"),
    growth=Growth(("e",), {"g": "1 + e"}, signed=True),
    parameters=(Parameter("gain", "g", "", scale=lambda s: 1.0, trials=(1.03, 0.97), neutral=1.0),),
    fingerprint="The carts' amplitudes are in a ratio that no chain of springs gives.",
    deciding_run="Move the carts by a ruler and read the encoders.",
    reference="statics of the chain",
    axis="position",
    fewest_carts=2,
    same_as="sensor_gain",
    equivalent="Another cart's gain: only ratios show, and none without a spring at both ends.",
)
