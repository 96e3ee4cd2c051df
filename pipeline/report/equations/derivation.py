"""Derive transfer functions and state model from free bodies, for any number of carts.

All equations are text that `algebra` shows and computes. The tests check each of them against the
impedance matrix with a computer algebra system.

Delta(s) is the monic characteristic polynomial of the whole chain. N(s) is the characteristic
polynomial of carts 2 to n while cart 1 is held. R(s) belongs to carts 3 to n while carts 1 and 2
are held, and P_i(s) to cart i while all other carts are held. The paper's common denominator is
Delta(s) divided by its constant term. With three carts, the paper's numerator of cart 1 is N(s)
divided by its constant term. Coefficients are d_0, d_1, … for Delta, n_0, … for N, and r_0, … for
R.
"""

from collections.abc import Sequence
from itertools import product

from pipeline.plant.chain import Chain
from pipeline.report.equations.algebra import Equation, work_out

MOST_CARTS = 4  # The polynomials of longer chains have no letters.
_LETTERS = "dnr"  # letters of the coefficients
_POLYNOMIALS = ("Delta", "N", "R")
_MODES = "abcd"
_NULLS = "xy"


# ------------------------------------------------------------- equations of motion


def newton(springs: Sequence[bool]) -> list[Equation]:
    """Return Newton's law for every cart, with each force as it acts on the free body."""
    n = len(springs) - 1
    return [
        Equation(f"{of_cart('m', i, n)}*ddx_{i}", "+".join(_forces(i, springs)).replace("+-", "-"))
        for i in range(1, n + 1)
    ]


def _forces(i: int, springs: Sequence[bool]) -> list[str]:
    n = len(springs) - 1
    forces = ["u"] if i == 1 else []
    forces.append(f"-({of_cart('c', i, n)}*dx_{i})")
    if n == 1:
        return [*forces, *(["-k*x_1"] if any(springs) else [])]
    if springs[i - 1]:
        forces.append(f"-k_{i}*x_{i}" if i == 1 else f"-k_{i}*(x_{i}-x_{i - 1})")
    if springs[i]:
        forces.append(f"-k_{i + 1}*x_{i}" if i == n else f"-k_{i + 1}*(x_{i}-x_{i + 1})")
    return forces


def laplace(springs: Sequence[bool]) -> list[Equation]:
    """Return the Laplace transforms of Newton's laws (start from rest), with X_i on the left."""
    n = len(springs) - 1
    equations = []
    for i in range(1, n + 1):
        terms = [f"{of_cart('m', i, n)}*s**2", f"{of_cart('c', i, n)}*s", *springs_at(i, springs)]
        others = [f"k_{j}*X_{k}" for j, k in ((i, i - 1), (i + 1, i + 1)) if 1 <= k <= n]
        others += ["U"] if i == 1 else []
        equations.append(Equation(f"({'+'.join(terms)})*X_{i}", "+".join(others)))
    return equations


def neighbours(i: int, springs: Sequence[bool]) -> list[tuple[int, str]]:
    """Return the carts that a spring connects to cart i, each with the name of the spring."""
    inside = ((j, max(i, j)) for j in (i - 1, i + 1) if 1 <= j < len(springs))
    return [(j, f"k_{spring}") for j, spring in inside if springs[spring - 1]]


def springs_at(i: int, springs: Sequence[bool]) -> list[str]:
    """Return the names of the springs at a cart."""
    if len(springs) == 2:
        return ["k"] if any(springs) else []
    return [f"k_{j}" for j in (i, i + 1) if springs[j - 1]]


def of_cart(letter: str, i: int, n: int) -> str:
    """Return a name such as m_i; a single cart has no index."""
    return letter if n == 1 else f"{letter}_{i}"


# ------------------------------------------------------------- transfer functions


def single_carts(springs: Sequence[bool]) -> list[Equation]:
    """Return equations for frequency and damping of each cart while the others are held."""
    n = len(springs) - 1
    equations = []
    for i in range(1, n + 1):
        held = "+".join(springs_at(i, springs))
        equations += [
            Equation(f"w_{i}", f"({held})/m_{i}"),
            Equation(f"2*zeta_{i}*omega_{i}", f"c_{i}/m_{i}"),
        ]
    return equations


def per_mass(n: int) -> list[Equation]:
    """Return the transformed equations, divided by the masses."""
    equations = []
    for i in range(1, n + 1):
        others = [f"left_{i}*X_{i - 1}"] if i > 1 else []
        others += [f"right_{i}*X_{i + 1}"] if i < n else []
        others += ["inverse_m_1*U"] if i == 1 else []
        equations.append(Equation(f"P_{i}*X_{i}", "+".join(others)))
    return equations


