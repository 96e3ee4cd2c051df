"""Judge the reported A and B: each entry against the student's own table or the recordings."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.grading import limits
from pipeline.grading.grade import Flag
from pipeline.grading.mistakes.undo import Number
from pipeline.grading.reference import OWN, Reference
from pipeline.grading.tolerance import percent_off
from pipeline.grading.words import WORDS
from pipeline.names import derived_names, parameter_names, read_name
from pipeline.plant.chain import Chain
from pipeline.plant.identities import recover_from_parameters
from pipeline.submission import ReportedStateSpace

EntryKind = Literal["exact", "stiffness", "damping"]

_NAMED = 3  # largest number of carts whose named parameters determine the chain


@dataclass(frozen=True, kw_only=True, eq=False)
class StateMatrices:
    """One acceptable [A B], shape (2n, 2n + 1).

    Attributes
    ----------
    right : the right entries; NaN if unknown.
    slack : uncertainty of each entry.
    own : whether it follows from the student's own table.
    """

    right: Array
    slack: Array
    own: bool = False


@dataclass(frozen=True, kw_only=True)
class MatrixEntry:
    """One reported entry of A or B.

    Attributes
    ----------
    name : its name, with row and column as typed.
    at : row and column in [A B] with the states in the order x1, v1, x2, v2, …
    right : the acceptable values, one per model.
    error : difference in percent, beyond the uncertainty of the models.
    bare : difference in percent, without allowance for the uncertainty.
    """

    name: str
    at: tuple[int, int]
    kind: EntryKind
    typed: Decimal
    right: tuple[float, ...]
    error: Fraction
    bare: Fraction

    @property
    def wrong(self) -> bool:
        """Whether the entry is wrong, not just imprecise."""
        return self.error > limits.WRONG[self.kind]

    @property
    def suspect(self) -> bool:
        """Whether the entry would be wrong if the models were exact."""
        return self.bare > limits.WRONG[self.kind]


Order = tuple[int, ...]  # for each state as typed, its index in x1, v1, x2, v2, …


def find_order(space: ReportedStateSpace, *, models: Sequence[StateMatrices], n: int) -> Order:
    """Return the order of the states in which A and B are meant.

    A row of A with a single 1 shows which state is the derivative of which, so only the order of
    the carts is tried: the one with the fewest wrong entries is meant.
    """
    usual, velocity = tuple(range(2 * n)), {}
    for i, row in enumerate(space.A):
        ones = [j for j, a in enumerate(row) if abs(float(a) - 1) <= limits.EXACT]
        if len(ones) == 1 and sum(abs(float(a)) > limits.EXACT for a in row) == 1:
            velocity[i] = ones[0]
    if len({*velocity, *velocity.values()}) != 2 * n or len(velocity) != n or not space.B:
        return usual

    def wrong(order: Order) -> int:
        entries = compare_entries(space, models=models, n=n, order=order)
        return sum(entry.wrong for entry in entries)

    if not wrong(usual):
        return usual
    orders = [usual]
    for carts in itertools.permutations(range(n)):
        order = [0] * (2 * n)
        for cart, (x, v) in zip(carts, velocity.items(), strict=True):
            order[x], order[v] = 2 * cart, 2 * cart + 1
        orders.append(tuple(order))
    return min(orders, key=wrong)


def order_names(order: Sequence[int]) -> str:
    """Return the names of the states in an order: "x1, x2, v1, v2"."""
    return ", ".join(f"{'xv'[i % 2]}{i // 2 + 1}" for i in order)


def put_in_order(space: ReportedStateSpace, order: Order) -> ReportedStateSpace:
    """Return A and B with the states in the order x1, v1, x2, v2, …"""
    at = np.argsort(order).tolist()
    return space.model_copy(
        update={
            "A": tuple(tuple(space.A[i][j] for j in at) for i in at) if space.A else (),
            "B": tuple(space.B[i] for i in at) if space.B else (),
        }
    )


def compare_entries(
    space: ReportedStateSpace, *, models: Sequence[StateMatrices], n: int, order: Order
) -> list[MatrixEntry]:
    """Compare every reported entry with the acceptable [A B].

    The nearest acceptable value counts. So an A that follows from the student's own wrong table is
    right.

    Parameters
    ----------
    order : the order of the states, from `find_order`.
    """
    places = (*order, 2 * n)
    kinds, entries = _kinds(n), []
    for (row, column), number in _matrix(space, n).items():
        i, j = places[row], places[column]
        known = [
            (float(model.right[i, j]), float(model.slack[i, j]))
            for model in models
            if np.isfinite(model.right[i, j])
        ]
        if not known:
            continue
        kind = kinds[i][j]
        entries.append(
            MatrixEntry(
                name=f"A({row + 1}, {column + 1})" if column < 2 * n else f"B({row + 1})",
                at=(i, j),
                kind=kind,
                typed=number,
                right=tuple(value for value, _ in known),
                error=min(_entry_error(number, value, kind, slack=s) for value, s in known),
                bare=min(_entry_error(number, value, kind) for value, _ in known),
            )
        )
    return entries


def state_models(
    tables: Sequence[Mapping[str, float]],
    *,
    rounding: Mapping[str, float],
    known: Mapping[str, Reference],
    chain: Chain | None,
    n: int,
) -> list[StateMatrices]:
    """Return the acceptable [A B]: from the recordings and from the student's tables.

    A table gives a cart's own terms directly, but its couplings only as differences of large
    numbers, in which small errors matter. So the uncertainty of [A B] is computed from that of the
    table. The model from the recordings gets the same uncertainty, because students compute their
    entries from a similar table.

    Parameters
    ----------
    tables : the student's final table: as typed, and with known mistakes corrected.
    rounding : for each parameter, the relative error that rounding may have caused.
    known : final parameters from the recordings; their bounds replace the dampings of the chain.
    chain : the chain from the recordings; None if the carts were not identified.
    """
    models = []
    reference = chain.parameters() if chain is not None and chain.is_tied and n <= _NAMED else None
    if chain is not None and reference is None:
        right = _matrices(chain)
        models.append(StateMatrices(right=right, slack=np.zeros_like(right)))
    for values in (*([reference] if reference else []), *tables):
        for make in (_implied, _direct, _by_own_frequencies):
            right = make(values, n)
            if right is None:
                continue
            slack = _spread(make, values, right, rounding=rounding, n=n)
            if values is reference:
                _put_dampings(right, slack, values, known=known)
            own = values is not reference
            models.append(StateMatrices(right=right, slack=slack, own=own))
    return models


def _put_dampings(
    right: Array, slack: Array, values: Mapping[str, float], *, known: Mapping[str, Reference]
) -> None:
    """Set each cart's own damping term to its measured range; NaN without a measurement.

    Parameters
    ----------
    right, slack : changed in place.
    """
    n = right.shape[0] // 2
    for i in range(n):
        omega, zeta = _own_names(i, n)
        at, damping = 2 * i + 1, known.get(zeta)
        if damping is None:
            right[at, at] = np.nan
            continue
        middle, half = (damping.high + damping.low) / 2, (damping.high - damping.low) / 2
        right[at, at] = -2 * middle * values[omega]
        slack[at, at] = (
            2 * (half + limits.HONEST_SIGMAS * limits.HONEST_DAMPING * middle) * values[omega]
        )


def _own_names(i: int, n: int) -> tuple[str, str]:
    return ("omega_n", "zeta") if n == 1 else (f"omega_{i + 1}", f"zeta_{i + 1}")


def _implied(values: Mapping[str, float], n: int) -> Array | None:
    """Return the [A B] of the chain that a table implies; None if there is no such chain."""
    chain = own_chain(values, n=n)
    return None if chain is None else _matrices(chain)


def _matrices(chain: Chain) -> Array:
    A, B, _, _ = chain.state_space()
    return np.hstack([A, B])


def _direct(values: Mapping[str, float], n: int) -> Array:
    """Return the [A B] terms that a single cart's frequency and damping give; NaN elsewhere."""
    direct = np.full((2 * n, 2 * n + 1), np.nan)
    for i in range(n):
        omega, zeta = _own_names(i, n)
        if omega in values:
            direct[2 * i + 1, 2 * i] = -(values[omega] ** 2)
            if zeta in values:
                direct[2 * i + 1, 2 * i + 1] = -2 * values[zeta] * values[omega]
    return direct


