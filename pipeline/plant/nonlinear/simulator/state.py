"""Structures that the compiled functions share.

They are named tuples, which numba compiles to separate fields.
"""

from typing import NamedTuple

from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.nonlinear.simulator.compiler import jit

# Rows of the state table.
# - X to INV. Position, velocity, presliding state, last acceleration and inverse mass.
# - MID_X to FORCE. Position and velocity in the middle of the step, and the force.
# - D2 to D6. Time derivatives 2 to 6 of the position.
# - SIDE to FIX. Direction of dry friction, inverse mass with it (0 for a cart that sticks), decay
# of the presliding state over half a step, constant forces of closed contacts.
# - RUB to PAST. Dry friction force, acceleration before an event, whether an event has just changed
# it, which springs are past their stretch.
# - HALF_X to HALF_A. Position, velocity and acceleration in the middle of the step, which an event
# may have shortened.
X, V, Z, ACC, INV, MID_X, MID_V, FORCE, D2, D3, D4, D5, D6, SIDE, GRIP, DECAY, FIX = range(17)
RUB, BEFORE, TURNED, PAST, HALF_X, HALF_V, HALF_A = range(17, 24)
ROWS = 24


class Bodies(NamedTuple):
    """Carts, motor and hidden masses: the linear part of the plant, and its state.

    Attributes
    ----------
    n, N : number of carts, and of all bodies.
    motor : the motor's row, or -1.
    driven : row of the body on which the input acts.
    parent : for each hidden mass, its cart. Otherwise -1.
    s : the table of the state.
    K, C : the linear matrices. Closed contacts are included.
    switches : numbers of the existing contacts and slack springs. See `guard`.
    active : which of them are closed.
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
    """The forces and options of a step of `h` s.

    Attributes
    ----------
    u : mean input that arrives during the step.
    on : whether the drive is powered. 1 or 0.
    scatter : (n,) factor on all dry friction of a cart.
    dry : whether there is dry friction.
    smooth : where there are smooth forces. See `reach_of`.
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
def tie(M, j, n, value):
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
