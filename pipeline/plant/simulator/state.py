"""Structures that the compiled functions share.

They are named tuples, because numba compiles these to separate fields.
"""

from typing import NamedTuple

from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.simulator.compiler import jit

# Rows of the state table.
# - X to INV: position, velocity, presliding state, last acceleration and inverse mass.
# - MID_X to FORCE: position and velocity in the middle of the step, and the force.
# - D2 to D6: time derivatives 2 to 6 of the position.
# - SIDE to FIX: direction in which the cart slides, inverse mass (0 for a cart held by friction),
# decay of the presliding state over half a step, constant forces of closed contacts.
# - RUB to PAST: dry friction force, acceleration before an event, whether an event has just changed
# the acceleration, whether a spring is stretched past its gap.
# - HALF_X to HALF_A: position, velocity and acceleration halfway to the next event or to the end of
# the step.
X, V, Z, ACC, INV, MID_X, MID_V, FORCE, D2, D3, D4, D5, D6, SIDE, GRIP, DECAY, FIX = range(17)
RUB, BEFORE, TURNED, PAST, HALF_X, HALF_V, HALF_A = range(17, 24)
ROWS = 24


class Bodies(NamedTuple):
    """Carts, motor and hidden masses: the linear part of the plant, and its state.

    Attributes
    ----------
    n, N : number of carts, and of all bodies.
    motor : the motor's row, or -1 if the motor is not a separate body.
    driven : row of the body on which the input acts.
    parent : row of the cart that carries a hidden mass; -1 for other bodies.
    s : the state table.
    K, C : the stiffness and damping matrices. Closed contacts are included.
    switches : numbers of the existing contacts and slack springs, as in `guard`.
    active : whether each of the switches is closed.
    """

    n: int
    N: int
    motor: int
    driven: int
    parent: NDArray
    s: Array
    K: Array
    C: Array
    switches: NDArray
    active: NDArray


class Push(NamedTuple):
    """The forces and options for a step of `h` s.

    Attributes
    ----------
    u : mean input that arrives during the step.
    on : 1 if the drive is powered, otherwise 0.
    scatter : factor (n,) on all dry friction of each cart.
    dry : whether there is dry friction.
    smooth : flags for the places of smooth forces, from `reach_of`.
    contact_step : longest step inside a contact.
    """

    u: float
    on: float
    h: float
    scatter: Array
    dry: bool
    smooth: int
    contact_step: float


@jit
def add_spring(M, j, n, value):
    """Add `value` for a spring j (0 to n) of n carts to a symmetric matrix."""
    if j < n:
        M[j, j] += value
    if j > 0:
        M[j - 1, j - 1] += value
    if 0 < j < n:
        M[j, j - 1] -= value
        M[j - 1, j] -= value


@jit
def pair(M, i, j, value):
    """Add `value` between bodies i and j, or i and a wall (-1), to a symmetric matrix."""
    M[i, i] += value
    if j >= 0:
        M[j, j] += value
        M[i, j] -= value
        M[j, i] -= value


@jit
def stretch(s, row, j, n):
    """Return the stretch of spring j of n carts, from a row of the state table."""
    return (s[row, j] if j < n else 0.0) - (s[row, j - 1] if j > 0 else 0.0)
