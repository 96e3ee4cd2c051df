"""The reported A and B: every entry against the student's own table or the reference."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Literal

import numpy as np

from pipeline.grading.grade import Flag
from pipeline.grading.reference import Reference
from pipeline.grading.tolerance import percent_off
from pipeline.plant.chain import Array, Chain, recover_from_parameters
from pipeline.submission import StateSpace

Kind = Literal["exact", "stiffness", "damping"]

# From here on an entry is wrong rather than imprecise: percent. Couplings are differences of
# large numbers, dampings are what friction adds to.
_WRONG = {"exact": 0.0, "stiffness": 20.0, "damping": 100.0}
# A 0 or 1 of A is met within what a computer adds to it: 1.2e-17 is zero.
_EXACT = 1e-6
_EXPLAINED = {"exact": 0.0, "stiffness": 12.0, "damping": 60.0}  # what a named slip must meet


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One entry of A or B: as typed, what it may be, and how far it is off (percent)."""

    name: str
    kind: Kind
    typed: Decimal
    right: tuple[float, ...]
    error: Fraction

    @property
    def wrong(self) -> bool:
        """Whether it is wrong rather than imprecise."""
        return self.error > _WRONG[self.kind]


def compare_entries(space: StateSpace, *, models: Sequence[Array], n: int) -> list[Entry]:
    """Compare every entry with what the right A and B may be.

    An entry is as good as its best match: an A that follows from a wrong table is right.
    """
    kinds, entries = _kinds(n), []
    for (i, j), number in _matrix(space, n).items():
        right = tuple(float(model[i, j]) for model in models if np.isfinite(model[i, j]))
        if not right:
            continue
        name = f"A({i + 1}, {j + 1})" if j < 2 * n else f"B({i + 1})"
        kind = kinds[i][j]
        error = min(_entry_error(number, value, kind) for value in right)
        entries.append(Entry(name=name, kind=kind, typed=number, right=right, error=error))
    return entries


def state_models(
    tables: Sequence[Mapping[str, float]], *, chain: Chain | None, n: int
) -> list[Array]:
    """Return [A B] (2n, 2n + 1) of the reference and of the student's tables, NaN where unknown.

    A table gives a cart's own terms directly; its couplings only as differences of large numbers.
    """
    chains = [chain, *(own_chain(values, n=n) for values in tables)]
    models = []
    for one in chains:
        if one is not None:
            A, B, _, _ = one.state_space()
            models.append(np.hstack([A, B]))
    for values in tables:
        direct = np.full((2 * n, 2 * n + 1), np.nan)
        for i in range(n):
            omega, zeta = ("omega_n", "zeta") if n == 1 else (f"omega_{i + 1}", f"zeta_{i + 1}")
            if omega in values:
                direct[2 * i + 1, 2 * i] = -(values[omega] ** 2)
                if zeta in values:
                    direct[2 * i + 1, 2 * i + 1] = -2 * values[zeta] * values[omega]
        models.append(direct)
    return models


def own_chain(values: Mapping[str, float], *, n: int) -> Chain | None:
    """Return the chain that a student's final table implies; None where it is no table of one."""
    try:
        with np.errstate(all="ignore"):
            chain = recover_from_parameters(values).chain() if n <= 3 else None
    except (KeyError, ZeroDivisionError, ValueError):
        return None
    if chain is None or not np.all(np.isfinite([*chain.m, *chain.c, *chain.k])):
        return None
    return chain if np.all(chain.m > 0) else None


def _kinds(n: int) -> list[list[Kind]]:
    """Return the kind of every entry of [A B]."""
    kinds: list[list[Kind]] = [["exact"] * (2 * n + 1) for _ in range(2 * n)]
    for i in range(n):
        for j in (i - 1, i, i + 1):
            if 0 <= j < n:
                kinds[2 * i + 1][2 * j] = "stiffness"
        kinds[2 * i + 1][2 * i + 1] = "damping"
    kinds[1][2 * n] = "stiffness"
    return kinds


def _matrix(space: StateSpace, n: int) -> dict[tuple[int, int], Decimal]:
    typed = {(i, j): value for i, row in enumerate(space.A) for j, value in enumerate(row)}
    return typed | {(i, 2 * n): value for i, value in enumerate(space.B)}


def _entry_error(typed: Decimal, right: float, kind: Kind) -> Fraction:
    if kind == "exact":
        return Fraction(0) if abs(float(typed) - right) <= _EXACT else Fraction(10**6)
    if right == 0:
        return Fraction(0) if abs(typed) <= _EXACT else Fraction(10**6)
    size = abs(right)
    reference = Reference(value=size, low=size, high=size, std=0.0, source="")
    return percent_off(typed if right > 0 else -typed, reference, sigmas=0.0)


# ------------------------------------------------------------------------- the flag


def diagnose_state_space(space: StateSpace, *, models: Sequence[Array], n: int) -> list[Flag]:
    """Return a flag where entries are wrong, with the slip that explains them all, if any."""
    wrong = [entry for entry in compare_entries(space, models=models, n=n) if entry.wrong]
    if not wrong:
        return []
    slip = _slip(space, models=models, n=n)
    worst = max(wrong, key=lambda entry: entry.error)
    names = ", ".join(entry.name for entry in wrong[:4]) + (" …" if len(wrong) > 4 else "")
    what = slip or "derive the row again from the equation of motion of its cart"
    return [
        Flag(
            code="wrong_state_space",
            parameters=tuple(entry.name for entry in wrong),
            message=f"{names}: {what}.",
            evidence={
                "parameter": worst.name,
                "reported": float(worst.typed),
                "recomputed": worst.right[0],
                "slip": slip,
            },
        )
    ]


