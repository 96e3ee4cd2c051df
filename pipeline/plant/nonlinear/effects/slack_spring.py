"""A spring that changes past a stretch."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ContactLaw, Growth

EFFECT = Effect(
    key="slack_spring",
    title="A spring that changes past a stretch",
    sentence="Past some stretch the spring goes slack, or coil meets coil.",
    place="spring",
    law=ContactLaw("r * k * (d - s)", past="s", pulls=True),
    growth=Growth(("h", "s"), {"r": "h / k"}, signed=True),
    parameters=(
        EffectParameter(
            "stiffness_change",
            "r",
            "",
            scale="1",
            typical=0.3,
            signed=True,
            neutral=0.0,
            upper=50.0,
        ),
        EffectParameter("stretch", "s", "position", scale="position", typical=0.35, side=True),
    ),
    fingerprint="The swing is of a different shape on one side, beyond one position.",
    deciding_run="Static steps of both signs and several sizes: the gain has a corner.",
    reference="S. W. Shaw, P. J. Holmes, Journal of Sound and Vibration 90 (1983), 129-155",
    axis="stretch",
    equivalent="The other wall spring with the stretch on the other side, on a single cart.",
)
