"""Find the fewest known mistakes that reproduce the numbers of a table that are off."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

from pipeline.grading.grade import Code
from pipeline.grading.mistakes import Mistake
from pipeline.grading.rubric import is_damping
from pipeline.grading.tolerance import percent_off

SIGMAS = 3.0  # standard errors of the recordings' own number that are no mistake
# Of two explanations the other is out where it is this much further off, as share of what it may;
# or ten times less likely to meet the numbers by chance, as it says less about them.
_MARGIN = 0.35
_NEAR = 0.1  # relative: as far off is an honest first estimate, with a mistake in it or without
# With little damping a step peaks at twice its level, which is also what peak to peak gives: of a
# first estimate it is then true that the step peaks there, whatever was done.
_TRUE_ANYWAY: Code = "peak_for_steady_state"
_DAMPING = 0.2  # relative: nobody reads a damping so well that meeting one closer says more

Table = Mapping[str, Decimal]
Label = Literal["initial", "final"]


@dataclass(frozen=True, kw_only=True)
class Explained:
    """Numbers of one table that a mistake explains."""

    mistake: Mistake
    table: Label
    names: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """The mistakes found, and the numbers that none explains or several do."""

    explained: tuple[Explained, ...]
    left: tuple[str, ...]

    @property
    def codes(self) -> set[Code]:
        """The codes of all mistakes found."""
        return {code for one in self.explained for code in one.mistake.codes}


def explain(
    table: Table,
    *,
    off: Sequence[str],
    mistakes: Sequence[Mistake],
    label: Label,
    believed: frozenset[Code] = frozenset(),
) -> Explanation:
    """Find the fewest mistakes that reproduce the numbers that are off.

    The codes that explain most numbers come first, then one before two at once. Where another
    code explains the same numbers about as well, the `believed` one is taken, or none is named.
    """
    remaining, codes = list(off), frozenset[Code]()
    found: list[Explained] = []
    while remaining:
        covers = [
            _cover(codes | more, table, remaining, mistakes)
            for more in dict.fromkeys(frozenset(m.codes) for m in mistakes)
        ]
        covers = [cover for cover in covers if cover.distances]
        if not covers:
            break
        best = min(covers, key=lambda c: (-len(c.distances), len(c.codes), c.cost(c.distances)))
        rivals = _rivals(best, covers)
        supported = [cover for cover in (best, *rivals) if cover.codes <= believed]
        if rivals and len(supported) != 1 and label == "initial":
            supported = [cover for cover in (best, *rivals) if _TRUE_ANYWAY in cover.codes]
        if rivals and len(supported) == 1:
            best, rivals = supported[0], []
        if not rivals:
            codes = best.codes
            for mistake, names in best.fits:
                own = remaining if mistake.table_wide else names
                found.append(Explained(mistake=mistake, table=label, names=tuple(own)))
        wide = any(m.table_wide for m, _ in best.fits) and not rivals
        remaining = [n for n in remaining if n not in best.distances and not wide]
    explained = {name for one in found for name in one.names}
    return Explanation(
        explained=tuple(found), left=tuple(name for name in off if name not in explained)
    )


def _rivals(best: "_Cover", covers: Sequence["_Cover"]) -> list["_Cover"]:
    """Return what explains the same numbers by other codes about as well."""
    return [
        cover
        for cover in covers
        if not best.codes <= cover.codes
        and len(cover.codes) <= len(best.codes)
        and best.distances.keys() <= cover.distances.keys()
        and cover.cost(best.distances) < best.cost(best.distances) + _MARGIN
    ]


@dataclass(frozen=True, kw_only=True)
class _Cover:
    """What some codes explain: each number by the mistake that comes nearest to it.

    Attributes
    ----------
    distances : how far each number is off what is predicted, as share of what it may be.
    widths : the room that is left for each, relative: how much of all numbers would have been met.
    """

    codes: frozenset[Code]
    fits: tuple[tuple[Mistake, list[str]], ...]
    distances: dict[str, float]
    widths: dict[str, float]

    def cost(self, names: Collection[str]) -> float:
        """Return how badly some of the numbers are explained; tenfold the room is the margin."""
        distance = sum(self.distances[name] for name in names) / len(names)
        return distance + _MARGIN * sum(math.log10(self.widths[name]) for name in names)


def _cover(
    codes: frozenset[Code], table: Table, remaining: Sequence[str], mistakes: Sequence[Mistake]
) -> _Cover:
    """Explain what these codes can, with mistakes that explain more numbers first."""
    fits: list[tuple[Mistake, list[str]]] = []
    distances: dict[str, float] = {}
    widths: dict[str, float] = {}
    usable = [m for m in mistakes if codes.issuperset(m.codes)]
    while True:
        open_ = [name for name in remaining if name not in distances]
        tried = [(m, names) for m in usable if (names := _explains(m, table, open_))]
        if not tried:
            return _Cover(codes=codes, fits=tuple(fits), distances=distances, widths=widths)
        mistake, names = min(
            tried,
            key=lambda fit: (-len(fit[1]), len(fit[0].codes), _distance(fit[0], table, fit[1])),
        )
        fits.append((mistake, names))
        distances |= {name: _off_by(mistake, table, name) for name in names}
        widths |= {name: _width(mistake, name) for name in names}


def _explains(mistake: Mistake, table: Table, remaining: Sequence[str]) -> list[str]:
    """Return which of the remaining numbers a mistake reproduces, if it may be believed.

    Half of them must be met; the others may be as far off as honest numbers are.
    """
    asked = [name for name in mistake.predicted if name in table]
    met = [name for name in asked if _off_by(mistake, table, name) <= 1]
    near = [name for name in asked if name in met or _is_near(mistake, table, name)]
    if len(met) < mistake.least or 2 * len(met) < len(near):
        return []
    if mistake.whole and len(near) < len(asked):
        return []
    wrong = [name for name in remaining if name in near]
    # Of two carts swapped both numbers are wrong, not only near the other's.
    return [] if "carts_swapped" in mistake.codes and len(wrong) < mistake.least else wrong


def _off_by(mistake: Mistake, table: Table, name: str) -> float:
    """Return how far a number is off what a mistake predicts, as share of what it may be."""
    error = percent_off(table[name], mistake.predicted[name], sigmas=SIGMAS)
    return float(error) / (100 * mistake.tolerance)


def _is_near(mistake: Mistake, table: Table, name: str) -> bool:
    """Whether a number beside others that a mistake makes is off it as honest numbers are off."""
    error = percent_off(table[name], mistake.predicted[name], sigmas=SIGMAS)
    return not is_damping(name) and float(error) <= 100 * _NEAR


def _width(mistake: Mistake, name: str) -> float:
    """Return how wide a range of numbers a mistake explains: the logarithm of high over low."""
    predicted, share = mistake.predicted[name], 1 / len(mistake.predicted)
    room = 2 * (max(mistake.tolerance, _DAMPING) if is_damping(name) else mistake.tolerance)
    return (math.log(predicted.high / predicted.low) + room) * mistake.tries**share


def _distance(mistake: Mistake, table: Table, names: Sequence[str]) -> float:
    return sum(_off_by(mistake, table, name) for name in names) / len(names)
