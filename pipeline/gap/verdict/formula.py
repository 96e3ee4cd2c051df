"""The shortest formula for the unexplained force, by regression in weak form.

The force is known as a mean over windows, and so is each term of a library. Masses, dampings,
springs and encoder zeros were fitted without the missing law, so they are fitted again together
with the terms. The formula is the sum of the few terms with the best criterion, if this is better
than the criterion without a term.

References: S. L. Brunton, J. L. Proctor, J. N. Kutz, PNAS 113 (2016), 3932-3937 (sparse regression
for laws of motion); D. A. Messenger, D. M. Bortz, J. Computational Physics 443 (2021), 110525 (in
weak form).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.limits import BIC_DROP
from pipeline.gap.types import ForceFormula, FormulaTerm, WindowedResidualForce


@dataclass(frozen=True)
class _Term:
    """A candidate term of the formula; the powers of x, v and u give its unit."""

    name: str
    law: Callable[[Array, Array, Array], Array]
    x: float = 0.0
    v: float = 0.0
    u: float = 0.0

    def unit(self, *, position: str, drive: str) -> str:
        """Return the unit of the coefficient."""
        above = [_power(drive, 1.0 - self.u), _power("s", self.v)]
        below = _power(position, self.x + self.v)
        text = " ".join(part for part in above if part) or "1"
        return f"{text}/{below}" if below else text


def _power(unit: str, power: float) -> str:
    if power == 0.0:
        return ""
    return unit if power == 1.0 else f"{unit}^{power:g}"


LIBRARY = (
    _Term("1", lambda x, v, u: np.ones_like(x)),
    _Term("x|x|", lambda x, v, u: x * np.abs(x), x=2),
    _Term("x^3", lambda x, v, u: x**3, x=3),
    _Term("sign v", lambda x, v, u: np.sign(v)),
    _Term("sqrt|v| sign v", lambda x, v, u: np.sqrt(np.abs(v)) * np.sign(v), v=0.5),
    _Term("v|v|", lambda x, v, u: v * np.abs(v), v=2),
    _Term("v^3", lambda x, v, u: v**3, v=3),
    _Term("|v|", lambda x, v, u: np.abs(v), v=1),
    _Term("x^2 v", lambda x, v, u: x**2 * v, x=2, v=1),
    _Term("|x| sign v", lambda x, v, u: np.abs(x) * np.sign(v), x=1),
    _Term("|u| sign v", lambda x, v, u: np.abs(u) * np.sign(v), u=1),
    _Term("u x", lambda x, v, u: u * x, x=1, u=1),
    _Term("u|u|", lambda x, v, u: u * np.abs(u), u=2),
    _Term("u v", lambda x, v, u: u * v, v=1, u=1),
)  # fmt: skip


def find_formula(
    forces: Sequence[WindowedResidualForce], *, on_springs: bool, position: str, drive: str
) -> tuple[ForceFormula | None, Array]:
    """Return the formula for the force on one cart, and its value in every window (n,).

    Without a formula the values are zero. `on_springs` is true if the carts have springs. A wrong
    encoder zero then looks like a constant force in its run, so each run gets a constant.
    """
    force = np.concatenate([one.force for one in forces])
    linear = np.concatenate(
        [np.stack([one.acceleration, one.mean(one.v), one.mean(one.x)], axis=1) for one in forces]
    )
    if on_springs:
        run = np.repeat(np.arange(len(forces)), [one.force.size for one in forces])
        linear = np.hstack([linear, np.eye(len(forces))[run]])
    columns = np.stack(
        [
            np.concatenate([one.mean(term.law(one.x, one.v, one.u)) for one in forces])
            for term in LIBRARY
        ],
        axis=1,
    )
    basis = np.linalg.qr(linear / np.maximum(np.linalg.norm(linear, axis=0), 1e-300))[0]
    left = force - basis @ (basis.T @ force)
    alone = columns - basis @ (basis.T @ columns)
    size = np.linalg.norm(columns, axis=0)
    # A term is usable if the other columns do not explain all of it.
    usable = [j for j in range(len(LIBRARY)) if np.linalg.norm(alone[:, j]) > 1e-8 * size[j] > 0]
    best, lowest = (), _criterion(left, 0)
    free = force.size - linear.shape[1]
    # At least ten windows for each term, and at most three terms.
    for count in range(1, min(3, free // 10) + 1):
        for chosen in combinations(usable, count):
            A = alone[:, chosen]
            rest = left - A @ np.linalg.lstsq(A, left, rcond=None)[0]
            if (criterion := _criterion(rest, count)) < lowest:
                best, lowest = chosen, criterion
    if not best:
        return None, np.zeros(force.size)
    A = alone[:, best]
    coefficients = np.linalg.lstsq(A, left, rcond=None)[0]
    rest = left - A @ coefficients
    variance = float(rest @ rest) / (free - len(best)) * np.diag(np.linalg.inv(A.T @ A))
    formula = ForceFormula(
        terms=tuple(
            FormulaTerm(
                term=LIBRARY[j].name,
                coefficient=float(coefficient),
                std=float(np.sqrt(square)),
                unit=LIBRARY[j].unit(position=position, drive=drive),
            )
            for j, coefficient, square in zip(best, coefficients, variance, strict=True)
        ),
        explains=1.0 - float(rest @ rest) / float(left @ left),
    )
    return formula, np.asarray(force - rest, dtype=np.float64)


def _criterion(rest: Array, terms: int) -> float:
    """Return the Bayesian criterion, with an extra penalty because many terms are tried."""
    count = rest.size
    cost = count * float(np.log(max(float(rest @ rest), 1e-300) / count))
    return cost + terms * (float(np.log(count)) + BIC_DROP)
