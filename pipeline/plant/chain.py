"""The linear plant: n carts in a chain of springs, the motor's force on cart 1.

    m_i x_i'' + c_i x_i' + k_i (x_i - x_{i-1}) + k_{i+1} (x_i - x_{i+1}) = u on cart 1, 0 elsewhere

with x_0 = x_{n+1} = 0 (the walls). The input gain is one, so masses, dampings and stiffnesses
are in input units (V s²/cm, V s/cm, V/cm) and nothing needs weighing.

Reference: R. D. Throne, "Frequency Domain System Identification of One, Two, and Three Degree
of Freedom Systems in an Introductory Controls Class", Proc. ASEE Annual Conference, 2005.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import DataError
from pipeline.names import MODES, NULLS, parameter_names

if TYPE_CHECKING:
    import control  # half a second: imported where it is used

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def frozen_array(values: object, *, name: str, shape: tuple[int, ...] | None = None) -> Array:
    """Return a read-only float64 copy, its shape checked."""
    array = np.array(values, dtype=np.float64)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, found {array.shape}")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """Masses, dampings and springs of n carts.

    Attributes
    ----------
    m : (n,) masses, input unit s² per position unit; all > 0.
    c : (n,) viscous dampings, input unit s per position unit.
    k : (n + 1,) stiffnesses wall-1, 1-2, …, n-wall, input unit per position unit; 0 = no spring.
        One cart on two springs: only the sum is identifiable, and `k` is (sum, 0).
    """

    m: Array
    c: Array
    k: Array

    def __post_init__(self) -> None:
        m = frozen_array(self.m, name="m")
        object.__setattr__(self, "m", m)
        object.__setattr__(self, "c", frozen_array(self.c, name="c", shape=m.shape))
        object.__setattr__(self, "k", frozen_array(self.k, name="k", shape=(m.size + 1,)))

    @property
    def n(self) -> int:
        """Number of carts."""
        return self.m.size

    # ---------------------------------------------------------------- matrices

    @cached_property
    def stiffness(self) -> Array:
        """K, (n, n): the restoring force is K x."""
        k = self.k
        return np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)

    def matrices(self, *, free: Sequence[int] | None = None) -> tuple[Array, Array, Array, Array]:
        """Return M, C, K (f, f) and the force vector (f,) of the free carts, the others held.

        A held cart is a wall: its row and column go. Holding cart 1 leaves no input.
        """
        rows = self._rows(free)
        force = np.array([1.0 if row == 0 else 0.0 for row in rows])
        return (
            np.diag(self.m[rows]),
            np.diag(self.c[rows]),
            self.stiffness[np.ix_(rows, rows)],
            force,
        )

    def state_space(
        self, *, free: Sequence[int] | None = None
    ) -> tuple[Array, Array, Array, Array]:
        """Return A (2f, 2f), B (2f, 1), C (f, 2f), D (f, 1); the state is (x1, v1, x2, v2, …)."""
        mass, damping, stiffness, force = self.matrices(free=free)
        f = force.size
        inverse = 1.0 / np.diag(mass)
        A = np.zeros((2 * f, 2 * f))
        A[0::2, 1::2] = np.eye(f)
        A[1::2, 0::2] = -inverse[:, None] * stiffness
        A[1::2, 1::2] = np.diag(-inverse * np.diag(damping))
        B = np.zeros((2 * f, 1))
        B[1::2, 0] = inverse * force
        C = np.zeros((f, 2 * f))
        C[:, 0::2] = np.eye(f)
        return A, B, C, np.zeros((f, 1))

    def to_control(self, *, free: Sequence[int] | None = None) -> "control.StateSpace":
        """Return the free carts as python-control's system, the others held.

        States `x1, v1, x2, v2, …`, input `u`, outputs `x1, x2, …`, numbered as the carts are.
        """
        import control

        carts = [row + 1 for row in self._rows(free)]
        return control.StateSpace(
            *self.state_space(free=free),
            inputs=["u"],
            outputs=[f"x{cart}" for cart in carts],
            states=[f"{letter}{cart}" for cart in carts for letter in "xv"],
            name="carts",
        )

    def _rows(self, free: Sequence[int] | None) -> list[int]:
        carts = range(1, self.n + 1) if free is None else sorted(set(free))
        if any(not 1 <= cart <= self.n for cart in carts):
            raise ValueError(f"free carts {list(carts)} are not among 1 to {self.n}")
        return [cart - 1 for cart in carts]

    # ---------------------------------------------------- poles and responses

    @cached_property
    def poles(self) -> ComplexArray:
        """The 2n poles, as `eigvals` of A gives them (unsorted)."""
        return np.linalg.eigvals(self.state_space()[0]).astype(np.complex128)

    def static_gains(self) -> Array:
        """K_i (n,), position unit per input unit.

        Raises
        ------
        DataError : no spring holds the carts, so a constant force has no rest position; or springs
            so far apart in stiffness that the numbers cannot tell.
        """
        if not self.is_tied:
            raise DataError("no spring ties the carts to a wall: there is no static gain")
        try:
            return np.linalg.solve(self.stiffness, np.eye(self.n)[:, 0]).astype(np.float64)
        except np.linalg.LinAlgError:
            raise DataError(
                f"static gains need springs of comparable stiffness, found {self.k.min():.1e} to "
                f"{self.k.max():.1e}"
            ) from None

    @property
    def is_tied(self) -> bool:
        """Whether every cart is tied to a wall, by its own springs or through its neighbours."""
        from_left = np.logical_and.accumulate(self.k[:-1] != 0)
        from_right = np.logical_and.accumulate(self.k[:0:-1] != 0)[::-1]
        return bool(np.all(from_left | from_right))

    def frequency_response(self, omega: Array) -> ComplexArray:
        """Return X_i/U at `omega` (n_w,), rad/s; shape (n, n_w), position unit per input unit.

        At a pole without damping the response is infinite.
        """
        s = 1j * np.asarray(omega, dtype=np.float64)
        eye = np.eye(self.n)
        Z = (
            self.stiffness
            + s[:, None, None] * (self.c * eye)
            + (s**2)[:, None, None] * (self.m * eye)
        )
        at_pole = np.linalg.slogdet(Z).sign == 0
        Z[at_pole] = eye
        force = np.broadcast_to(eye[:, :1], (s.size, self.n, 1))
        G = np.linalg.solve(Z, force)[:, :, 0].astype(np.complex128)
        G[at_pole] = np.inf
        return G.T

    # ------------------------------------------------------ the map to names

    @property
    def omega_carts(self) -> Array:
        """omega_i (n,), rad/s: each cart alone, the others held."""
        return np.sqrt((self.k[:-1] + self.k[1:]) / self.m)

    @property
    def zeta_carts(self) -> Array:
        """zeta_i (n,): each cart alone, the others held; infinite where no spring holds it."""
        with np.errstate(divide="ignore"):
            return self.c / (2 * self.m * self.omega_carts)

    def tails(self) -> list[Array]:
        """Return T_1 … T_{n+1}, monic in falling powers: T_i belongs to carts i to n alone.

        T_1 is the common denominator; X_i/U is K_i T_{i+1}(s)/T_{i+1}(0) over T_1(s)/T_1(0).
        T_i = P_i T_{i+1} - kappa_{i+1} T_{i+2}, kappa_j = k_j² / (m_{j-1} m_j).
        """
        P = [
            np.array([1.0, self.c[i] / self.m[i], (self.k[i] + self.k[i + 1]) / self.m[i]])
            for i in range(self.n)
        ]
        tails = [np.array([1.0])]
        for i in range(self.n - 1, -1, -1):
            T = np.polymul(P[i], tails[0])
            if i < self.n - 1:
                kappa = self.k[i + 1] ** 2 / (self.m[i] * self.m[i + 1])
                T = np.polysub(T, kappa * tails[1])
            tails.insert(0, T)
        return tails

    def zeros(self, cart: int) -> ComplexArray:
        """Return the 2(n - cart) zeros of X_cart/U."""
        return np.roots(self.tails()[cart]).astype(np.complex128)

    def transfer_function(self, cart: int) -> tuple[Array, Array]:
        """Return numerator and denominator of X_cart/U, in falling powers; the latter is monic."""
        tails = self.tails()
        reach = np.prod(self.k[1:cart] / self.m[1:cart]) / self.m[0]
        return reach * tails[cart], tails[0]

    def parameters(self) -> dict[str, float]:
        """Return the named parameters of this chain, in the order of the paper's Tables 1-3.

        `K, omega_n, zeta` for one cart (`mass, damping` where it has no spring); two and three
        carts as in Tables 2 and 3; more carts as for two, with further letters and numbers.

        Raises
        ------
        DataError : several carts that no spring ties to a wall have no static gains.
        """
        if self.n == 1 and self.k.sum() == 0:
            return {"mass": float(self.m[0]), "damping": float(self.c[0])}
        gains = self.static_gains()
        omega, zeta = quadratic_factors(self.poles)
        if self.n == 1:
            return {"K": float(gains[0]), "omega_n": float(omega[0]), "zeta": float(zeta[0])}
        values = [*gains, *omega, *zeta]
        if self.n == 3:
            null_omega, null_zeta = quadratic_factors(self.zeros(1))
            values += [*null_omega, *null_zeta]
        values += [*self.omega_carts, *self.zeta_carts]
        return dict(zip(parameter_names(self.n), map(float, values), strict=True))


def quadratic_factors(roots: ComplexArray) -> tuple[Array, Array]:
    """Return omega and zeta of s² + 2 zeta omega s + omega² for pairs of roots, omega ascending.

    Complex roots pair with their conjugates; real roots pair by size, so that an overdamped
    factor has zeta > 1.
    """
    roots = np.asarray(roots, dtype=np.complex128)
    is_real = np.abs(roots.imag) <= 1e-9 * np.abs(roots)
    real = np.sort(roots[is_real].real)
    upper = roots[~is_real & (roots.imag > 0)]
    omega = [*np.abs(upper), *np.sqrt(np.abs(real[0::2] * real[1::2]))]
    minus_real = [*(-upper.real), *(-(real[0::2] + real[1::2]) / 2)]
    order = np.argsort(omega)
    omega_sorted = np.array(omega)[order]
    with np.errstate(divide="ignore", invalid="ignore"):
        zeta = np.where(omega_sorted > 0, np.array(minus_real)[order] / omega_sorted, np.inf)
    return omega_sorted, zeta


# ------------------------------------------------------------------ the map back


@dataclass(frozen=True, kw_only=True, eq=False)
class Recovered:
    """The chain that a set of transfer functions implies; arrays may go on with more axes.

    Attributes
    ----------
    m, c : (n,), k : (n + 1,), as in `Chain`, but as found: a measured table may well imply a
        negative spring, which `Chain` users must see and not have hidden.
    damping_terms, stiffness_terms : (n,) 2 zeta_i omega_i and omega_i² of each cart alone.
    couplings : (n - 1,) k² over both masses, of the springs between the carts.
    routes : the redundancies R1, R2, …: two routes to one number.
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
        """The redundancies of a single chain, each as relative difference."""
        return {name: _relative_difference(*map(float, two)) for name, two in self.routes.items()}

    def chain(self) -> Chain:
        """Return the chain, as found (stiffnesses may be negative)."""
        return Chain(m=self.m, c=self.c, k=self.k)


