"""The order of gains, resonances and nulls in a real chain of carts.

Holding a cart raises every frequency. So, without damping, resonances and nulls interlace (Cauchy).
With heavy damping they may not.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from pipeline.names import MODES, NULLS, omega_names, read_name

_GAINS = "a cart further from the motor is moved less by a constant input"
_ALONE = (
    "a cart alone oscillates faster than the first resonance of all carts and slower than the last"
)
_NULLS = "each null of cart 1 lies between two resonances"
_INNER = "carts 2 and 3 alone lie between the nulls of cart 1"


class Bracket(NamedTuple):
    """Three frequencies by name, of which `middle` lies between the others."""

    low: str
    middle: str
    high: str
    why: str


def brackets(n: int) -> list[Bracket]:
    """Return the brackets of a chain of two or more carts that has all its springs."""
    modes, alone = omega_names(MODES[:n]), omega_names(map(str, range(1, n + 1)))
    found = [Bracket(modes[0], name, modes[-1], _ALONE) for name in alone]
    if n == 3:
        first, second = omega_names(NULLS)
        found.append(Bracket(modes[0], first, modes[1], _NULLS))
        found.append(Bracket(modes[1], second, modes[2], _NULLS))
        found += [Bracket(first, name, second, _INNER) for name in alone[1:]]
    return found


def orders(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return (lesser, greater, why) for every order that the named parameters must obey.

    The names may have any order, and some of a chain's names may be missing.
    """
    names = sorted(names)
    gains = [name for name in names if read_name(name).is_gain and read_name(name).cart]
    modes = [name for name in names if name in omega_names(MODES)]
    n = max(
        [read_name(name).cart or 0 for name in names]
        + [MODES.index(m[-1]) + 1 for m in modes[-1:]],
        default=0,
    )
    found = [(far, near, _GAINS) for near, far in pairwise(gains)]
    found += [(a, b, "the resonances are listed in rising order") for a, b in pairwise(modes)]
    between = brackets(n) if n > 1 else []
    alone, others = [b for b in between if b.why == _ALONE], [b for b in between if b.why != _ALONE]
    found += [(b.low, b.middle, b.why) for b in alone]
    found += [(b.middle, b.high, b.why) for b in alone]
    for b in others:
        found += [(b.low, b.middle, b.why), (b.middle, b.high, b.why)]
    return [order for order in found if {order[0], order[1]} <= set(names)]