def _by_own_frequencies(values: Mapping[str, float], n: int) -> Array | None:
    """Return the [A B] of two or three carts, with each cart's own frequency as reported.

    The transfer functions determine these frequencies too; if they disagree with the reported ones,
    the couplings differ. Let T_i be the product of the squared natural frequencies of carts i to n
    while the carts before them are held. Then T_i = ω_i² T_i+1 − κ_i+1 T_i+2.
    """
    if n not in (2, 3) or not {*parameter_names(n)} <= values.keys():
        return None
    last = [f"omega_{n}"]
    modes = ["omega_a", "omega_b", "omega_c"]
    groups = [modes[:2], last] if n == 2 else [modes, ["omega_x", "omega_y"], last]
    T = [*(np.prod([values[name] ** 2 for name in group]) for group in groups), 1.0]
    model = np.nan_to_num(_direct(values, n))
    model[0::2, 1:-1:2] = np.eye(n)
    model[1, -1] = values["K_1"] * T[0] / T[1]
    for i in range(1, n):
        back = values[f"K_{i + 1}"] / values[f"K_{i}"] * T[i] / T[i + 1]  # k/m of cart i + 1
        kappa = (values[f"omega_{i}"] ** 2 * T[i] - T[i - 1]) / T[i + 1]
        model[2 * i + 1, 2 * i - 2], model[2 * i - 1, 2 * i] = back, kappa / back
    return model


