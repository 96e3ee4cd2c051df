"""Name the mistake behind a wrong number, where one reproduces it and the others do not."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from typing import Literal

from pipeline.grading.grade import CODES, Code, Flag
from pipeline.grading.impossible import broken_orders, not_positive
from pipeline.grading.mistakes import Mistake, known_mistakes
from pipeline.grading.no_fit import copied_final
from pipeline.grading.reference import Reference, References
from pipeline.grading.rubric import is_damping
from pipeline.grading.tolerance import percent_off
from pipeline.grading.transient import transient_fits
from pipeline.results import Analysis
from pipeline.submission import Reported

# From here on a number is worth a remark. Two careful teams on one bench differ by some percent in
# gains and frequencies, the paper's own tables by up to 14 % (29 % at a null read off by eye);
# dampings differ by half and more.
_OFF_FINAL = 7.0
_OFF_INITIAL = 10.0
_OFF_BY_EYE = 30.0  # resonances and nulls before any fit
_OFF_DAMPING = 80.0
_SUSPECT_DAMPING = 40.0  # enough to look for a known mistake, not for a remark of its own
_OFF_EACH_OTHER = 25.0
_SIGMAS = 3.0
# Of two explanations the other is out where it is this much further off, as share of what it may;
# or ten times less likely to meet the numbers by chance, as it says less about them.
_MARGIN = 0.35

# What comes of reading a decay or a step; in a final table only where it was taken over.
_FROM_TIME_RECORDS = {"peak_count", "log10_for_ln", "peak_for_steady_state"}
_TAKEN_OVER = Decimal("0.05")

Table = Mapping[str, Decimal]
Label = Literal["initial", "final"]


@dataclass(frozen=True, kw_only=True)
class Explained:
    """Numbers of one table that a mistake explains."""

    mistake: Mistake
    table: Label
    names: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """The flags of the tables, and the final table with what is off in it put right."""

    flags: tuple[Flag, ...]
    corrected: dict[str, float]


def diagnose_tables(reported: Reported, *, references: References, analysis: Analysis) -> Diagnosis:
    """Return the flags of the two tables of parameters."""
    tables: dict[Label, Table] = {"initial": reported.initial, "final": reported.final}
    copied = copied_final(reported, references=references)
    flags: list[Flag] = []
    explained: list[Explained] = []
    left: dict[Label, list[str]] = {}
    for label, table in tables.items():
        known: dict[str, Reference] = getattr(references, label)
        impossible = not_positive(table)
        if impossible:
            flags.append(_impossible_flag(table, impossible, known, label))
        taken = {*impossible, *(copied if label == "final" else ())}
        errors = {
            name: float(percent_off(typed, known[name], sigmas=_SIGMAS))
            for name, typed in table.items()
            if name in known and name not in taken
        }
        suspect = [n for n, e in errors.items() if e > min(limit(n, label), _SUSPECT_DAMPING)]
        laws = broken_orders(table, initial=label == "initial")
        # Friction may leave room for either of two gains, and not for their order.
        unordered = {
            name
            for law in laws
            if law.is_of_gains and not set(law.names).isdisjoint(suspect)
            for name in law.names
            if name in errors
        }
        mistakes = known_mistakes(known, analysis)
        if label == "final":
            mistakes = [m for m in mistakes if _may_be_final(m, reported)]
            if len(suspect) >= min(2, analysis.carts):
                mistakes += transient_fits(analysis, table, known)
        off = [name for name in errors if name in suspect or name in unordered]
        found, rest = explain(table, off=off, mistakes=mistakes, label=label)
        explained += [one for one in found if not set(one.names).isdisjoint(suspect)]
        rest = [name for name in rest if errors[name] > limit(name, label)]
        broken = [
            law
            for law in laws
            if not known
            or (set(law.names) & set(rest) and (law.is_plain or set(law.names) <= set(rest)))
        ]
        for law in broken:
            flags.append(law.flag(table, label))
            rest = [name for name in rest if name not in law.names]
        left[label] = rest
    if copied:
        flags.append(_copied_flag(reported, copied, references))
    flags += _specific_flags(explained, tables, references)
    flags += [
        _off_flag(tables[label], names, getattr(references, label), label)
        for label, names in left.items()
        if names
    ]
    named = {name for flag in flags for name in flag.parameters}
    flags += _disagreements(reported, references, named=named)
    corrected = _corrected(reported.final, explained, references.final)
    corrected |= {name: references.final[name].value for name in left["final"]}
    return Diagnosis(flags=tuple(flags), corrected=corrected)


def _may_be_final(mistake: Mistake, reported: Reported) -> bool:
    """Whether a mistake can be in a final table: one of a decay or a step only if taken over."""
    if not _FROM_TIME_RECORDS & set(mistake.codes):
        return True
    both = [n for n in mistake.predicted if n in reported.final and n in reported.initial]
    return all(
        abs(reported.final[n] - reported.initial[n]) <= _TAKEN_OVER * abs(reported.initial[n])
        for n in both
    )


def _corrected(
    final: Table, explained: Sequence[Explained], known: Mapping[str, Reference]
) -> dict[str, float]:
    """Return the final table as it would be without the mistakes found in it."""
    corrected = {name: float(typed) for name, typed in final.items()}
    for one in explained:
        inside = [n for n in one.names if n in one.mistake.predicted]
        for name in inside if one.table == "final" else ():
            corrected[name] *= known[name].value / one.mistake.predicted[name].value
    return corrected


def limit(name: str, table: str) -> float:
    """Return from how many percent on a reported number is worth a remark."""
    if is_damping(name):
        return _OFF_DAMPING
    if table == "final":
        return _OFF_FINAL
    by_eye = name.startswith("omega") and name[-1] in "abcdefghxy"
    return _OFF_BY_EYE if by_eye else _OFF_INITIAL


# ------------------------------------------------------------------- explaining


def explain(
    table: Table, *, off: Sequence[str], mistakes: Sequence[Mistake], label: Label
) -> tuple[list[Explained], list[str]]:
    """Find the fewest mistakes that reproduce the numbers that are off; return also the rest.

    The codes that explain most numbers come first, then one before two at once. Where another
    code explains the same numbers about as well, none is named.
    """
    remaining, left, codes = list(off), [], frozenset[Code]()
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
        rivals = [
            cover
            for cover in covers
            if not best.codes <= cover.codes
            and len(cover.codes) <= len(best.codes)
            and best.distances.keys() <= cover.distances.keys()
            and cover.cost(best.distances) < best.cost(best.distances) + _MARGIN
        ]
        if rivals:
            left += best.distances
        else:
            codes = best.codes
            for mistake, names in best.fits:
                own = remaining if mistake.table_wide else names
                found.append(Explained(mistake=mistake, table=label, names=tuple(own)))
        wide = any(m.table_wide for m, _ in best.fits) and not rivals
        remaining = [n for n in remaining if n not in best.distances and not wide]
    explained = {name for one in found for name in one.names}
    return found, [name for name in off if name not in explained]


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
    """Return which of the remaining numbers a mistake reproduces, if it may be believed."""
    asked = [name for name in mistake.predicted if name in table]
    met = [name for name in asked if _off_by(mistake, table, name) <= 1]
    if len(met) < mistake.least or (mistake.whole and len(met) < len(asked)):
        return []
    wrong = [name for name in remaining if name in met]
    # Of two carts swapped both numbers are wrong, not only near the other's.
    return [] if "carts_swapped" in mistake.codes and len(wrong) < mistake.least else wrong


def _off_by(mistake: Mistake, table: Table, name: str) -> float:
    """Return how far a number is off what a mistake predicts, as share of what it may be."""
    error = percent_off(table[name], mistake.predicted[name], sigmas=_SIGMAS)
    return float(error) / (100 * mistake.tolerance)


def _width(mistake: Mistake, name: str) -> float:
    """Return how wide a range of numbers a mistake explains: the logarithm of high over low."""
    predicted, share = mistake.predicted[name], 1 / len(mistake.predicted)
    return (math.log(predicted.high / predicted.low) + 2 * mistake.tolerance) * mistake.tries**share


def _distance(mistake: Mistake, table: Table, names: Sequence[str]) -> float:
    return sum(_off_by(mistake, table, name) for name in names) / len(names)


# ------------------------------------------------------------------------ flags


def _evidence(name: str, typed: Decimal, reference: Reference | None, table: str) -> dict:
    evidence: dict = {"parameter": name, "table": table, "reported": float(typed)}
    if reference is not None:
        evidence["recomputed"] = reference.value
        if reference.value:
            evidence["ratio"] = float(typed) / reference.value
    return evidence


def _specific_flags(
    explained: Sequence[Explained], tables: Mapping[Label, Table], references: References
) -> list[Flag]:
    """Return one flag a code, over both tables; the first number stands for all in the text."""
    flags = []
    for code in CODES:
        mine = [one for one in explained if code in one.mistake.codes]
        if not mine:
            continue
        names = list(dict.fromkeys(name for one in mine for name in one.names))
        first = min(mine, key=lambda one: len(one.mistake.codes))
        name = next(name for name in first.names if name in first.mistake.predicted)
        typed = tables[first.table][name]
        reference: Reference = getattr(references, first.table)[name]
        predicted = first.mistake.predicted[name]
        evidence = _evidence(name, typed, reference, first.table)
        evidence |= {"mistake_gives": predicted.value}
        if len(first.mistake.codes) > 1:
            evidence["together_with"] = [c for c in first.mistake.codes if c != code]
        flags.append(
            Flag(
                code=code,
                parameters=tuple(names),
                message=f"{name}: "
                + first.mistake.help.format(
                    reported=typed, recomputed=f"{reference.value:.4g}", name=name
                )
                + ".",
                evidence=evidence,
            )
        )
    return flags


def _off_flag(
    table: Table, names: Sequence[str], known: Mapping[str, Reference], label: str
) -> Flag:
    def error(name: str) -> float:
        return float(percent_off(table[name], known[name], sigmas=_SIGMAS)) / limit(name, label)

    worst = max(names, key=error)
    reference, typed = known[worst], table[worst]
    ratio = float(typed) / reference.value if reference.value else 0.0
    look = {
        "K": "look at the levels before and after the step, and at the lowest frequencies",
        "o": "look again at the peaks of the decay, or of the Bode plot",
        "z": "look again at how fast the peaks fall, or how high the resonance is",
    }.get(worst[0], "look again at how it was read")
    if any(abs(ratio / 10.0**power - 1) < 0.05 for power in (-3, -2, -1, 1, 2, 3)):
        look = "it is off by a power of ten, so check the units and the decimal point"
    code: Code = "initial_off" if label == "initial" else "final_off"
    return Flag(
        code=code,
        parameters=tuple(names),
        message=f"{worst}: your recordings give {reference.value:.4g}, you report {typed}: {look}.",
        evidence=_evidence(worst, typed, reference, label),
    )


def _impossible_flag(
    table: Table, names: Sequence[str], known: Mapping[str, Reference], label: str
) -> Flag:
    name = names[0]
    return Flag(
        code="physically_impossible",
        parameters=tuple(names),
        message=f"{name} = {table[name]}: gains, frequencies and dampings of carts on springs are "
        "positive; is a sign wrong?",
        evidence=_evidence(name, table[name], known.get(name), label),
    )


def _copied_flag(reported: Reported, copied: Sequence[str], references: References) -> Flag:
    def error(name: str) -> float:
        known = references.final.get(name)
        return float(percent_off(reported.final[name], known, sigmas=0.0)) if known else 0.0

    worst = max(copied, key=error)
    return Flag(
        code="no_fit_done",
        parameters=tuple(copied),
        message="the final estimates are the initial ones, digit for digit: fit the transfer "
        f"functions to the measured Bode points; {worst} for one then changes.",
        evidence=_evidence(worst, reported.final[worst], references.final.get(worst), "final"),
    )


def _disagreements(reported: Reported, references: References, *, named: set[str]) -> list[Flag]:
    """Return a flag where the tables contradict each other and the data do not say which errs."""
    apart: list[tuple[float, str]] = []
    for name, final in reported.final.items():
        initial = reported.initial.get(name)
        guess = is_damping(name) and name not in references.initial
        if initial is None or name in named or guess or final <= 0 or initial <= 0:
            continue
        bounds = [float(final)]
        if name in references.initial and name in references.final:
            if references.final[name].low <= 0:
                continue
            # The data's own two estimates may differ as much.
            ratio = references.initial[name].value / references.final[name].value
            bounds.append(float(final) * ratio)
        allowed = Reference(
            value=float(final), low=min(bounds), high=max(bounds), std=0.0, source="final"
        )
        error = float(percent_off(initial, allowed, sigmas=0.0))
        worth = 2 * _OFF_DAMPING if is_damping(name) else _OFF_EACH_OTHER
        by_eye = limit(name, "initial") == _OFF_BY_EYE
        if error > (worth + _OFF_BY_EYE if by_eye else worth):
            apart.append((error / worth, name))
    if not apart:
        return []
    _, worst = max(apart)
    return [
        Flag(
            code="initial_final_disagree",
            parameters=tuple(name for _, name in apart),
            message=f"{worst}: your first estimate is {reported.initial[worst]}, the final one "
            f"{reported.final[worst]}: one of the two is worth another look.",
            evidence={
                "parameter": worst,
                "initial": float(reported.initial[worst]),
                "final": float(reported.final[worst]),
                "ratio": float(reported.final[worst] / reported.initial[worst]),
            },
        )
    ]