def tail(i: int, n: int) -> str:
    """Return the name of the polynomial of carts i to n: Delta, N, R or P_n; "1" for i > n."""
    if i > n:
        return "1"
    return f"P_{n}" if i == n else _POLYNOMIALS[i - 1]


def elimination(n: int) -> list[Equation]:
    """Return the steps that eliminate the carts, from the last to the first.

    Each step expresses the position of a cart by the position of the previous cart.
    """
    equations = []
    for i in range(n, 1, -1):
        if i < n:
            equations += _tail_equations(i, n)
        above = "" if i == n else f"{tail(i + 1, n)}*"
        equations.append(Equation(f"X_{i}", f"left_{i}*({above}X_{i - 1}/{tail(i, n)})"))
    return [*equations, *_tail_equations(1, n)]


def _tail_equations(i: int, n: int) -> list[Equation]:
    beyond = "" if i + 2 > n else f"*{tail(i + 2, n)}"
    return [
        Equation(f"kappa_{i + 1}", f"right_{i}*left_{i + 1}"),
        Equation(tail(i, n), f"P_{i}*{tail(i + 1, n)}-kappa_{i + 1}{beyond}"),
    ]


def transfer(n: int) -> list[Equation]:
    """Return X_i/U of every cart over the common denominator."""
    equations, chain = [], "inverse_m_1"
    for i in range(1, n + 1):
        chain += f"*left_{i}" if i > 1 else ""
        equations.append(Equation(f"X_{i}/U", f"{chain}*({tail(i + 1, n)}/Delta)"))
    return equations


def static_gains(n: int) -> list[Equation]:
    """Return the static gains, each computed from the gain of the cart before it."""
    first = Equation("K_1", f"inverse_m_1*({_constant(2, n)}/d_0)")
    return [first] + [
        Equation(
            f"K_{i}",
            f"left_{i}*(K_{i - 1}"
            + (f"*{_constant(i + 1, n)}" if i < n else "")
            + f"/{_constant(i, n)})",
        )
        for i in range(2, n + 1)
    ]


def _constant(i: int, n: int) -> str:
    """Return the constant term of the polynomial of carts i to n."""
    return f"w_{n}" if i == n else f"{_LETTERS[i - 1]}_0"


# ------------------------------------ from transfer functions to the entries of A and B


def coefficients(n: int) -> list[Equation]:
    """Return the coefficients of Delta(s) and N(s) from the table's frequencies and dampings."""
    groups = [("d", _MODES[:n])] if n > 1 else []
    groups += [("n", _NULLS)] if n == 3 else []
    equations = [
        Equation(f"g_{mode}", f"2*zeta_{mode}*omega_{mode}")
        for _, modes in groups
        for mode in modes
    ]
    for letter, modes in groups:
        degree = 2 * len(modes)
        equations += [
            Equation(f"{letter}_{k}", _coefficient(modes, degree - k))
            for k in range(degree - 1, -1, -1)
        ]
    return equations


def _coefficient(modes: str, order: int) -> str:
    """Return the coefficient of s^(degree - order) in the product of factors s² + g s + omega²."""
    terms = []
    for powers in product((0, 1, 2), repeat=len(modes)):
        if sum(powers) == order:
            factors = {1: "g_{0}", 2: "omega_{0}**2"}
            terms.append(
                "*".join(
                    factors[p].format(mode) for p, mode in zip(powers, modes, strict=True) if p
                )
            )
    return "+".join(reversed(terms))


def carts_alone(n: int) -> list[Equation]:
    """Return the damping g_i and squared frequency w_i of each cart while the others are held."""
    equations = [Equation(f"g_{n}", f"2*zeta_{n}*omega_{n}"), Equation(f"w_{n}", f"omega_{n}**2")]
    for i in range(n - 1, 0, -1):
        whole, rest = _named(i, n), _named(i + 1, n)
        beyond = "" if i + 2 > n else f"/{_constant(i + 2, n)}"
        equations += [
            Equation(f"g_{i}", f"{whole[1]}-{rest[1]}"),
            Equation(f"w_{i}", f"{whole[2]}-{rest[2]}-g_{i}*{rest[1]}"),
        ]
        kappa = f"w_{i}*{rest[-1]}-{whole[-1]}"
        equations.append(Equation(f"kappa_{i + 1}", f"({kappa}){beyond}" if beyond else kappa))
    return equations


def _named(i: int, n: int) -> list[str]:
    """Return the coefficient names of the polynomial of carts i to n, in falling powers."""
    if i == n:
        return ["1", f"g_{n}", f"w_{n}"]
    degree = 2 * (n - i + 1)
    return ["1", *(f"{_LETTERS[i - 1]}_{k}" for k in range(degree - 1, -1, -1))]