def _spread(
    make: Callable[[Mapping[str, float], int], Array | None],
    values: Mapping[str, float],
    right: Array,
    *,
    rounding: Mapping[str, float],
    n: int,
) -> Array:
    """Return the uncertainty of [A B] that comes from errors in the numbers of a table.

    Parameters
    ----------
    make : function that computes [A B] from a table.
    """
    variance = np.zeros_like(right)
    for name, value in values.items():
        error = np.hypot(
            limits.HONEST_DAMPING if read_name(name).is_damping else limits.HONEST,
            rounding.get(name, 0.0) / np.sqrt(3.0),
        )
        moved = make({**values, name: value * (1 + error)}, n)
        if moved is not None:
            variance += (moved - right) ** 2
    return limits.HONEST_SIGMAS * np.sqrt(variance)


def own_chain(values: Mapping[str, float], *, n: int) -> Chain | None:
    """Return the chain of n carts that a student's final table implies, or None.

    The number of carts is given, because a table of three carts that lacks a gain looks like a
    table of two carts.
    """
    try:
        with np.errstate(all="ignore"):
            chain = recover_from_parameters(values).chain() if n <= _NAMED else None
    except (KeyError, ZeroDivisionError, ValueError):
        return None
    if chain is None or chain.n != n:
        return None
    finite = np.all(np.isfinite([*chain.m, *chain.c, *chain.k]))
    return chain if finite and np.all(chain.m > 0) else None


def derived_numbers(values: Mapping[str, Number], *, n: int) -> dict[str, Reference]:
    """Return the numbers of a table that follow from its others; none if the table is incomplete.

    Their bounds allow for the rounding of the others.
    """
    typed = {name: float(number.value) for name, number in values.items()}
    chain = own_chain(typed, n=n)
    if chain is None:
        return {}
    right = chain.parameters()
    names = derived_names(n)
    slack = dict.fromkeys(names, 0.0)
    for name in right.keys() - set(names):
        shifted = own_chain({**typed, name: typed[name] + float(values[name].rounding)}, n=n)
        moved = shifted.parameters() if shifted else right
        for one in names:
            slack[one] += abs(moved[one] - right[one])
    bounds = {name: (right[name] - slack[name], right[name] + slack[name]) for name in names}
    return {
        name: Reference(value=right[name], low=low, high=high, source=OWN)
        for name, (low, high) in bounds.items()
    }


