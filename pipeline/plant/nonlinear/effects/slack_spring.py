"""A spring with a jump in its stiffness."""

from pipeline.plant.nonlinear.effects.base import Effect, EffectParameter
from pipeline.plant.nonlinear.effects.law import ContactLaw, Growth

EFFECT = Effect(
    key="slack_spring",
    title="A spring with a jump in its stiffness",
    sentence="Beyond some stretch the spring goes slack, or its coils touch.",
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
    fingerprint="The swings change shape beyond some position, on one side only.",
    deciding_run="Steps of both signs and several sizes: plotted over the input, the settled "
    "position is a line with a corner.",
    reference="S. W. Shaw, P. J. Holmes, Journal of Sound and Vibration 90 (1983), 129-155",
    axis="stretch",
    equivalent="The same effect in the other wall spring at the opposite stretch, if there is "
    "only one cart.",
)