def couplings(n: int) -> list[Equation]:
    """Return equations for the ratios of springs to masses, and for the entry 1/m_1 of B."""
    if n == 1:
        return [Equation("inverse_m", "K*omega_n**2")]
    first = Equation("inverse_m_1", f"K_1*d_0/{_constant(2, n)}")
    lefts = []
    for i in range(n, 1, -1):
        constant = _constant(i, n) if i == n else f"({_constant(i, n)}/{_constant(i + 1, n)})"
        lefts.append(Equation(f"left_{i}", f"K_{i}/K_{i - 1}*{constant}"))
    rights = [Equation(f"right_{i}", f"kappa_{i + 1}/left_{i + 1}") for i in range(n - 1, 0, -1)]
    return [first, *lefts, *rights]


def given(chain: Chain) -> dict[str, float]:
    """Return the values with which the derivation starts, for a chain that is tied to a wall."""
    return chain.parameters() | unnamed(chain)


def unnamed(chain: Chain) -> dict[str, float]:
    """Return the coefficients that four carts need in addition to the named parameters."""
    found = {}
    for i in range(2, chain.n) if chain.n > 3 else ():
        falling = chain.subchain_polynomials()[i - 1]
        degree = falling.size - 1
        found |= {
            f"{_LETTERS[i - 1]}_{degree - j}": float(falling[j]) for j in range(1, degree + 1)
        }
    return found


def work_state_model(chain: Chain) -> dict[str, float]:
    """Return the values of all quantities that lead from the named parameters to A and B."""
    return work_out(state_steps(chain.n), given(chain))


def state_steps(n: int) -> list[Equation]:
    """Return all steps from the named parameters to the entries of A and B."""
    return [*coefficients(n), *(carts_alone(n) if n > 1 else []), *couplings(n)]


def physical(springs: Sequence[bool]) -> list[Equation]:
    """Return masses, dampings and springs from the entries of A and B."""
    n = len(springs) - 1
    if n == 1:
        return [
            Equation("m", "1/inverse_m"),
            Equation("c", "2*zeta*omega_n*m"),
            Equation("k", "omega_n**2*m"),
        ]
    equations = [Equation("m_1", "1/inverse_m_1")]
    for i in range(1, n):
        equations += [
            Equation(f"k_{i + 1}", f"right_{i}*m_{i}"),
            Equation(f"m_{i + 1}", f"k_{i + 1}/left_{i + 1}"),
        ]
    equations += [Equation(f"c_{i}", f"g_{i}*m_{i}") for i in range(1, n + 1)]
    if springs[0]:
        equations.append(Equation("k_1", "w_1*m_1-k_2"))
    if springs[-1]:
        equations.append(Equation(f"k_{n + 1}", f"w_{n}*m_{n}-k_{n}"))
    return equations


def redundancies(n: int) -> list[Equation]:
    """Return the relations that a parameter table must satisfy; the checks call them R1, R2, …

    A table has more parameters than the carts have masses, dampings and springs. Each relation that
    the steps above did not use is a check on the table.
    """
    laws = []
    for i in range(n - 1, 0, -1):
        whole, rest, degree = _named(i, n), _named(i + 1, n), 2 * (n - i + 1)
        beyond = _named(i + 2, n) if i + 2 <= n else ["1"]
        for j in range(3, degree):
            terms = [
                factor if part == "1" else f"{factor}*{part}"
                for factor, part in (
                    (f"w_{i}", rest[j - 2]),
                    (f"g_{i}", rest[j - 1] if j - 1 < len(rest) else ""),
                )
                if part
            ]
            if j < len(rest):
                terms.insert(0, rest[j])
            text = "+".join(terms)
            offset = j - (degree - len(beyond) + 1)
            if offset >= 0:
                part = beyond[offset]
                text += f"-kappa_{i + 1}" + ("" if part == "1" else f"*{part}")
            laws.append(Equation(text, whole[j]))
    laws += [Equation(f"left_{i}+right_{i}", f"w_{i}") for i in range(2, n)]
    return laws


def state_entries(n: int) -> tuple[list[list[str]], list[str]]:
    """Return A (2n rows of 2n) and B (2n) for the state (x1, v1, x2, v2, …), as expressions."""
    A = [["0"] * (2 * n) for _ in range(2 * n)]
    B = ["0"] * (2 * n)
    for i in range(1, n + 1):
        place, speed = 2 * i - 2, 2 * i - 1
        A[place][speed] = "1"
        if n == 1:
            A[speed][:2] = "-omega_n**2", "-2*zeta*omega_n"
            continue
        A[speed][place], A[speed][speed] = f"-w_{i}", f"-g_{i}"
        if i > 1:
            A[speed][place - 2] = f"left_{i}"
        if i < n:
            A[speed][place + 2] = f"right_{i}"
    B[1] = "inverse_m" if n == 1 else "inverse_m_1"
    return A, B