def _kinds(n: int) -> list[list[EntryKind]]:
    kinds: list[list[EntryKind]] = [["exact"] * (2 * n + 1) for _ in range(2 * n)]
    for i in range(n):
        for j in (i - 1, i, i + 1):
            if 0 <= j < n:
                kinds[2 * i + 1][2 * j] = "stiffness"
        kinds[2 * i + 1][2 * i + 1] = "damping"
    kinds[1][2 * n] = "stiffness"
    return kinds


def _matrix(space: ReportedStateSpace, n: int) -> dict[tuple[int, int], Decimal]:
    typed = {(i, j): value for i, row in enumerate(space.A) for j, value in enumerate(row)}
    return typed | {(i, 2 * n): value for i, value in enumerate(space.B)}


def _entry_error(typed: Decimal, right: float, kind: EntryKind, *, slack: float = 0.0) -> Fraction:
    if kind == "exact":
        return Fraction(0) if abs(float(typed) - right) <= limits.EXACT else Fraction(10**6)
    if right == 0:
        return Fraction(0) if abs(typed) <= limits.EXACT else Fraction(10**6)
    size = abs(right)
    reference = Reference(value=size, low=max(size - slack, 0.0), high=size + slack)
    return percent_off(typed if right > 0 else -typed, reference, sigmas=0.0)


# ------------------------------------------------------------------ harmful models

Harm = Literal["unstable", "wrong_way"]


def model_harm(
    space: ReportedStateSpace,
    entries: Sequence[MatrixEntry],
    *,
    models: Sequence[StateMatrices],
    n: int,
    tied: bool,
    order: Order,
) -> Harm | None:
    """Return how wrong entries make the model behave as no real bench can; None if they do not.

    `unstable`: the motion grows without limit. `wrong_way`: a positive input drives a cart to the
    negative side. Imprecise entries are replaced by right ones first, because honest errors in a
    stiff chain could have the same effect. A different order of the states is harmless.

    Parameters
    ----------
    tied : whether a spring ties the carts to a wall, so that they settle under a constant input.
    """
    wrong = {entry.at: entry.typed for entry in entries if entry.wrong}
    whole = [one.right for one in models if np.all(np.isfinite(one.right))]
    if not wrong or not whole or not (space.A and space.B):
        return None
    found = []
    for right in whole:
        reported = right.copy()
        for at, number in wrong.items():
            reported[at] = float(number)
        A, B = reported[:, :-1], reported[:, -1]
        found.append("unstable" if _grows(A) else _backwards(A, B, order=order, tied=tied))
    return found[0] if all(found) else None


def _grows(A: Array) -> bool:
    found = np.linalg.eigvals(A)
    # Smaller values are rounding errors, because the eigenvalues of a free body are zero.
    return bool(found.real.max() > 1e-6 * float(np.abs(found).max()))


def _backwards(A: Array, B: Array, *, order: Order, tied: bool) -> Harm | None:
    """Return `wrong_way` if a positive input drives or holds a cart on the negative side.

    A student may have changed the order of the states in A but not in B.
    """
    ways = [_drives_back(A, b, tied=tied) for b in (B, B[list(order)])]
    return "wrong_way" if all(ways) else None


def _drives_back(A: Array, B: Array, *, tied: bool) -> bool:
    if B[1] < 0:
        return True
    if tied:
        with suppress(np.linalg.LinAlgError):
            return bool(np.any(np.linalg.solve(A, -B)[0::2] < 0))
    return False


# ------------------------------------------------------------------------- the flag


def diagnose_state_space(
    space: ReportedStateSpace,
    entries: Sequence[MatrixEntry],
    *,
    models: Sequence[StateMatrices],
    n: int,
    order: Order,
) -> list[Flag]:
    """Return a flag if entries are wrong, with the known mistake that explains all of them, if any.

    A known mistake that gives all of A and B is evidence even if the table is too uncertain to
    judge single entries.
    """
    suspects = [entry for entry in entries if entry.suspect]
    slip = _slip(space, models=models, n=n, order=order) if suspects else ""
    wrong = suspects if slip else [entry for entry in entries if entry.wrong]
    if not wrong:
        return []
    worst = max(wrong, key=lambda entry: entry.error)
    names = ", ".join(entry.name for entry in wrong[:4]) + (" …" if len(wrong) > 4 else "")
    return [
        Flag(
            code="wrong_state_space",
            parameters=tuple(entry.name for entry in wrong),
            message=WORDS.text(
                "state_space", entries=names, what=slip or WORDS.text("derive_again")
            ),
            evidence={
                "parameter": worst.name,
                "reported": float(worst.typed),
                "recomputed": worst.right[0],
                "slip": slip,
            },
        )
    ]


