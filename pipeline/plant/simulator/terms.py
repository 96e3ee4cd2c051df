"""The laws of the effects in the coordinates of a fit, with derivatives.

Made by `python -m pipeline.plant.simulator.codegen` from the laws of the effects.
"""

from enum import IntEnum
from math import cos, exp, pi, sin

from pipeline.plant.simulator.compiler import jit


class EffectKind(IntEnum):
    """The effects, in the order of the catalogue."""

    COULOMB_FRICTION = 0
    STICTION = 1
    PRESLIDING_FRICTION = 2
    LOAD_FRICTION = 3
    QUADRATIC_DRAG = 4
    FORCE_OFFSET = 5
    CUBIC_SPRING = 6
    ASYMMETRIC_SPRING = 7
    SLACK_SPRING = 8
    COUPLING_DAMPER = 9
    DRIVE_DAMPING = 10
    DEAD_ZONE = 11
    SATURATION = 12
    INPUT_DELAY = 13
    ACTUATOR_LAG = 14
    BACKLASH = 15
    COGGING = 16
    END_STOP = 17
    SENSOR_GAIN = 18
    EXTRA_MODE = 19


# For each kind, the coordinates that are zero without the effect.
COEFFICIENTS = (
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0,),
    (0, 1),
    (0, 2),
    (0,),
    (0,),
)
ON_SPRING = (
    EffectKind.CUBIC_SPRING,
    EffectKind.ASYMMETRIC_SPRING,
    EffectKind.SLACK_SPRING,
    EffectKind.COUPLING_DAMPER,
)
FRICTION = (
    EffectKind.COULOMB_FRICTION,
    EffectKind.STICTION,
    EffectKind.LOAD_FRICTION,
)
HYSTERESIS = (EffectKind.PRESLIDING_FRICTION,)
# Largest count of numbers that `terms` or `settle` write.
TERMS = 11


@jit
def terms(kind, p, o, x, v, k, u, on, out):
    """Fill `out` with the law of a kind and derivatives; coordinates start at p[o].

    The derivatives are d/dx, d/dv and d/du, then d/d(coordinate) for each coordinate.
    `x` and `v` belong to a cart or a spring's stretch; `k` is the spring's stiffness.
    """
    if kind == EffectKind.COULOMB_FRICTION:
        out[0] = p[o]
        out[1] = 0
        out[2] = 0
        out[3] = 0
        out[4] = 1
    elif kind == EffectKind.STICTION:
        x0 = p[o + 1] ** (-2)
        x1 = v**2
        x2 = exp(-x0 * x1)
        x3 = p[o] * x2
        x4 = 2 * x3
        out[0] = x3
        out[1] = 0
        out[2] = -v * x0 * x4
        out[3] = 0
        out[4] = x2
        out[5] = x1 * x4 / p[o + 1] ** 3
    elif kind == EffectKind.LOAD_FRICTION:
        x0 = abs(u)
        out[0] = p[o] * x0
        out[1] = 0
        out[2] = 0
        out[3] = p[o] * (1.0 if u > 0.0 else -1.0)
        out[4] = x0
    elif kind == EffectKind.QUADRATIC_DRAG:
        x0 = abs(v)
        x1 = v * x0
        out[0] = -p[o] * x1
        out[1] = 0
        out[2] = -2 * p[o] * x0
        out[3] = 0
        out[4] = -x1
    elif kind == EffectKind.FORCE_OFFSET:
        out[0] = p[o]
        out[1] = 0
        out[2] = 0
        out[3] = 0
        out[4] = 1
    elif kind == EffectKind.CUBIC_SPRING:
        x0 = x**3
        out[0] = p[o] * x0
        out[1] = 3 * p[o] * x**2
        out[2] = 0
        out[3] = 0
        out[4] = x0
    elif kind == EffectKind.ASYMMETRIC_SPRING:
        x0 = x**2
        out[0] = p[o] * x0
        out[1] = 2 * p[o] * x
        out[2] = 0
        out[3] = 0
        out[4] = x0
    elif kind == EffectKind.SLACK_SPRING:
        x0 = -p[o + 1] + x
        if (x - p[o + 1]) * p[o + 1] > 0.0:
            out[0] = p[o] * x0
            out[1] = p[o]
            out[2] = 0
            out[3] = 0
            out[4] = x0
            out[5] = -p[o]
        else:
            out[:6] = 0.0
    elif kind == EffectKind.COUPLING_DAMPER:
        out[0] = p[o] * v
        out[1] = 0
        out[2] = p[o]
        out[3] = 0
        out[4] = v
    elif kind == EffectKind.DRIVE_DAMPING:
        x0 = on * p[o]
        out[0] = -v * x0
        out[1] = 0
        out[2] = -x0
        out[3] = 0
        out[4] = -on * v
    elif kind == EffectKind.COGGING:
        x0 = 2 * pi / p[o + 2]
        x1 = x * x0
        x2 = cos(x1)
        x3 = sin(x1)
        x4 = p[o + 1] * x3 - p[o] * x2
        out[0] = p[o + 1] * x2 + p[o] * x3
        out[1] = -x0 * x4
        out[2] = 0
        out[3] = 0
        out[4] = x3
        out[5] = x2
        out[6] = 2 * pi * x * x4 / p[o + 2] ** 2
    elif kind == EffectKind.END_STOP:
        x0 = p[o + 1] - x
        if (x - p[o + 1]) * p[o + 1] > 0.0 and (-p[o + 2] * v + p[o] * x0) * p[o + 1] <= 0.0:
            out[0] = -p[o + 2] * v + p[o] * x0
            out[1] = -p[o]
            out[2] = -p[o + 2]
            out[3] = 0
            out[4] = x0
            out[5] = p[o]
            out[6] = -v
        else:
            out[:7] = 0.0


@jit
def settle(kind, p, o, v, out):
    """Fill `out` with `hysteresis`, its slopes, and its derivatives by coordinate."""
    if kind == EffectKind.PRESLIDING_FRICTION:
        out[0] = p[o]
        out[1] = 1.0 if v > 0.0 else -1.0
        out[2] = abs(v) / p[o + 1]
        out[3] = 0
        out[4] = (1.0 if v > 0.0 else -1.0) / p[o + 1]
        out[5] = 1
        out[6] = 0
        out[7] = 0
        out[8] = 0
        out[9] = 0
        out[10] = -abs(v) / p[o + 1] ** 2
