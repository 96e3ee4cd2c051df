"""The orders that gains, resonances and nulls of a real chain of carts stand in."""

from collections.abc import Sequence
from itertools import pairwise


def orders(names: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return (lesser, greater, why) of every order that the named parameters obey.

    The names may come in any order.
    """
    names = sorted(names)
    gains = [name for name in names if name.startswith("K_")]
    modes = [n for n in names if n.startswith("omega_") and n[-1] in "abcdefgh"]
    alone = [n for n in names if n.startswith("omega_") and n[-1].isdigit()]
    found = [
        (far, near, "a cart further from the motor is moved less by a constant input")
        for near, far in pairwise(gains)
    ]
    found += [(a, b, "the resonances are listed in rising order") for a, b in pairwise(modes)]
    if modes:
        why = "a cart alone swings faster than all together at the first resonance, and slower "
        why += "than at the last"
        found += [(modes[0], name, why) for name in alone]
        found += [(name, modes[-1], why) for name in alone]
    if {"omega_x", "omega_y"} <= set(names) and len(modes) == 3:
        why = "each null of cart 1 lies between two resonances"
        a, b, c = modes
        found += [(a, "omega_x", why), ("omega_x", b, why), (b, "omega_y", why)]
        found += [("omega_y", c, why)]
        why = "carts 2 and 3 alone lie between the nulls of cart 1"
        for name in ("omega_2", "omega_3"):
            found += [("omega_x", name, why), (name, "omega_y", why)] * (name in names)
    return found