def recover_chain(gains: Array, tails: Sequence[Array]) -> Recovered:
    """Recover masses, dampings and springs from static gains and the polynomials T_1 … T_n.

    `gains` is (n,); `tails` are monic, in falling powers, T_i of degree 2 (n - i + 1). Further axes
    hold further chains. Uses the best-conditioned route for every number (the s¹ coefficients only
    serve as checks: rounding grows some 15 times along them) and returns what is left over.
    """
    n, others = len(gains), tails[0].shape[1:]
    T = [*tails, np.ones((1, *others))]
    g, square, left = np.zeros((3, n, *others))  # left: k_i / m_i
    kappa = np.zeros((n, *others))  # kappa[i] couples carts i and i + 1 (counted from 1)
    routes: list[tuple[Array, Array]] = []
    for i in range(n - 1, -1, -1):  # from the far end, where the transfer function has no zeros
        whole, rest = T[i], T[i + 1]
        g[i] = whole[1] - (rest[1] if len(rest) > 1 else 0.0)
        square[i] = whole[2] - (rest[2] + g[i] * rest[1] if len(rest) > 1 else 0.0)
        if i < n - 1:
            beyond = T[i + 2]
            kappa[i + 1] = (square[i] * rest[-1] - whole[-1]) / beyond[-1]
            rebuilt = _product([np.stack([np.ones(others), g[i], square[i]]), rest])
            rebuilt[-len(beyond) :] -= kappa[i + 1] * beyond
            # The coefficients that no step above has used are the redundancies.
            routes += [(rebuilt[j], whole[j]) for j in range(3, len(whole) - 1)]
        if i > 0:
            left[i] = gains[i] / gains[i - 1] * whole[-1] / rest[-1]
    m, k = np.zeros((n, *others)), np.zeros((n + 1, *others))
    m[0] = T[1][-1] / (gains[0] * T[0][-1])
    for i in range(1, n):
        k[i] = m[i - 1] * kappa[i] / left[i]
        m[i] = k[i] / left[i]
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
    """Return the static gains (n,) and T_1 … T_n that named parameters of 1 to 3 carts stand for.

    `values` uses the names of `Chain.parameters`; the recomputed ones (omega_1, …) are not read,
    except the last cart's, which is the zero of the cart before it.
    """
    if "omega_n" in values:
        return np.array([values["K"]]), [_quadratic(values, "n", zeta="zeta")]
    n = 3 if "K_3" in values else 2
    factors = [MODES[:n], *([NULLS] if n == 3 else []), str(n)]
    tails = [_product([_quadratic(values, suffix) for suffix in group]) for group in factors]
    return np.array([values[f"K_{i}"] for i in range(1, n + 1)]), tails


