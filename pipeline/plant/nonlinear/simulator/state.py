"""What the compiled functions share: the structures they take.

Structures are tuples with names, which numba compiles to what their fields alone would be.
"""

from typing import NamedTuple

from numpy.typing import NDArray

from pipeline.arrays import Array
from pipeline.plant.nonlinear.simulator.compiler import jit

# Rows of the state table: position, velocity, presliding state, last acceleration, inverse mass,
# state in the middle of the step, force, time derivatives 2 to 6 of the position, and the dry
# friction's direction, the inverse mass it leaves (0 for a cart that sticks), and the decay of the
# presliding state over half a step; constant forces of closed contacts; the dry friction force;
# the acceleration before an event, and whether one has just changed it; which springs are past
# their stretch; position, velocity and acceleration in the middle of what the step has become.
X, V, Z, ACC, INV, MID_X, MID_V, FORCE, D2, D3, D4, D5, D6, SIDE, GRIP, DECAY, FIX = range(17)
RUB, BEFORE, TURNED, PAST, HALF_X, HALF_V, HALF_A = range(17, 24)
ROWS = 24


class Bodies(NamedTuple):
    """Carts, motor and hidden masses: the linear part of the plant, and the state of all that acts.

    `n` are the carts, `N` all bodies; `motor` is the motor's row or -1, `driven` that of the body
    which the input pushes. `parent` has the carts of hidden masses, or -1. `s` is the table of the
    state; `K` and `C` are the linear matrices, closed contacts included. `switches` are the numbers
    of the contacts and slack springs there are, see `guard`, `active` which are closed.
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
    """What acts on the bodies during a step of `h` s.

    `u` is the input that arrives, its mean over the step; `on` whether the drive is powered;
    `scatter` (n,) a factor on all dry friction of a cart. `dry` tells whether there is any,
    `smooth` where there are smooth forces, `contact_step` how long a step may be inside a contact.
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
    """Add `value` between both ends of spring j (0 to n) of n carts to a symmetric matrix."""
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
    """Return by how much spring j of n carts is stretched, by a row of the state table."""
    return (s[row, j] if j < n else 0.0) - (s[row, j - 1] if j > 0 else 0.0)
