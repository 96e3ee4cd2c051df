"""Find the mistakes that most likely explain the numbers of a table, if they are likely enough."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

from pipeline.grading import limits
from pipeline.grading.grade import Code
from pipeline.grading.mistakes.catalogue import ExplanationKey, Mistake
from pipeline.grading.reference import Reference
from pipeline.grading.tolerance import Typed
from pipeline.names import read_name

_SLIP, _KNOWN_SLIP = math.log(limits.ONE_IN_OFF), math.log(limits.ONE_IN_KNOWN)
# With little damping, the response to a step peaks at twice its settled level. So reading the peak
# and reading peak to peak give the same number. In a first estimate, the advice about the peak is
# true in both cases.
_TRUE_ANYWAY: Code = "peak_for_steady_state"

Table = Mapping[str, Decimal]
Label = Literal["initial", "final"]


@dataclass(frozen=True, kw_only=True)
class ExplainedNumbers:
    """Numbers of one table that a mistake explains.

    Attributes
    ----------
    rival : another mistake that explains them equally well, or None.
    """

    mistake: Mistake
    table: Label
    names: tuple[str, ...]
    rival: Mistake | None = None


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """The mistakes found in a table.

    Attributes
    ----------
    left : wrong numbers that no mistake explains.
    """

    explained: tuple[ExplainedNumbers, ...]
    left: tuple[str, ...]

    @property
    def codes(self) -> frozenset[Code]:
        """The codes of all mistakes found."""
        return frozenset(code for one in self.explained for code in one.mistake.codes)


def explain(
    table: Table,
    *,
    known: Mapping[str, Reference],
    off: Sequence[str],
    mistakes: Sequence[Mistake],
    label: Label,
    believed: frozenset[Code] = frozenset(),
) -> Explanation:
    """Find the mistakes that make the whole table most likely.

    If other mistakes make it about as likely, no mistake is named.

    Parameters
    ----------
    known : for each parameter, the number from the recordings.
    off : parameters whose numbers are wrong.
    believed : codes of mistakes found in the other table; here they cost no likelihood.
    """
    typed = {name: Typed.of(number) for name, number in table.items()}
    tried = [m for m in mistakes if not m.beside.intersection(off)]
    ways = _by_way([_Tried.on(m, typed, label, believed=believed) for m in tried])
    remaining, codes = list(off), frozenset[Code]()
    found: list[ExplainedNumbers] = []
    while remaining:
        nothing = _Cover(codes=frozenset(), fits=())
        covers = [_cover(way, remaining) for way in ways]
        covers = [nothing, *(cover for cover in covers if cover.explained)]
        scores = [_score(c, typed, known, off=remaining, free=codes | believed) for c in covers]
        score = {id(c): one for c, one in zip(covers, scores, strict=True)}
        best = max(covers, key=lambda c: (score[id(c)], -len(c.codes)))
        if best is nothing:
            break
        rivals = [
            c
            for c in covers
            if not best.codes <= c.codes
            and best.explained & c.explained
            # A mistake whose likelihood is lower by two e-folds is no rival.
            and score[id(c)] > score[id(best)] - 2
        ]
        rival = None
        shared = frozenset.intersection(best.codes, *(c.codes for c in rivals))
        supported = [c for c in (best, *rivals) if c.codes - shared <= believed]
        less = [c for c in rivals if c.codes <= shared]
        if rivals and len(supported) == 1:
            best, rivals = supported[0], []
        elif less:  # one of two combined mistakes is certain, the other is not
            best, rivals = less[0], []
        if rivals and label == "initial":
            true = [c for c in (best, *rivals) if _TRUE_ANYWAY in c.codes]
            others = [c for c in (best, *rivals) if _TRUE_ANYWAY not in c.codes]
            if len(true) == 1 and others:
                best, rivals, rival = true[0], [], others[0].fits[0][0]
        if not rivals:
            codes |= best.codes
            for mistake, names in best.fits:
                own = remaining if mistake.table_wide else names
                found.append(
                    ExplainedNumbers(mistake=mistake, table=label, names=tuple(own), rival=rival)
                )
        wide = any(m.table_wide for m, _ in best.fits) and not rivals
        remaining = [n for n in remaining if n not in best.explained and not wide]
    explained = {name for one in found for name in one.names}
    return Explanation(
        explained=tuple(found), left=tuple(name for name in off if name not in explained)
    )


@dataclass(frozen=True, kw_only=True)
class _Cover:
    """The numbers that one mistake or combination of mistakes explains.

    Attributes
    ----------
    fits : variants of the mistake, each with the numbers that it explains.
    """

    codes: frozenset[Code]
    fits: tuple[tuple[Mistake, list[str]], ...]

    @property
    def explained(self) -> frozenset[str]:
        """The wrong numbers that the mistake explains."""
        return frozenset(name for _, names in self.fits for name in names)


@dataclass(frozen=True, kw_only=True)
class _Tried:
    """A mistake compared with a table.

    Attributes
    ----------
    errors : for each parameter, the difference between table and prediction, in percent.
    is_believed : whether the other table has the same mistake. Its numbers may then differ from the
        predictions as much as honest numbers do.
    """

    mistake: Mistake
    label: Label
    errors: Mapping[str, float]
    is_believed: bool

    @classmethod
    def on(
        cls,
        mistake: Mistake,
        table: Mapping[str, Typed],
        label: Label,
        *,
        believed: frozenset[Code],
    ) -> "_Tried":
        errors = {
            name: table[name].percent_off(predicted, sigmas=limits.SIGMAS)
            for name, predicted in mistake.predicted.items()
            if name in table
        }
        is_believed = believed.issuperset(mistake.codes)
        return cls(mistake=mistake, label=label, errors=errors, is_believed=is_believed)

    def explains(self, remaining: Sequence[str]) -> list[str]:
        """Return the remaining wrong numbers that the mistake explains; none if it is not credible.

        Of the numbers near its predictions, at least half must match. The others may differ as much
        as honest numbers do.
        """
        mistake = self.mistake
        met = [name for name in self.errors if self.off_by(name) <= 1]
        near = [name for name in self.errors if name in met or self._is_near(name)]
        met = near if self.is_believed else met
        if len(met) < mistake.least or 2 * len(met) < len(near):
            return []
        if mistake.whole and len(near) < len(self.errors):
            return []
        wrong = [name for name in remaining if name in near]
        # If carts are swapped, at least two numbers are wrong. A single number that is near that of
        # another cart shows no swap.
        return [] if "carts_swapped" in mistake.codes and len(wrong) < mistake.least else wrong

    def off_by(self, name: str) -> float:
        """Return the error of a number divided by the mistake's tolerance."""
        return self.errors[name] / (100 * self.mistake.tolerance)

    def _is_near(self, name: str) -> bool:
        """Return whether a number differs from its prediction no more than honest numbers do."""
        by_eye = self.label == "initial" and read_name(name).is_by_eye
        limit = limits.NEAR_BY_EYE if by_eye else limits.NEAR
        return not read_name(name).is_damping and self.errors[name] <= 100 * limit