def _slip(
    space: ReportedStateSpace, *, models: Sequence[StateMatrices], n: int, order: Order
) -> str:
    """Return, in words, the first mistake that leads to the reported [A B]; "" if none does."""
    as_typed, kinds = _matrix(space, n), _kinds(n)
    typed = _matrix(put_in_order(space, order), n)
    # A student may have changed the order of the states in A but not in B.
    mixed = {at: (typed if at[1] < 2 * n else as_typed)[at] for at in typed}
    for model in (one.right for one in models if np.all(np.isfinite(one.right))):
        if mixed != typed and _met(mixed, model, kinds):
            return WORDS.text("order_of_A_only", order=order_names(order))
        for text, slipped in _changed(model, n):
            if _met(typed, slipped, kinds):
                return text
    return ""


def _met(
    typed: Mapping[tuple[int, int], Decimal], slipped: Array, kinds: Sequence[Sequence[EntryKind]]
) -> bool:
    """Return whether all typed entries match the [A B] that a mistake gives."""
    return all(
        _entry_error(number, float(slipped[i, j]), kinds[i][j]) <= limits.EXPLAINED[kinds[i][j]]
        for (i, j), number in typed.items()
    )


def _changed(model: Array, n: int) -> Iterator[tuple[str, Array]]:
    """Yield each known mistake in the entries, in words and as the [A B] that it gives."""
    own = [(2 * i + 1, 2 * i) for i in range(n)]
    dampings = [(2 * i + 1, 2 * i + 1) for i in range(n)]
    pairs = [((2 * i + 1, 2 * i + 2), (2 * i + 3, 2 * i)) for i in range(n - 1)]
    couplings = sorted(at for pair in pairs for at in pair)

    def put(values: Mapping[tuple[int, int], float]) -> Array:
        slipped = model.copy()
        for at, value in values.items():
            slipped[at] = value
        return slipped

    def times(factor: float, places: Sequence[tuple[int, int]]) -> Array:
        return put({at: factor * model[at] for at in places})

    def exchanged(of: Sequence[tuple[tuple[int, int], tuple[int, int]]]) -> Array:
        return put({a: model[b] for one, other in of for a, b in ((one, other), (other, one))})

    transposed = model.copy()
    transposed[:, :-1] = model[:, :-1].T
    yield WORDS.text("transposed"), transposed
    for terms, places in (("stiffness", own), ("damping", dampings), ("coupling", couplings)):
        if places:
            yield WORDS.text("sign_of_terms", terms=terms), times(-1.0, places)
        for at in places:
            entry = f"A({at[0] + 1}, {at[1] + 1})"
            yield WORDS.text("sign_of_entry", entry=entry), times(-1.0, [at])
    yield WORDS.text("half_damping"), times(0.5, dampings)
    yield WORDS.text("root_stiffness"), put({at: -np.sqrt(abs(model[at])) for at in own})
    yield WORDS.text("hertz_stiffness"), times((2 * np.pi) ** -2, own)
    if pairs:
        yield WORDS.text("no_couplings"), times(0.0, couplings)
        yield WORDS.text("couplings_exchanged"), exchanged(pairs)
    for cart, pair in enumerate(pairs, start=1):
        yield WORDS.text("pair_exchanged", cart=cart, next=cart + 1), exchanged([pair])
    for row in range(3, 2 * n, 2):
        yield WORDS.text("input_row"), put({(row, -1): model[1, -1], (1, -1): 0.0})
    yield WORDS.text("input_mass"), put({(1, -1): 1 / model[1, -1]})
