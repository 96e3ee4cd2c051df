"""Backlash between motor and cart 1."""

from pipeline.plant.nonlinear.effects.base import Effect, Parameter
from pipeline.plant.nonlinear.effects.law import Built, Growth

EFFECT = Effect(
    key="backlash",
    title="Backlash between motor and cart 1",
    sentence="Pinion and rack have play: at each reversal the motor runs free through a gap.",
    place="input",
    law=Built(
        "play", r"f_1 = k_c (|d| - g/2) \operatorname{sign} d, \quad d = x_m - x_1, \ |d| > g/2"
    ),
    growth=Growth(("g", "m_m", "e")),  # e: the share of their speed with which bodies part
    parameters=(
        Parameter(
            "gap", "g", "position", scale=lambda s: s.position, trials=(0.02, 0.08), neutral=0.0
        ),
        Parameter(
            "motor_mass",
            "m_m",
            "input s^2/position",
            scale=lambda s: s.mass,
            trials=(0.1, 0.3),
            lower=0.02,
            upper=0.9,
            reported=False,
        ),
        Parameter(
            "contact_stiffness",
            "k_c",
            "input/position",
            scale=lambda s: s.stiffness,
            trials=(30.0,),
            lower=3.0,
            upper=1000.0,
            reported=False,
        ),
        Parameter(
            "contact_damping",
            "c_c",
            "input s/position",
            # A third of critical for the motor's share of the mass on the usual contact.
            scale=lambda s: (s.stiffness * s.mass) ** 0.5,
            trials=(1.0,),
            lower=0.02,
            upper=30.0,
            reported=False,
        ),
    ),
    fingerprint="A short pause and a knock at each reversal of the force; small inputs are lost.",
    deciding_run="Small steps about zero against the same steps on a bias that keeps contact.",
    reference="M. Nordin, P.-O. Gutman, Automatica 38 (2002), 1633-1649",
    axis="time",
)
