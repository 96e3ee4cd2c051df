"""Names of parameters, as in Tables 1-3 of the paper. Only this module splits names into parts.

`K_1` is the static gain of cart 1. `omega_2` and `zeta_2` belong to cart 2 with the other carts
held. `omega_a`, `omega_b`, … are resonances. With three carts, `omega_x` and `omega_y` are the
nulls of cart 1. A single cart has no index: `K`, `omega_n`, `zeta`. A single cart without a spring
has `mass` and `damping`.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

from pipeline.setup import Units

MODES = "abcdefgh"  # resonances, ascending in frequency
NULLS = "xy"  # frequencies at which cart 1 of three hardly moves


@dataclass(frozen=True)
class Name:
    """A parameter's name in two parts: "omega_a" has the symbol "omega" and the suffix "a"."""

    symbol: str
    suffix: str

    @property
    def is_gain(self) -> bool:
        """Whether the parameter is a static gain; its unit is position per input."""
        return self.symbol == "K"

    @property
    def is_frequency(self) -> bool:
        """Whether the parameter is a frequency, rad/s."""
        return self.symbol == "omega"

    @property
    def is_ratio(self) -> bool:
        """Whether the parameter is a damping ratio."""
        return self.symbol == "zeta"

    @property
    def is_damping(self) -> bool:
        """Whether the parameter is a damping ratio or coefficient; these are harder to estimate."""
        return self.symbol in ("zeta", "damping")

    @property
    def is_mode(self) -> bool:
        """Whether the parameter belongs to a resonance of all carts together."""
        return self.suffix == "n" or (self.suffix != "" and self.suffix in MODES)

    @property
    def is_null(self) -> bool:
        """Whether the parameter belongs to a null of cart 1, with three carts."""
        return self.suffix != "" and self.suffix in NULLS

    @property
    def is_by_eye(self) -> bool:
        """Whether the first estimate is read off a plot: resonances and nulls of several carts."""
        return self.suffix != "" and self.suffix in MODES + NULLS

    @property
    def cart(self) -> int | None:
        """The cart (or spring) that the parameter belongs to, counted from 1."""
        return int(self.suffix) if self.suffix.isdigit() else None

    @property
    def damping(self) -> str:
        """The name of the damping ratio that belongs to this frequency: "zeta_1" for "omega_1"."""
        return mode_zeta(self.suffix)

    @property
    def words(self) -> str:
        """The name in words: "damping ratio ζ of cart 1"."""
        symbols = {"K": "static gain K", "omega": "frequency ω", "zeta": "damping ratio ζ"}
        place = ""
        if self.cart is not None:
            place = f" of cart {self.suffix}"
        elif self.is_by_eye and self.suffix != "n":
            place = f" of {'null' if self.is_null else 'resonance'} {self.suffix}"
        return symbols.get(self.symbol, self.symbol) + place

    def unit(self, units: Units) -> str:
        """Return the parameter's unit; "" for a damping ratio."""
        by_symbol = {
            "K": units.gain,
            "omega": "rad/s",
            "mass": units.mass,
            "damping": units.damping,
        }
        return by_symbol.get(self.symbol, "")


@cache
def read_name(name: str) -> Name:
    """Return a parameter's name in its parts."""
    symbol, _, suffix = name.partition("_")
    return Name(symbol, suffix)


def names_beginning(names: Iterable[str], prefix: str) -> list[str]:
    """Return the names that begin with `prefix`, such as "zeta" or "omega_1"."""
    return [name for name in names if name.startswith(prefix)]


def gain_name(cart: int, *, n: int) -> str:
    """Return the name of a cart's static gain, in a chain of n."""
    return "K" if n == 1 else f"K_{cart}"


def own_omega(cart: int, *, n: int) -> str:
    """Return the name of the natural frequency of a cart while the other carts are held."""
    return "omega_n" if n == 1 else f"omega_{cart}"


def own_zeta(cart: int, *, n: int) -> str:
    """Return the name of the damping ratio of a cart while the other carts are held."""
    return "zeta" if n == 1 else f"zeta_{cart}"


def mode_suffixes(n: int) -> list[str]:
    """Return the suffixes of the n resonances, ascending in frequency."""
    return ["n"] if n == 1 else list(MODES[:n])


def mode_zeta(suffix: str) -> str:
    """Return the name of the damping ratio of a resonance or null."""
    return "zeta" if suffix == "n" else f"zeta_{suffix}"


def omega_names(suffixes: Iterable[str]) -> list[str]:
    """Return the names of the frequencies that have these suffixes."""
    return [f"omega_{suffix}" for suffix in suffixes]


def derived_names(n: int) -> list[str]:
    """Return the parameters of n carts that follow from the others, if there are any.

    These are the frequencies and dampings of each cart alone, but for the last cart.
    """
    carts = range(1, n) if n in (2, 3) else ()
    return [f"{symbol}_{cart}" for cart in carts for symbol in ("omega", "zeta")]


def parameter_names(n: int, *, rigid: bool = False) -> list[str]:
    """Return the names of all parameters of n carts, in the order of the paper's tables."""
    if n == 1:
        return ["mass", "damping"] if rigid else ["K", "omega_n", "zeta"]
    carts = [str(cart) for cart in range(1, n + 1)]
    names = [f"K_{cart}" for cart in carts]
    for group in (MODES[:n], NULLS if n == 3 else "", carts):
        names += [f"{symbol}_{suffix}" for symbol in ("omega", "zeta") for suffix in group]
    return names


def toml_flags(flags: Iterable[bool]) -> str:
    """Return flags as TOML text: "[false, true]"."""
    return f"[{', '.join('true' if flag else 'false' for flag in flags)}]"
