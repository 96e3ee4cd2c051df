"""The flags of the parameter tables; each shows the number that makes the mistake clearest.

Here are also the mistakes that a table shows by itself: numbers that no real carts can have, by
their signs and order, and final estimates that were copied from the initial ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from math import exp

from pipeline.grading import limits
from pipeline.grading.grade import CODES, Code, Flag
from pipeline.grading.mistakes.explain import ExplainedNumbers, Label, Table
from pipeline.grading.reference import Reference, References
from pipeline.grading.tolerance import as_typed, half_digit, is_vague, percent_off, rounding
from pipeline.grading.words import WORDS
from pipeline.names import read_name
from pipeline.plant.identities import HEAVY_DAMPING, parameter_orders
from pipeline.submission import Reported

_TOLD: dict[Label, str] = {"initial": "first_estimate", "final": "final_estimate"}
OTHER: dict[Label, Label] = {"initial": "final", "final": "initial"}


def specific_flags(
    explained: Sequence[ExplainedNumbers], tables: Mapping[Label, Table], references: References
) -> list[Flag]:
    """Return one flag for each code of a known mistake, for both tables together.

    The text of the flag shows the first number that the mistake explains.
    """
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
        message = WORDS.text(
            "mistake",
            name=name,
            table=WORDS.text(_TOLD[first.table]),
            help=first.mistake.help(typed, reference),
        )
        if first.rival and code not in first.rival.codes:
            evidence["or_else"] = [c for c in first.rival.codes if c not in first.mistake.codes]
            message += WORDS.text("or_else", help=first.rival.help(typed, reference))
        other = OTHER[first.table]
        # Without this, a student might correct only one table.
        if any(one.table == other for one in mine):
            evidence["also_in"] = other
            message += WORDS.text(f"also_{other}")
        flags.append(Flag(code=code, parameters=tuple(names), message=message, evidence=evidence))
    return flags


def off_flag(
    table: Table, names: Sequence[str], known: Mapping[str, Reference], label: str
) -> Flag:
    """Return the flag for wrong numbers without an explanation; it shows the largest error."""

    def error(name: str) -> float:
        return float(percent_off(table[name], known[name], sigmas=limits.SIGMAS)) / limit(
            name, label
        )

    worst = max(names, key=error)
    reference, typed = known[worst], table[worst]
    looks = {"K": "look_gain", "omega": "look_frequency", "zeta": "look_damping"}
    look = looks.get(read_name(worst).symbol, "look")
    code: Code = "initial_off" if label == "initial" else "final_off"
    return Flag(
        code=code,
        parameters=tuple(names),
        message=WORDS.text(
            "off",
            name=worst,
            whose=reference.said_of,
            recomputed=reference.text,
            reported=as_typed(typed),
            look=WORDS.text(look),
        ),
        evidence=_evidence(worst, typed, reference, label),
    )


def impossible_flag(
    table: Table, names: Sequence[str], known: Mapping[str, Reference], label: Label
) -> Flag:
    """Return the flag for numbers that are zero or negative."""
    name = names[0]
    return Flag(
        code="physically_impossible",
        parameters=tuple(names),
        message=WORDS.text(
            "not_positive",
            name=name,
            reported=as_typed(table[name]),
            table=WORDS.text(_TOLD[label]),
            hint=WORDS.text("hint_sign" if table[name] else "hint_digits"),
        ),
        evidence=_evidence(name, table[name], known.get(name), label),
    )


def copied_flag(reported: Reported, copied: Sequence[str], references: References) -> Flag:
    """Return the flag for copied final numbers; it shows the largest error."""

    def error(name: str) -> float:
        known = references.final.get(name)
        return float(percent_off(reported.final[name], known, sigmas=0.0)) if known else 0.0

    worst = max(copied, key=error)
    return Flag(
        code="no_fit_done",
        parameters=tuple(copied),
        message=WORDS.text("copied", name=worst),
        evidence=_evidence(worst, reported.final[worst], references.final.get(worst), "final"),
    )


def disagreement_flag(reported: Reported, apart: Sequence[tuple[float, str]]) -> Flag:
    """Return the flag for numbers that differ between the two tables.

    Parameters
    ----------
    apart : pairs of difference and parameter name, the largest difference first.
    """
    _, worst = apart[0]
    initial, final = reported.initial[worst], reported.final[worst]
    return Flag(
        code="initial_final_disagree",
        parameters=tuple(name for _, name in apart),
        message=WORDS.text(
            "disagree", name=worst, initial=as_typed(initial), final=as_typed(final)
        ),
        evidence={
            "parameter": worst,
            "initial": float(initial),
            "final": float(final),
            "ratio": float(final / initial),
        },
    )


def limit(name: str, table: str) -> float:
    """Return the error, in percent, above which a reported number gets a flag."""
    if read_name(name).is_damping:
        return limits.OFF_DAMPING
    if table == "final":
        return limits.OFF_FINAL
    return limits.OFF_BY_EYE if read_name(name).is_by_eye else limits.OFF_INITIAL


def _evidence(name: str, typed: Decimal, reference: Reference | None, table: str) -> dict:
    evidence: dict = {"parameter": name, "table": table, "reported": float(typed)}
    if reference is not None:
        evidence["recomputed"] = reference.value
        if reference.value:
            evidence["ratio"] = float(typed) / reference.value
    return evidence


@dataclass(frozen=True, kw_only=True)
class BrokenOrder:
    """Two numbers of a table that break the law `lesser ≤ greater`."""

    lesser: str
    greater: str
    reason: str

    @property
    def names(self) -> tuple[str, str]:
        """Both parameter names."""
        return self.lesser, self.greater

    @property
    def is_of_gains(self) -> bool:
        """Return whether the two numbers are static gains."""
        return read_name(self.lesser).is_gain

    @property
    def is_plain(self) -> bool:
        """Return whether the law is obvious to students, as it is for gains and resonances.

        Laws about nulls and about frequencies of single carts are not obvious. Then the number from
        the recordings helps the student more.
        """
        return self.is_of_gains or all(read_name(name).is_mode for name in self.names)

    def flag(self, table: Mapping[str, Decimal], label: str) -> Flag:
        """Return the flag for the two numbers."""
        low, high = table[self.lesser], table[self.greater]
        return Flag(
            code="physically_impossible",
            parameters=self.names,
            message=WORDS.text(
                "broken_order",
                lesser=self.lesser,
                low=as_typed(low),
                greater=self.greater,
                high=as_typed(high),
                table=label,
                reason=self.reason,
            ),
            evidence={
                "table": label,
                "reported": {self.lesser: float(low), self.greater: float(high)},
                "ratio": float(low / high),
            },
        )


def not_positive(table: Mapping[str, Decimal]) -> list[str]:
    """Return the parameters that are zero or negative."""
    return [name for name, typed in table.items() if typed <= 0]


def broken_orders(table: Mapping[str, Decimal], *, initial: bool) -> list[BrokenOrder]:
    """Return the laws of order that a table breaks by more than rounding and usual errors.

    Parameters
    ----------
    initial : whether this is the initial table, whose numbers are read off plots.
    """
    # Numbers from a fit are right within a few percent; first estimates are less precise.
    slack = 1.2 if initial else 1.1
    heavy = any(v > HEAVY_DAMPING for n, v in table.items() if read_name(n).is_ratio)
    broken = []
    for lesser, greater, reason in parameter_orders(list(table)):
        if heavy and read_name(lesser).is_frequency:
            continue
        low, high = table[lesser], table[greater]
        if low <= 0 or high <= 0:
            continue
        least = low - Decimal(float(rounding(low)))
        most = high + Decimal(float(rounding(high)))
        if float(least) > slack * float(most):
            broken.append(BrokenOrder(lesser=lesser, greater=greater, reason=reason))
    return broken


def copied_final(reported: Reported, *, references: References) -> list[str]:
    """Return the final estimates that equal the initial ones, if this is no coincidence.

    Students may honestly keep the numbers of single carts, so most numbers that only a fit can give
    must be equal too. The strongest evidence is a guessed damping that did not change. Tables typed
    with single digits are ignored, because rounding makes them agree.
    """
    both = [name for name in reported.final if name in reported.initial]
    same = [n for n in both if reported.final[n] == reported.initial[n]]
    most = 0.75  # least share of equal numbers
    if not both or len(same) < most * len(both):
        return []
    if 2 * sum(is_vague(reported.final[name]) for name in same) > len(same):
        return []
    fitted = [name for name in both if read_name(name).is_by_eye]
    if len([name for name in fitted if name in same]) < most * len(fitted):
        return []
    chance = 1.0
    for name in same:
        chance *= _coincidence(reported.final[name], references.final.get(name), name)
    return same if chance < 3e-3 else []  # a fit rarely reproduces so many numbers by chance


def _coincidence(typed: Decimal, reference: Reference | None, name: str) -> float:
    """Return the probability that a fit gives the same digits as the first estimate.

    It is high if the first estimate was right to its last digit, or if few digits were typed.
    """
    if not typed:
        return 1.0
    damping = read_name(name).is_damping
    half = half_digit(typed) / abs(Fraction(typed))
    # Usual relative difference between first and final estimate; smaller where the data are
    # precise.
    apart, surprise = 0.15 if damping else 0.01, 0.0
    if reference is not None and reference.low > 0:
        # A number with a single digit is rounded more than grading allows for.
        hidden = half - rounding(typed) / abs(Fraction(typed))
        off = max(float(percent_off(typed, reference, sigmas=limits.SIGMAS) / 100 - hidden), 0.0)
        if reference.within(1.05 if damping else 1.01):
            apart = 0.03 if damping else 0.003
            if off == 0:
                return 1.0
        measured = not damping and not read_name(name).is_by_eye
        # A larger error points to a mistake, perhaps the same one in both tables, not to a poor
        # fit.
        if not measured or off <= 0.2:
            surprise = min(0.5 * (off / apart) ** 2, 3.0)
    # A difference of two normal errors has the density 1/√(4π) at zero.
    again = 1.0 if is_vague(typed) else min(1.0, 2 * float(half) / (apart * 3.5))
    return again * exp(-surprise)
