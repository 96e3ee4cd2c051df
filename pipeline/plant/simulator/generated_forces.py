"""The laws of the effects, for the compiled simulators.

Made by `python -m pipeline.plant.simulator.codegen` from the laws of the effects.
"""

from math import cos, exp, inf, pi, sin

from pipeline.plant.simulator.columns import Cart, Drive, Spring
from pipeline.plant.simulator.compiler import inlined, jit


@inlined
def cart_force(cart, i, x, v, u):
    """Return the nonlinear force of cart i."""
    f = 0.0
    if cart[i, Cart.QUADRATIC_DRAG_COEFFICIENT] != 0.0:
        f += -cart[i, Cart.QUADRATIC_DRAG_COEFFICIENT] * v * abs(v)
    if cart[i, Cart.FORCE_OFFSET_FORCE] != 0.0:
        f += cart[i, Cart.FORCE_OFFSET_FORCE]
    return f


@inlined
def cart_slopes(cart, i, x, v, u):
    """Return the slopes of `cart_force` against position and velocity."""
    by_x = by_v = 0.0
    if cart[i, Cart.QUADRATIC_DRAG_COEFFICIENT] != 0.0:
        by_v += -2 * cart[i, Cart.QUADRATIC_DRAG_COEFFICIENT] * abs(v)
    return by_x, by_v


@inlined
def spring_force(spring, j, d, rate):
    """Return the nonlinear tension of spring j, beyond its stiffness."""
    f = 0.0
    if spring[j, Spring.CUBIC_SPRING_COEFFICIENT] != 0.0:
        f += d**3 * spring[j, Spring.CUBIC_SPRING_COEFFICIENT]
    if spring[j, Spring.ASYMMETRIC_SPRING_COEFFICIENT] != 0.0:
        f += d**2 * spring[j, Spring.ASYMMETRIC_SPRING_COEFFICIENT]
    return f


@inlined
def spring_slopes(spring, j, d, rate):
    """Return the slopes of `spring_force` against position and velocity."""
    by_x = by_v = 0.0
    if spring[j, Spring.CUBIC_SPRING_COEFFICIENT] != 0.0:
        by_x += 3 * d**2 * spring[j, Spring.CUBIC_SPRING_COEFFICIENT]
    if spring[j, Spring.ASYMMETRIC_SPRING_COEFFICIENT] != 0.0:
        by_x += 2 * d * spring[j, Spring.ASYMMETRIC_SPRING_COEFFICIENT]
    return by_x, by_v


@inlined
def drive_force(drive, x, v, u, on):
    """Return the nonlinear force of cart 1."""
    f = 0.0
    if drive[Drive.DRIVE_DAMPING_COEFFICIENT] != 0.0:
        f += -drive[Drive.DRIVE_DAMPING_COEFFICIENT] * on * v
    return f


@inlined
def drive_slopes(drive, x, v, u, on):
    """Return the slopes of `drive_force` against position and velocity."""
    by_x = by_v = 0.0
    if drive[Drive.DRIVE_DAMPING_COEFFICIENT] != 0.0:
        by_v += -drive[Drive.DRIVE_DAMPING_COEFFICIENT] * on
    return by_x, by_v


@inlined
def motor_force(drive, x, v, u, on):
    """Return the nonlinear force of the motor."""
    f = 0.0
    if drive[Drive.COGGING_FORCE] != 0.0:
        f += drive[Drive.COGGING_FORCE] * sin(
            drive[Drive.COGGING_PHASE] + 2 * pi * x / drive[Drive.COGGING_PITCH]
        )
    return f


@inlined
def motor_slopes(drive, x, v, u, on):
    """Return the slopes of `motor_force` against position and velocity."""
    by_x = by_v = 0.0
    if drive[Drive.COGGING_FORCE] != 0.0:
        by_x += (
            2
            * pi
            * drive[Drive.COGGING_FORCE]
            * cos(drive[Drive.COGGING_PHASE] + 2 * pi * x / drive[Drive.COGGING_PITCH])
            / drive[Drive.COGGING_PITCH]
        )
    return by_x, by_v


@inlined
def cart_matrix(cart, i):
    """Return the stiffness and damping that linear laws add to a cart."""
    stiffness = damping = 0.0
    return stiffness, damping


@inlined
def spring_matrix(spring, j):
    """Return the stiffness and damping that linear laws add to a spring."""
    stiffness = damping = 0.0
    damping += spring[j, Spring.COUPLING_DAMPER_COEFFICIENT]
    return stiffness, damping


@inlined
def sliding(cart, i, u):
    """Return the part of the dry friction that does not depend on the speed."""
    return cart[i, Cart.COULOMB_FRICTION_FORCE] + cart[i, Cart.LOAD_FRICTION_COEFFICIENT] * abs(u)


