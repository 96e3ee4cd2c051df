"""What the simulator reads: three tables of numbers for the carts, the springs and the drive.

An effect fills columns of one row; the neutral values of all columns are the linear chain.
"""

from enum import IntEnum

import numpy as np

from pipeline.arrays import Array
from pipeline.plant.linear.chain import Chain


class Cart(IntEnum):
    """Columns of the cart table."""

    MASS = 0
    DAMPING = 1
    COULOMB = 2  # sliding friction force
    STATIC = 3  # what it holds at rest beyond the sliding force
    STRIBECK = 4  # velocity over which the static excess decays
    DAHL = 5  # presliding friction force
    DISTANCE = 6  # over which it builds up
    LOAD = 7  # friction per input
    DRAG = 8  # quadratic drag
    OFFSET = 9  # constant force
    STOP = 10  # end stop: position, its sign is the side
    STOP_STIFFNESS = 11
    STOP_DAMPING = 12
    GAIN = 13  # of the sensor
    HIDDEN_MASS = 14
    HIDDEN_STIFFNESS = 15
    HIDDEN_DAMPING = 16


class Spring(IntEnum):
    """Columns of the spring table."""

    STIFFNESS = 0
    CUBIC = 1
    CHANGE = 2  # relative change of the stiffness past …
    STRETCH = 3  # … this stretch; its sign is the side
    COUPLING = 4  # damper between the two carts


class Drive(IntEnum):
    """Columns of the drive table."""

    DEAD_ZONE = 0
    LIMIT = 1
    DELAY = 2
    LAG = 3
    DAMPING = 4  # on cart 1 while the commanded input is on
    BACKLASH = 5  # whole free play between motor and cart 1
    MOTOR_MASS = 6  # the share of cart 1's mass on the motor's side of it
    CONTACT_STIFFNESS = 7
    CONTACT_DAMPING = 8
    COGGING = 9  # force that repeats with the motor's position, …
    PITCH = 10  # … over this travel, …
    PHASE = 11  # … from this phase where cart 1 is at zero


# Dry friction: what holds a cart at rest, and differs from run to run by a factor of its own.
DRY = (Cart.COULOMB, Cart.STATIC, Cart.LOAD, Cart.DAHL)
# What changes nothing in a motion without an input.
WITH_INPUT = {Drive.DEAD_ZONE, Drive.LIMIT, Drive.DELAY, Drive.LAG, Drive.DAMPING}
NO_LIMIT = 1e30  # a saturation nobody reaches

Tables = tuple[Array, Array, Array]


def _neutral(of: type[IntEnum], values: dict[int, float]) -> Array:
    row = np.zeros(len(of))
    row[list(values)] = list(values.values())
    row.flags.writeable = False
    return row


# Divisors and factors have a neutral value that is not zero.
_CART = _neutral(Cart, {Cart.STRIBECK: 1.0, Cart.DISTANCE: 1.0, Cart.GAIN: 1.0})
_SPRING = _neutral(Spring, {})
_DRIVE = _neutral(Drive, {Drive.LIMIT: NO_LIMIT, Drive.PITCH: 1.0})


def linear_tables(chain: Chain) -> Tables:
    """Return cart (n, 17), spring (n + 1, 5) and drive (12,) tables of a chain without effects."""
    cart, spring = np.tile(_CART, (chain.n, 1)), np.tile(_SPRING, (chain.n + 1, 1))
    cart[:, Cart.MASS], cart[:, Cart.DAMPING] = chain.m, chain.c
    spring[:, Spring.STIFFNESS] = chain.k
    return cart, spring, _DRIVE.copy()
