"""The linear plant: n carts in a chain of springs, with the motor's force on cart 1.

The equation of motion of cart i is

    m_i x_i'' + c_i x_i' + k_i (x_i - x_{i-1}) + k_{i+1} (x_i - x_{i+1}) = u on cart 1, 0 elsewhere.

The walls are x_0 = x_{n+1} = 0. The input gain is 1, so masses, dampings and stiffnesses are in
input units (V s²/cm, V s/cm, V/cm), and no cart must be weighed.

Reference: R. D. Throne, "Frequency Domain System Identification of One, Two, and Three Degree of
Freedom Systems in an Introductory Controls Class", Proc. ASEE Annual Conference, 2005.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.arrays import Array, ComplexArray, frozen_array
from pipeline.errors import DataError
from pipeline.json_files import FiniteNumbers, result, written
from pipeline.names import parameter_names

if TYPE_CHECKING:
    import control  # takes half a second, so it is imported only where needed


@result(eq=False)
class Chain:
    """Masses, dampings and stiffnesses of a chain, in input units because the input gain is 1."""

    m: FiniteNumbers = written("masses (n), cart 1 first, input unit s² per position unit; all > 0")
    c: FiniteNumbers = written(
        "viscous damping coefficients (n), cart 1 first, input unit s per position unit"
    )
    k: FiniteNumbers = written(
        "stiffnesses (n + 1) wall-1, 1-2, …, n-wall, input unit per position unit; 0 for no "
        "spring; (sum, 0) for one cart on two springs, because only their sum can be identified"
    )

    def __post_init__(self) -> None:
        m = frozen_array(self.m, name="m")
        object.__setattr__(self, "m", m)
        object.__setattr__(self, "c", frozen_array(self.c, name="c", shape=m.shape))
        object.__setattr__(self, "k", frozen_array(self.k, name="k", shape=(m.size + 1,)))

    @property
    def n(self) -> int:
        """The number of carts."""
        return self.m.size

    # ---------------------------------------------------------------- matrices

    @cached_property
    def stiffness(self) -> Array:
        """The stiffness matrix K (n, n); the restoring force is K x."""
        k = self.k
        return np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)

    def matrices(self, *, free: Sequence[int] | None = None) -> tuple[Array, Array, Array, Array]:
        """Return M, C, K (f, f) and the force vector (f,) of the free carts, with the others held.

        A held cart is a wall, so its row and column are removed. If cart 1 is held, there is no
        input.
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
        """Return the free carts as a python-control system, with the others held.

        It has states `x1, v1, x2, v2, …`, input `u` and outputs `x1, x2, …`. The numbers are cart
        numbers, so `x3` is always cart 3.
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
        """The 2n poles, unsorted."""
        return np.linalg.eigvals(self.state_space()[0]).astype(np.complex128)

    def static_gains(self) -> Array:
        """Return the static gains K_i (n,), position unit per input unit.

        Raises
        ------
        DataError : no spring holds the carts, so they never rest under a constant force; or the
            stiffnesses differ by too many orders of magnitude.
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
        """Whether every cart is connected to a wall, directly or through its neighbours."""
        from_left = np.logical_and.accumulate(self.k[:-1] != 0)
        from_right = np.logical_and.accumulate(self.k[:0:-1] != 0)[::-1]
        return bool(np.all(from_left | from_right))

    def frequency_response(self, omega: Array) -> ComplexArray:
        """Return X_i/U (n, n_w) at `omega` (n_w,), rad/s, in position unit per input unit.

        At an undamped pole the response is infinite.
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
        """Natural frequencies omega_i (n,), rad/s, of each cart with the others held."""
        return np.sqrt((self.k[:-1] + self.k[1:]) / self.m)

    @property
    def zeta_carts(self) -> Array:
        """Damping ratios zeta_i (n,), each with the other carts held; infinite without a spring."""
        with np.errstate(divide="ignore"):
            return self.c / (2 * self.m * self.omega_carts)

    def subchain_polynomials(self) -> list[Array]:
        """Return polynomials T_1 … T_{n+1}, monic in falling powers; T_i belongs to carts i to n.

        T_1 is the common denominator. X_i/U is K_i T_{i+1}(s)/T_{i+1}(0) over T_1(s)/T_1(0). With
        kappa_j = k_j² / (m_{j-1} m_j), T_i = P_i T_{i+1} - kappa_{i+1} T_{i+2}.
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
        return np.roots(self.subchain_polynomials()[cart]).astype(np.complex128)

    def transfer_function(self, cart: int) -> tuple[Array, Array]:
        """Return numerator and monic denominator of X_cart/U, in falling powers."""
        tails = self.subchain_polynomials()
        reach = np.prod(self.k[1:cart] / self.m[1:cart]) / self.m[0]
        return reach * tails[cart], tails[0]

    def parameters(self) -> dict[str, float]:
        """Return the named parameters of this chain, in the order of Tables 1-3 in Throne's paper.

        One cart has `K, omega_n, zeta` (`mass, damping` if it has no spring). Two and three carts
        have the parameters of Tables 2 and 3. More carts continue the names of Table 2 with further
        letters and numbers.

        Raises
        ------
        DataError : there are several carts and no spring to a wall, so static gains do not exist.
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

    Complex roots are paired with their conjugates, real roots in order of size. A pair of real
    roots is an overdamped factor, with zeta > 1.
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


# In V, cm and s, from the tables in Throne's paper. throne-1dof is exactly Table 1. throne-2dof
# rounds to all eight independent final values of Table 2. throne-3dof is the real chain nearest to
# Table 3. The last two have no spring to the near wall, because the best fit to the tables needs
# none.
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