@inlined
def stribeck(cart, i, v, u):
    """Return the part of the dry friction that changes with the speed."""
    size = 0.0
    if cart[i, Cart.STICTION_STATIC_FORCE] > cart[i, Cart.COULOMB_FRICTION_FORCE]:
        size += (-cart[i, Cart.COULOMB_FRICTION_FORCE] + cart[i, Cart.STICTION_STATIC_FORCE]) * exp(
            -(v**2) / cart[i, Cart.STICTION_VELOCITY] ** 2
        )
    return size


@inlined
def stribeck_slope(cart, i, v, u):
    """Return the derivative of `stribeck`, d/dv."""
    slope = 0.0
    if cart[i, Cart.STICTION_STATIC_FORCE] > cart[i, Cart.COULOMB_FRICTION_FORCE]:
        slope += (
            2
            * v
            * (cart[i, Cart.COULOMB_FRICTION_FORCE] - cart[i, Cart.STICTION_STATIC_FORCE])
            * exp(-(v**2) / cart[i, Cart.STICTION_VELOCITY] ** 2)
            / cart[i, Cart.STICTION_VELOCITY] ** 2
        )
    return slope


@inlined
def hysteresis(cart, i, v):
    """Return the largest force of hysteresis, and limit and rate (1/s) of its state."""
    if cart[i, Cart.PRESLIDING_FRICTION_FORCE] != 0.0:
        return (
            cart[i, Cart.PRESLIDING_FRICTION_FORCE],
            (1.0 if v > 0.0 else -1.0),
            abs(v) / cart[i, Cart.PRESLIDING_FRICTION_DISTANCE],
        )
    return 0.0, 0.0, 0.0


@inlined
def hysteresis_slopes(cart, i, v):
    """Return the derivatives d/dv of the limit and rate of the state."""
    if cart[i, Cart.PRESLIDING_FRICTION_FORCE] != 0.0:
        return 0, (1.0 if v > 0.0 else -1.0) / cart[i, Cart.PRESLIDING_FRICTION_DISTANCE]
    return 0.0, 0.0


@inlined
def end_stop(cart, i):
    """Return stiffness, damping and (signed) position of the end stop of cart i."""
    if cart[i, Cart.END_STOP_STIFFNESS] != 0.0:
        return (
            cart[i, Cart.END_STOP_STIFFNESS],
            cart[i, Cart.END_STOP_DAMPING],
            cart[i, Cart.END_STOP_POSITION],
        )
    return 0.0, 0.0, 0.0


@inlined
def bilinear_spring(spring, j):
    """Return extra stiffness of spring j, where it begins, and its d/dk."""
    if spring[j, Spring.SLACK_SPRING_STIFFNESS_CHANGE] != 0.0:
        return (
            spring[j, Spring.SLACK_SPRING_STIFFNESS_CHANGE] * spring[j, Spring.STIFFNESS],
            spring[j, Spring.SLACK_SPRING_STRETCH],
            spring[j, Spring.SLACK_SPRING_STIFFNESS_CHANGE],
        )
    return 0.0, 0.0, 0.0


@inlined
def shaped_input(drive, u):
    """Return the input after dead zone, saturation and similar laws."""
    if drive[Drive.DEAD_ZONE_WIDTH] != 0.0:
        u = (1.0 if u > 0.0 else -1.0) * max(0, -drive[Drive.DEAD_ZONE_WIDTH] + abs(u))
    if drive[Drive.SATURATION_LIMIT] != 0.0:
        u = min(drive[Drive.SATURATION_LIMIT], max(u, -drive[Drive.SATURATION_LIMIT]))
    return u


ON_CARTS, ON_SPRINGS, ON_DRIVE = 1, 2, 4  # flags for the places of smooth forces


@jit
def longest_step(cart, spring, drive):
    """Return the longest step for the laws, in s, and flags such as `ON_CARTS`."""
    longest, smooth = inf, 0
    for i in range(cart.shape[0]):
        if cart[i, Cart.STICTION_STATIC_FORCE] > cart[i, Cart.COULOMB_FRICTION_FORCE]:
            longest = min(longest, 0.0012)
        if cart[i, Cart.PRESLIDING_FRICTION_FORCE] != 0.0:
            longest = min(longest, 0.0023)
        if cart[i, Cart.QUADRATIC_DRAG_COEFFICIENT] != 0.0:
            longest = min(longest, 0.0025)
            smooth |= ON_CARTS
        if cart[i, Cart.FORCE_OFFSET_FORCE] != 0.0:
            longest = min(longest, 0.0025)
            smooth |= ON_CARTS
    for j in range(spring.shape[0]):
        if spring[j, Spring.CUBIC_SPRING_COEFFICIENT] != 0.0:
            longest = min(longest, 0.0025)
            smooth |= ON_SPRINGS
        if spring[j, Spring.ASYMMETRIC_SPRING_COEFFICIENT] != 0.0:
            longest = min(longest, 0.0025)
            smooth |= ON_SPRINGS
    if drive[Drive.DRIVE_DAMPING_COEFFICIENT] != 0.0:
        smooth |= ON_DRIVE
    if drive[Drive.COGGING_FORCE] != 0.0:
        longest = min(longest, 0.001)
        smooth |= ON_DRIVE
    return longest, smooth
