"""The equations of motion with effects included."""

from collections.abc import Sequence

from pipeline.plant.nonlinear.effects.base import EffectTerm
from pipeline.report.document import Formula
from pipeline.report.equations.model import equations_of_motion, formula
from pipeline.words.math import Term, row, sub

_LINEAR_PART = ("k", "d", "+")  # part of a spring's law that the linear chain already has
_ACTS = ("f", "=")


def augmented_equations(springs: Sequence[bool], terms: Sequence[EffectTerm]) -> Formula:
    """Return Newton's law of every cart, in which each effect adds a force.

    The forces have the letters a, b, … in the order of the effects.
    """
    n = len(springs) - 1
    forces: list[list[Term]] = [[] for _ in range(n)]
    forces[0] = [_input(terms)]
    for letter, term in zip(_letters(terms), terms, strict=True):
        if term.effect.formula.parts[:2] != _ACTS:
            continue
        f = sub("f", letter)
        if "spring" in term.where:
            spring = term.place
            if spring <= n:
                forces[spring - 1] += ["−", f]
            if spring > 1:
                forces[spring - 2] += ["+", f]
        else:
            forces[max(term.place, 1) - 1] += ["+", f]
    return equations_of_motion(springs, forces=[_sum(parts) for parts in forces])


def law(terms: Sequence[EffectTerm], index: int) -> Formula:
    """Return the law of one effect, with its letter in the equations of motion."""
    effect, letter = terms[index].effect, _letters(terms)[index]
    parts = effect.formula.parts
    if parts[:2] == _ACTS:
        force = parts[2:]
        if effect.place == "spring" and force[:3] == _LINEAR_PART:
            force = force[3:]
        return formula(row(sub("f", letter), "=", *force))
    if "→" in parts:
        at = parts.index("→")
        return formula(row(sub(parts[0], letter), *parts[1:at], "=", *parts[at + 1 :]))
    return formula(effect.formula)


def _letters(terms: Sequence[EffectTerm]) -> str:
    return "abcdefgh"[: len(terms)]


def _input(terms: Sequence[EffectTerm]) -> Term:
    """Return the symbol of cart 1's input: u, or u with the letter of an effect in the drive."""
    for letter, term in reversed(list(zip(_letters(terms), terms, strict=True))):
        if "→" in term.effect.formula.parts:
            return sub("u", letter)
    return "u"


def _sum(parts: list[Term]) -> Term:
    if not parts:
        return "0"
    return row(*(parts[1:] if parts[0] == "+" else parts))
