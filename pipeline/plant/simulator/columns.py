"""The columns of the simulator's tables.

Made by `python -m pipeline.plant.simulator.codegen` from the laws of the effects.
"""

from enum import IntEnum


class Cart(IntEnum):
    """The row of a cart."""

    MASS = 0
    DAMPING = 1
    COULOMB_FRICTION_FORCE = 2
    STICTION_STATIC_FORCE = 3
    STICTION_VELOCITY = 4
    PRESLIDING_FRICTION_FORCE = 5
    PRESLIDING_FRICTION_DISTANCE = 6
    LOAD_FRICTION_COEFFICIENT = 7
    QUADRATIC_DRAG_COEFFICIENT = 8
    FORCE_OFFSET_FORCE = 9
    END_STOP_POSITION = 10
    END_STOP_STIFFNESS = 11
    END_STOP_DAMPING = 12
    SENSOR_GAIN_GAIN = 13
    EXTRA_MODE_MASS = 14
    EXTRA_MODE_STIFFNESS = 15
    EXTRA_MODE_DAMPING = 16


class Spring(IntEnum):
    """The row of a spring."""

    STIFFNESS = 0
    CUBIC_SPRING_COEFFICIENT = 1
    ASYMMETRIC_SPRING_COEFFICIENT = 2
    SLACK_SPRING_STIFFNESS_CHANGE = 3
    SLACK_SPRING_STRETCH = 4
    COUPLING_DAMPER_COEFFICIENT = 5


class Drive(IntEnum):
    """The row of the drive."""

    DRIVE_DAMPING_COEFFICIENT = 0
    DEAD_ZONE_WIDTH = 1
    SATURATION_LIMIT = 2
    INPUT_DELAY_DELAY = 3
    ACTUATOR_LAG_TIME_CONSTANT = 4
    BACKLASH_GAP = 5
    BACKLASH_MOTOR_MASS = 6
    BACKLASH_CONTACT_STIFFNESS = 7
    BACKLASH_CONTACT_DAMPING = 8
    COGGING_FORCE = 9
    COGGING_PITCH = 10
    COGGING_PHASE = 11


# Columns of dry friction, which may differ by a factor from run to run.
DRY = (
    Cart.COULOMB_FRICTION_FORCE,
    Cart.STICTION_STATIC_FORCE,
    Cart.PRESLIDING_FRICTION_FORCE,
    Cart.LOAD_FRICTION_COEFFICIENT,
)
# Values for no effect, in columns where 0 would have an effect.
NEUTRAL = {"SENSOR_GAIN_GAIN": 1.0}