def _product(polynomials: Sequence[Array]) -> Array:
    """Return the product of polynomials, coefficients along the first axis."""
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
    """Recover the chain from named parameters (1 to 3 carts), with the redundancies left over.

    Two carts have 8 transfer-function parameters for 7 physical ones (R1); three have 15 for 10
    (R1 to R5). A table that a real chain made leaves them at zero.
    """
    return recover_chain(*transfer_functions(values))


# --------------------------------------------------------------------- presets

# In V, cm, s, from the paper's tables, with no spring to the near wall (the constrained optimum
# for both): throne-1dof is Table 1 exactly, throne-2dof rounds to all eight independent final
# values of Table 2, throne-3dof is the nearest real chain to Table 3.
PRESETS: Mapping[str, Chain] = {
    "throne-1dof": Chain(
        m=np.array([1.98587e-4]), c=np.array([5.24270e-4]), k=np.array([0.0346021, 0.0])
    ),
    "throne-2dof": Chain(
        m=np.array([3.128204e-4, 1.737182e-4]),
        c=np.array([6.663748e-4, 4.408337e-4]),
        k=np.array([0.0, 0.1274783, 0.06085252]),
    ),
    "throne-3dof": Chain(
        m=np.array([3.2732e-4, 2.516715e-4, 1.960671e-4]),
        c=np.array([1.520765e-3, 4.32763e-4, 3.40361e-4]),
        k=np.array([0.0, 0.1234592, 0.06648407, 0.06275727]),
    ),
}
