"""Name the mistake that gives a wrong number, if only one mistake does."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal

from pipeline.grading import limits
from pipeline.grading.grade import Code, Flag
from pipeline.grading.mistakes.catalogue import (
    ExplanationKey,
    Mistake,
    known_mistakes,
    transient_fits,
)
from pipeline.grading.mistakes.explain import ExplainedNumbers, Explanation, Label, Table, explain
from pipeline.grading.mistakes.table_flags import (
    OTHER,
    BrokenOrder,
    broken_orders,
    copied_flag,
    disagreement_flag,
    impossible_flag,
    limit,
    not_positive,
    off_flag,
    specific_flags,
)
from pipeline.grading.mistakes.undo import Slip, Slipped, undo
from pipeline.grading.reference import Reference, References, is_linear
from pipeline.grading.tolerance import percent_off
from pipeline.names import read_name
from pipeline.results import Analysis
from pipeline.submission import Reported


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """The flags of the two tables, and the final table with known mistakes corrected.

    Attributes
    ----------
    named : for each table, the parameters whose errors a known mistake explains.
    slipped : for each table, what mistakes did to its numbers.
    possible : whether the corrected final table can belong to real carts.
    """

    flags: tuple[Flag, ...]
    corrected: dict[str, float]
    named: dict[Label, frozenset[str]]
    slipped: dict[Label, tuple[Slipped, ...]]
    possible: bool


def diagnose_tables(
    reported: Reported, *, references: References, analysis: Analysis, copied: Sequence[str]
) -> Diagnosis:
    """Return the flags of the two tables, and the corrected final table.

    Parameters
    ----------
    copied : final estimates equal to the initial ones, from `copied_final`.
    """
    tables: dict[Label, Table] = {"initial": reported.initial, "final": reported.final}
    given = {"references": references, "analysis": analysis, "copied": copied}
    first = _judge("initial", reported, **given)
    before = frozenset(one.mistake.kind for one in first.explain().explained)
    judged: dict[Label, _Judged] = {
        "initial": first,
        "final": _judge("final", reported, **given, before=before),
    }
    found = _explain_both(judged)
    flags = [flag for one in judged.values() for flag in one.flags]
    left: dict[Label, list[str]] = {}
    out_of_order: dict[Label, set[str]] = {}
    for label, one in judged.items():
        rest = [n for n in found[label].left if one.errors[n] > limit(n, label)]
        broken = one.broken_laws(set(rest))
        flags += [law.flag(one.table, label) for law in broken]
        out_of_order[label] = {name for law in broken for name in law.names}
        left[label] = [name for name in rest if name not in out_of_order[label]]
    if copied:
        flags.append(copied_flag(reported, copied, references))
    explained: dict[Label, list[ExplainedNumbers]] = {
        label: [e for e in found[label].explained if not one.suspect.isdisjoint(e.names)]
        for label, one in judged.items()
    }
    every = [one for own in explained.values() for one in own]
    flags += specific_flags(every, tables, references)
    flags += [
        off_flag(tables[label], names, getattr(references, label), label)
        for label, names in left.items()
        if names
    ]
    if apart := _apart(reported, references, analysis, flags, every):
        flags.append(disagreement_flag(reported, apart))
    named: dict[Label, frozenset[str]] = {}
    slipped: dict[Label, tuple[Slipped, ...]] = {}
    corrected: dict[str, float] = {}
    for label, one in judged.items():
        known = _named(one.table, explained[label], known=one.all_known)
        wide: dict[str, Code] = {n: e.mistake.codes[0] for e in explained[label] for n in e.names}
        unknown = _unnamed(
            one,
            known,
            wide=wide,
            left=left[label],
            out_of_order=out_of_order[label],
            copied=copied if label == "final" else (),
        )
        named[label], slipped[label] = frozenset(wide), (*known, *unknown)
        numbers = undo(one.table, known, left=())
        corrected = {x: float(number.value) for x, number in numbers.items() if number.value > 0}
    corrected |= {name: references.final[name].value for name in left["final"]}
    possible = not broken_orders({n: Decimal(v) for n, v in corrected.items()}, initial=False)
    return Diagnosis(
        flags=tuple(flags), corrected=corrected, named=named, slipped=slipped, possible=possible
    )


def _apart(
    reported: Reported,
    references: References,
    analysis: Analysis,
    flags: Sequence[Flag],
    explained: Sequence[ExplainedNumbers],
) -> list[tuple[float, str]]:
    """Return the numbers that differ between the tables for a reason that no flag gives.

    A mistake in one table makes the tables differ, even in numbers that the recordings do not
    give. On a nonlinear bench, estimates from large and small motions may differ.
    """
    if not is_linear(analysis):
        return []
    named = {name for flag in flags for name in flag.parameters}
    symbols = {read_name(name).symbol for one in explained for name in one.names}
    return [
        (size, name)
        for size, name in _disagreements(reported, references, blurred=True)
        if name not in named and read_name(name).symbol not in symbols
    ]


def _named(
    table: Table, explained: Sequence[ExplainedNumbers], *, known: Mapping[str, Reference]
) -> list[Slipped]:
    """Return what known mistakes did to the numbers of one table.

    Carts that are swapped are put back only if all their numbers are reported.
    """
    found: dict[str, Slipped] = {}
    for one in explained:
        mistake = one.mistake
        names = [n for n in one.names if n in mistake.predicted]
        if mistake.sources:
            names = [n for n in mistake.predicted if n in table]
            if not {mistake.sources.get(n, n) for n in names} <= set(names):
                continue
        if any(name in found or table[name] <= 0 for name in names):
            continue
        for name in names:
            source, factors = mistake.changes(name, known)
            changed = {Slip(code=code): factor for code, factor in factors.items()}
            found[name] = Slipped(name=name, source=source, factors=changed)
    return list(found.values())


def _unnamed(
    judged: "_Judged",
    named: Sequence[Slipped],
    *,
    wide: Mapping[str, Code],
    left: Sequence[str],
    out_of_order: Collection[str],
    copied: Sequence[str],
) -> list[Slipped]:
    """Return the wrong or missing numbers of a table that no known mistake explains.

    Laws and the comparison of tables use the number from the recordings instead of such a number.
    This needs a table of which most numbers are the student's own.

    Parameters
    ----------
    wide : numbers that a mistake of the whole table explains, though it predicts them badly.
    """
    done, table, label = {one.name for one in named}, judged.table, judged.label
    off: Code = "initial_off" if label == "initial" else "final_off"
    codes: dict[str, Code] = {**wide, **dict.fromkeys(left, off)}
    codes |= dict.fromkeys(out_of_order, "physically_impossible")
    codes |= {n: "no_fit_done" for n in copied if judged.is_off(n)}
    codes |= {n: "physically_impossible" for n in not_positive(table)}
    codes |= {n: "missing" for n in judged.all_known if n not in table}
    found = []
    for name, code in codes.items():
        right = judged.all_known.get(name)
        if right is None or right.value <= 0 or name in done or table.get(name) == 0:
            continue
        if code == "physically_impossible" and table[name] < 0:
            # A wrong sign can be undone.
            found.append(Slipped(name=name, source=name, factors={Slip(code=code): -1.0}))
            continue
        slip = Slip(code=code, number=f"{label}.{name}")
        found.append(Slipped(name=name, source=name, factors={slip: 1.0}, right=right))
    replaced = sum(one.right is not None for one in found)
    return found if 2 * replaced < len(judged.all_known) else []


def _explain_both(judged: Mapping[Label, "_Judged"]) -> dict[Label, Explanation]:
    """Explain both tables; a mistake found in one table costs no likelihood in the other."""
    alone = {label: one.explain() for label, one in judged.items()}
    return {
        label: one.explain(believed=alone[OTHER[label]].codes)
        if alone[OTHER[label]].codes
        else alone[label]
        for label, one in judged.items()
    }


@dataclass(frozen=True, kw_only=True)
class _Judged:
    """A table compared with the recordings.

    Attributes
    ----------
    known : the numbers from the recordings, by parameter.
    errors : the error, in percent, of each number that the recordings give and that has no flag
        yet.
    all_known : the same, also for numbers that are missing or already have a flag.
    suspect : numbers that are wrong or doubtful enough to look for a known mistake.
    unordered : gains that may each be right, but whose order is impossible.
    laws : laws of order that the table breaks.
    flags : flags that do not depend on the recordings.
    """

    label: Label
    table: Table
    known: Mapping[str, Reference]
    all_known: Mapping[str, Reference]
    errors: dict[str, float]
    suspect: frozenset[str]
    unordered: frozenset[str]
    mistakes: list[Mistake]
    laws: list[BrokenOrder]
    flags: list[Flag]

    def is_off(self, name: str) -> bool:
        """Return whether a reported number is wrong enough for a flag."""
        known = self.all_known.get(name)
        if known is None:
            return False
        error = percent_off(self.table[name], known, sigmas=limits.SIGMAS)
        return error > limit(name, self.label)

    def broken_laws(self, off: set[str]) -> list[BrokenOrder]:
        """Return the broken laws of order for which wrong numbers are responsible.

        Parameters
        ----------
        off : wrong numbers that no known mistake explains.
        """
        return [
            law
            for law in self.laws
            if not self.errors or (off & set(law.names) and (law.is_plain or set(law.names) <= off))
        ]

    def explain(self, *, believed: frozenset[Code] = frozenset()) -> Explanation:
        """Return the mistakes that explain the wrong numbers."""
        off = [n for n in self.errors if n in self.suspect or n in self.unordered]
        return explain(
            self.table,
            known=self.known,
            off=off,
            mistakes=self.mistakes,
            label=self.label,
            believed=believed,
        )


def _judge(
    label: Label,
    reported: Reported,
    *,
    references: References,
    analysis: Analysis,
    copied: Sequence[str],
    before: Collection[ExplanationKey] = (),
) -> _Judged:
    """Compare one table with the recordings.

    Parameters
    ----------
    before : the kinds of mistakes that were found in the initial table.
    """
    table: Table = getattr(reported, label)
    known: dict[str, Reference] = getattr(references, label)
    impossible = not_positive(table)
    taken = {*impossible, *(copied if label == "final" else ())}
    errors = {
        name: float(percent_off(typed, known[name], sigmas=limits.SIGMAS))
        for name, typed in table.items()
        if name in known and name not in taken
    }
    suspect = [n for n, e in errors.items() if e > min(limit(n, label), limits.SUSPECT_DAMPING)]
    if label == "initial":
        # With friction, the bounds are too wide to show that a first estimate is wrong. But it is
        # wrong if it contradicts a final number that is right.
        apart = _disagreements(reported, references, blurred=False)
        apart = [name for _, name in apart if read_name(name).is_gain]
        suspect += [n for n in apart if n in errors and _agrees(reported.final[n], references, n)]
    laws = broken_orders(table, initial=label == "initial")
    unordered = _unordered(laws, label, reported, suspect=suspect) & errors.keys()
    mistakes = []
    if suspect or unordered:  # otherwise there is nothing to explain
        there = {name: reference for name, reference in known.items() if name in table}
        mistakes = known_mistakes(there, analysis, reported)
    if label == "final":
        mistakes = [m for m in mistakes if m.kind in before or _may_be_final(m, reported)]
        if len(suspect) >= min(2, analysis.bench.n):
            mistakes += transient_fits(analysis, table, known)
    # If gains are in an impossible order, this is reported rather than a guess at the mistake.
    if any(law.is_of_gains for law in laws):
        mistakes = [
            m for m in mistakes if m.is_plain or not all(read_name(n).is_gain for n in m.predicted)
        ]
    return _Judged(
        label=label,
        table=table,
        known={name: known[name] for name in errors},
        all_known=known,
        errors=errors,
        suspect=frozenset(suspect),
        unordered=unordered,
        mistakes=mistakes,
        laws=laws,
        flags=[impossible_flag(table, impossible, known, label)] if impossible else [],
    )


def _unordered(
    laws: Sequence[BrokenOrder], label: Label, reported: Reported, *, suspect: Sequence[str]
) -> frozenset[str]:
    """Return the gains whose order is impossible, unless the other table confirms one of them."""
    other: Table = getattr(reported, OTHER[label])
    table: Table = getattr(reported, label)
    gains = [law for law in laws if law.is_of_gains and not set(law.names).isdisjoint(suspect)]
    return frozenset(
        name
        for law in gains
        if not any(n in other and _near(table[n], other[n]) for n in law.names)
        for name in law.names
    )


def _agrees(final: Decimal, references: References, name: str) -> bool:
    """Return whether a final number agrees with the recordings."""
    known = references.final.get(name)
    return known is not None and percent_off(final, known, sigmas=limits.SIGMAS) == 0


def _near(a: Decimal, b: Decimal) -> bool:
    return abs(a - b) <= Decimal(str(limits.CONFIRMED)) * abs(b)


def _may_be_final(mistake: Mistake, reported: Reported) -> bool:
    """Return whether a mistake is possible in a final table.

    A fit does not use readings of decays and steps. So mistakes in such readings affect only copied
    numbers, unless the initial table has the same mistake.
    """
    if not mistake.from_time_records:
        return True
    both = [n for n in mistake.predicted if n in reported.final and n in reported.initial]
    return all(reported.final[n] == reported.initial[n] for n in both)


def _disagreements(
    reported: Reported, references: References, *, blurred: bool
) -> list[tuple[float, str]]:
    """Return the numbers that differ between the tables, as (difference, name), worst first.

    Parameters
    ----------
    blurred : whether to allow the difference that honest readings of the recordings may have.
    """
    apart: list[tuple[float, str]] = []
    for name, final in reported.final.items():
        initial = reported.initial.get(name)
        guess = read_name(name).is_damping and name not in references.initial
        if initial is None or guess or final <= 0 or initial <= 0:
            continue
        bounds = [float(final)]
        if name in references.initial and name in references.final:
            if references.final[name].low <= 0:
                continue
            # The recordings' own initial and final estimates may differ; the table may differ by as
            # much.
            ratio = references.initial[name].value / references.final[name].value
            bounds.append(float(final) * ratio)
            if blurred:
                spread = references.initial[name].high / references.initial[name].low
                bounds += [bounds[0] / spread, bounds[0] * spread]
        allowed = Reference(value=float(final), low=min(bounds), high=max(bounds), source="final")
        error = float(percent_off(initial, allowed, sigmas=0.0))
        worth = 2 * limits.OFF_DAMPING if read_name(name).is_damping else limits.OFF_EACH_OTHER
        by_eye = limit(name, "initial") == limits.OFF_BY_EYE
        if error > (worth + limits.OFF_BY_EYE if by_eye else worth):
            apart.append((error / worth, name))
    return sorted(apart, reverse=True)
