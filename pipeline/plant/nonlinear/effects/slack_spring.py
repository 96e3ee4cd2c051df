"""A spring that changes past a stretch."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Contact, Growth

EFFECT = Effect(
    key="slack_spring",
    title="A spring that changes past a stretch",
    sentence="Past some stretch the spring goes slack, or coil meets coil.",
    place="spring",
    law=Contact("r * k * (d - s)", past="s", pulls=True),
    growth=Growth(("h", "s"), {"r": "h / k"}, signed=True),
    parameters=(
        Parameter(
            "stiffness_change",
            "r",
            "",
            scale=lambda s: 1.0,
            trials=(0.3,),
            signed=True,
            neutral=0.0,
            upper=50.0,
        ),
        Parameter(
            "stretch",
            "s",
            "position",
            scale=lambda s: s.position,
            trials=(0.1, 0.35, 0.65),
            side=True,
        ),
    ),
    fingerprint="The swing is of a different shape on one side, beyond one position.",
    deciding_run="Static steps of both signs and several sizes: the gain has a corner.",
    reference="S. W. Shaw, P. J. Holmes, Journal of Sound and Vibration 90 (1983), 129-155",
    axis="stretch",
    equivalent="The other wall spring with the stretch on the other side, on a single cart.",
)
