"""The flags of the parameter tables; each shows the number that makes the mistake clearest."""

from collections.abc import Mapping, Sequence
from decimal import Decimal

from pipeline.grading import limits
from pipeline.grading.grade import CODES, Code, Flag
from pipeline.grading.mistakes.explain import ExplainedNumbers, Label, Table
from pipeline.grading.reference import Reference, References
from pipeline.grading.tolerance import as_typed, percent_off
from pipeline.grading.words import WORDS
from pipeline.names import read_name
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
