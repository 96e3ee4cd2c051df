"""The order that the frequencies and gains of a real chain keep, and the chain that they imply.

Holding a cart raises every frequency. So, without damping, resonances and nulls interlace (Cauchy).
With heavy damping they may not.

Reference: R. D. Throne, "Frequency Domain System Identification of One, Two, and Three Degree of
Freedom Systems in an Introductory Controls Class", Proc. ASEE Annual Conference, 2005.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pipeline.arrays import Array
from pipeline.names import MODES, NULLS, omega_names, read_name
from pipeline.plant.chain import Chain

HEAVY_DAMPING = 0.3  # damping ratio; above it, resonances and nulls may lose their usual order
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


def interlacing_brackets(n: int) -> list[Bracket]:
    """Return the brackets of a chain of two or more carts that has all its springs."""
    modes, alone = omega_names(MODES[:n]), omega_names(map(str, range(1, n + 1)))
    found = [Bracket(modes[0], name, modes[-1], _ALONE) for name in alone]
    if n == 3:
        first, second = omega_names(NULLS)
        found.append(Bracket(modes[0], first, modes[1], _NULLS))
        found.append(Bracket(modes[1], second, modes[2], _NULLS))
        found += [Bracket(first, name, second, _INNER) for name in alone[1:]]
    return found


def parameter_orders(names: Sequence[str]) -> list[tuple[str, str, str]]:
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
    between = interlacing_brackets(n) if n > 1 else []
    alone, others = [b for b in between if b.why == _ALONE], [b for b in between if b.why != _ALONE]
    found += [(b.low, b.middle, b.why) for b in alone]
    found += [(b.middle, b.high, b.why) for b in alone]
    for b in others:
        found += [(b.low, b.middle, b.why), (b.middle, b.high, b.why)]
    return [order for order in found if {order[0], order[1]} <= set(names)]


@dataclass(frozen=True, kw_only=True, eq=False)
class Recovered:
    """The chain implied by a set of transfer functions; extra axes of arrays hold further chains.

    Attributes
    ----------
    m, c, k : masses (n,), dampings (n,) and stiffnesses (n + 1,). A measured table may imply a
        negative stiffness, which is kept.
    damping_terms : 2 zeta_i omega_i (n,) of each cart with the others held.
    stiffness_terms : omega_i² (n,) of each cart with the others held.
    couplings : for each spring between carts (n - 1,), k² over the product of the two masses.
    routes : the redundancies R1, R2, …, each a pair of values for one number computed in two ways.
    """

    m: Array
    c: Array
    k: Array
    damping_terms: Array
    stiffness_terms: Array
    couplings: Array
    routes: dict[str, tuple[Array, Array]]

    @property
    def residuals(self) -> dict[str, float]:
        """The redundancies of a single chain, each as a relative difference."""
        return {name: _relative_difference(*map(float, two)) for name, two in self.routes.items()}

    def chain(self) -> Chain:
        """Return the chain as computed; stiffnesses may be negative."""
        return Chain(m=self.m, c=self.c, k=self.k)


def recover_chain(gains: Array, subchain_polynomials: Sequence[Array]) -> Recovered:
    """Compute masses, dampings and springs from static gains and the polynomials T_1 … T_n.

    `gains` is (n,); `subchain_polynomials` are monic, in falling powers, T_i of degree 2 (n - i +
    1). Extra axes hold further chains. Each number is computed in the best-conditioned way. The s¹
    coefficients serve only as checks, because they amplify rounding some 15 times.
    """
    n, others = len(gains), subchain_polynomials[0].shape[1:]
    T = [*subchain_polynomials, np.ones((1, *others))]
    g, square, ratio = np.zeros((3, n, *others))  # ratio: k_i / m_i
    kappa = np.zeros((n, *others))  # kappa[i] couples carts i and i + 1 (counted from 1)
    routes: list[tuple[Array, Array]] = []
    for i in range(n - 1, -1, -1):  # the far end comes first, since it has no zeros
        whole, rest = T[i], T[i + 1]
        g[i] = whole[1] - (rest[1] if len(rest) > 1 else 0.0)
        square[i] = whole[2] - (rest[2] + g[i] * rest[1] if len(rest) > 1 else 0.0)
        if i < n - 1:
            beyond = T[i + 2]
            kappa[i + 1] = (square[i] * rest[-1] - whole[-1]) / beyond[-1]
            rebuilt = _product([np.stack([np.ones(others), g[i], square[i]]), rest])
            rebuilt[-len(beyond) :] -= kappa[i + 1] * beyond
            # Coefficients that were not used above give the redundancies.
            routes += [(rebuilt[j], whole[j]) for j in range(3, len(whole) - 1)]
        if i > 0:
            ratio[i] = gains[i] / gains[i - 1] * whole[-1] / rest[-1]
    m, k = np.zeros((n, *others)), np.zeros((n + 1, *others))
    m[0] = T[1][-1] / (gains[0] * T[0][-1])
    for i in range(1, n):
        k[i] = m[i - 1] * kappa[i] / ratio[i]
        m[i] = k[i] / ratio[i]
    k[0] = m[0] * square[0] - k[1]  # k[1] is still zero for a single cart
    if n > 1:
        k[n] = m[-1] * square[-1] - k[n - 1]
    routes += [((k[i] + k[i + 1]) / m[i], square[i]) for i in range(1, n - 1)]
    return Recovered(
        m=m,
        c=g * m,
        k=k,
        damping_terms=g,
        stiffness_terms=square,
        couplings=kappa[1:],
        routes={f"R{j}": route for j, route in enumerate(routes, start=1)},
    )


def _relative_difference(a: float, b: float) -> float:
    scale = max(abs(a), abs(b))
    return 0.0 if scale == 0 else abs(a - b) / scale


def transfer_functions(values: Mapping[str, float | Array]) -> tuple[Array, Sequence[Array]]:
    """Return the static gains (n,) and T_1 … T_n from named parameters of 1 to 3 carts.

    `values` uses the names of `Chain.parameters`. The frequencies of single carts (omega_1, …) are
    not used, except the last cart's, which is the zero of the cart before it.
    """
    if "omega_n" in values:
        return np.array([values["K"]]), [_quadratic(values, "n", zeta="zeta")]
    n = 3 if "K_3" in values else 2
    factors = [MODES[:n], *([NULLS] if n == 3 else []), str(n)]
    tails = [_product([_quadratic(values, suffix) for suffix in group]) for group in factors]
    return np.array([values[f"K_{i}"] for i in range(1, n + 1)]), tails


def _product(polynomials: Sequence[Array]) -> Array:
    """Return the product of polynomials, with coefficients along the first axis."""
    result: Array = polynomials[0]
    for other in polynomials[1:]:
        if result.ndim == 1:
            result = np.convolve(result, other)
            continue
        total = np.zeros((len(result) + len(other) - 1, *result.shape[1:]))
        for i, coefficient in enumerate(result):
            total[i : i + len(other)] += coefficient * other
        result = total
    return result


def _quadratic(values: Mapping[str, float | Array], suffix: str, zeta: str | None = None) -> Array:
    omega = np.asarray(values[f"omega_{suffix}"])
    return np.stack([np.ones_like(omega), 2 * values[zeta or f"zeta_{suffix}"] * omega, omega**2])


def recover_from_parameters(values: Mapping[str, float | Array]) -> Recovered:
    """Compute the chain from named parameters (1 to 3 carts), with the redundancies.

    Two carts have 8 transfer-function parameters for 7 physical ones, so one redundancy (R1). Three
    carts have 15 for 10, so five (R1 to R5). In the table of a real chain, both values of each
    redundancy agree.
    """
    return recover_chain(*transfer_functions(values))