def _by_way(tried: Sequence[_Tried]) -> list[list[_Tried]]:
    """Group the variants of each mistake; they concern different numbers."""
    ways: dict[ExplanationKey, list[_Tried]] = {}
    for one in tried:
        ways.setdefault(one.mistake.kind, []).append(one)
    return [*ways.values()]


def _cover(way: Sequence[_Tried], remaining: Sequence[str]) -> _Cover:
    """Explain as many numbers as possible by one mistake.

    Variants are added one by one; each time, the one that explains the most numbers.
    """
    fits: list[tuple[Mistake, list[str]]] = []
    open_ = list(remaining)
    while tried := [(one, names) for one in way if (names := one.explains(open_))]:
        best, names = min(
            tried,
            key=lambda fit: (-len(fit[1]), sum(map(fit[0].off_by, fit[1])) / len(fit[1])),
        )
        fits.append((best.mistake, names))
        open_ = [name for name in open_ if name not in names]
    used = frozenset(way[0].mistake.codes) if fits else frozenset[Code]()
    return _Cover(codes=used, fits=tuple(fits))


def _score(
    cover: _Cover,
    table: Mapping[str, Typed],
    known: Mapping[str, Reference],
    *,
    off: Collection[str],
    free: Collection[Code],
) -> float:
    """Return the log likelihood of the table and of the mistakes that explain it.

    Parameters
    ----------
    free : codes of mistakes that cost no likelihood.
    """
    predicted: dict[str, Reference] = dict(known)
    for mistake, names in reversed(cover.fits):
        touched = [n for n in mistake.predicted if n in table] if mistake.whole else names
        predicted |= {n: mistake.predicted[n] for n in touched}
    # A wrong number that no mistake explains is unlikely, except beside a mistake of the whole
    # table.
    wide = any(m.table_wide for m, _ in cover.fits)
    unexplained = -math.log(limits.ANYWHERE) - (0.0 if wide else _SLIP)
    log_likelihood = sum(
        unexplained
        if name in off and name not in cover.explained
        else _log_density(table[name], predicted[name], name)
        for name in known
        if table[name].value > 0
    )
    tries = max((mistake.tries for mistake, _ in cover.fits), default=1)
    return log_likelihood - math.log(tries) - _KNOWN_SLIP * len(cover.codes - set(free))


def _log_density(typed: Typed, reference: Reference, name: str) -> float:
    """Return the log density of the logarithm of a number, given what is known about it.

    The density is uniform between the bounds, widened by rounding. Outside it has Cauchy tails,
    because some numbers are read far worse than most. It is never lower than for an unexplained
    wrong number.
    """
    half, value = typed.hidden, typed.value
    low, high = reference.low, reference.high
    anywhere = -math.log(limits.ANYWHERE) - _SLIP
    if low <= 0:
        return anywhere
    read, usual = read_name(name), limits.USUAL_FREQUENCY
    if read.is_gain:
        usual = limits.USUAL_GAIN
    elif read.is_damping:
        usual = limits.USUAL_DAMPING
    elif read.is_by_eye:
        usual = limits.USUAL_BY_EYE
    # The student's intermediate result probably had as many digits as the typed number.
    digits = 10.0 ** (1 - typed.digits) / 4
    usual = math.hypot(usual, digits, reference.std / reference.value)
    outside = max(math.log(low / value), math.log(value / high)) - half
    room = math.log(high / low) + 2 * half + math.pi * usual
    return max(-math.log(room) - math.log1p((max(outside, 0.0) / usual) ** 2), anywhere)