def _slip(space: StateSpace, *, models: Sequence[Array], n: int) -> str:
    """Return the first known slip that turns the right [A B] into the one reported, or ""."""
    typed, kinds = _matrix(space, n), _kinds(n)
    for model in models:
        if not np.all(np.isfinite(model)):
            continue
        for text, slipped, moved in _slips(model, n):
            of_states: list[list[Kind]] = [
                [kinds[i][_column(moved, j)] for j in range(2 * n + 1)] for i in moved
            ]
            # Who orders the states anew in A may have left B as it was.
            if _met(typed, slipped, of_states) or (
                moved != sorted(moved)
                and _met({at: x for at, x in typed.items() if at[1] < 2 * n}, slipped, of_states)
                and _met({at: x for at, x in typed.items() if at[1] == 2 * n}, model, kinds)
            ):
                return text
    return ""


def _met(
    typed: Mapping[tuple[int, int], Decimal], slipped: Array, kinds: Sequence[Sequence[Kind]]
) -> bool:
    """Whether all typed entries are those of a slipped [A B]."""
    return all(
        _entry_error(number, float(slipped[i, j]), kinds[i][j]) <= _EXPLAINED[kinds[i][j]]
        for (i, j), number in typed.items()
    )


def _column(moved: list[int], column: int) -> int:
    return moved[column] if column < len(moved) else column


def _slips(model: Array, n: int) -> Iterator[tuple[str, Array, list[int]]]:
    """Yield (in words, the [A B] it gives, which state stands where)."""
    same = list(range(2 * n))

    def reordered(order: list[int]) -> Array:
        return np.hstack([model[np.ix_(order, order)], model[order, -1:]])

    first = [*range(0, 2 * n, 2), *range(1, 2 * n, 2)]
    yield (
        "the states are in another order than (x1, v1, x2, v2, …): all positions come first",
        reordered(first),
        first,
    )
    back = [2 * i + part for i in reversed(range(n)) for part in (0, 1)]
    yield "the carts are in reverse order: cart 1 is the one at the motor", reordered(back), back
    transposed = model.copy()
    transposed[:, :-1] = model[:, :-1].T
    yield "A looks transposed", transposed, same
    yield from _entry_slips(model, n)


def _entry_slips(model: Array, n: int) -> Iterator[tuple[str, Array, list[int]]]:
    same = list(range(2 * n))
    own = [(2 * i + 1, 2 * i) for i in range(n)]
    dampings = [(2 * i + 1, 2 * i + 1) for i in range(n)]
    couplings = [(2 * i + 1, 2 * j) for i in range(n) for j in (i - 1, i + 1) if 0 <= j < n]

    def changed(where: list[tuple[int, int]], factor: object) -> Array:
        slipped = model.copy()
        for at in where:
            slipped[at] = model[at] * factor if isinstance(factor, float) else slipped[at]
        return slipped

    signs = {
        "the stiffness": own,
        "the damping": dampings,
        "the coupling": couplings,
    }
    for words, where in signs.items():
        if where:
            yield f"the sign of {words} terms is reversed", changed(where, -1.0), same
            for at in where:
                text = f"the sign of A({at[0] + 1}, {at[1] + 1}) is reversed"
                yield text, changed([at], -1.0), same
    yield "the damping terms miss the 2 of 2ζω", changed(dampings, 0.5), same
    root = model.copy()
    for at in own:
        root[at] = -np.sqrt(abs(model[at]))
    yield "the stiffness terms hold ω where ω² belongs", root, same
    hertz = model.copy()
    for at in own:
        hertz[at] = model[at] / (2 * np.pi) ** 2
    yield "the stiffness terms are made of Hz instead of rad/s", hertz, same
    if couplings:
        yield "the couplings between the carts are missing", changed(couplings, 0.0), same
        exchanged = model.copy()
        for i in range(n - 1):
            a, b = (2 * i + 1, 2 * i + 2), (2 * i + 3, 2 * i)
            exchanged[a], exchanged[b] = model[b], model[a]
        text = "the couplings k/m of neighbours are exchanged: divide by the mass of the row's cart"
        yield text, exchanged, same
        for i in range(n - 1):
            a, b = (2 * i + 1, 2 * i + 2), (2 * i + 3, 2 * i)
            one = model.copy()
            one[a], one[b] = model[b], model[a]
            yield f"the couplings of carts {i + 1} and {i + 2} are exchanged", one, same
    for row in range(1, 2 * n, 2):
        if row != 1:
            moved = model.copy()
            moved[row, -1], moved[1, -1] = model[1, -1], 0.0
            yield "the input acts on cart 1, so B belongs in row 2", moved, same
    inverse = model.copy()
    inverse[1, -1] = 1 / model[1, -1]
    yield "B holds the mass where its reciprocal belongs", inverse, same
