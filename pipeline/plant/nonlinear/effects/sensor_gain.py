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
    fingerprint="No chain of springs can give the measured ratio between the carts' amplitudes.",
    deciding_run="Move each cart along a ruler and compare the distance with its encoder.",
    reference="the balance of forces in the chain at rest",
    axis="position",
    fewest_carts=2,
    same_as="sensor_gain",
    equivalent="The gain of another cart's sensor, because the data show only ratios of gains. "
    "If two carts have springs to both walls, the data show no gain at all.",
)
