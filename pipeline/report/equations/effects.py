"""The equations of motion with the effects in them."""

from collections.abc import Sequence

from pipeline.plant.nonlinear.effects.base import Term as EffectTerm
from pipeline.report.document import Formula
from pipeline.report.equations.model import equations_of_motion, formula
from pipeline.report.math.tex import from_tex
from pipeline.report.math.tree import Term, row, sub

_LINEAR_PART = "k d + "  # of the springs' laws; the chain has it already
_ACTS = "f = "
_BECOMES = r"\to"


def augmented_equations(springs: Sequence[bool], terms: Sequence[EffectTerm]) -> Formula:
    """Return Newton's law for every cart; effect number i adds a force with the letter i."""
    n = len(springs) - 1
    forces: list[list[Term]] = [[] for _ in range(n)]
    forces[0] = [_input(terms)]
    for letter, term in zip(_letters(terms), terms, strict=True):
        if not term.effect.equation.startswith(_ACTS):
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
    """Return the law of one effect, under the letter it has in the equations of motion."""
    equation, letter = terms[index].effect.equation, _letters(terms)[index]
    if equation.startswith(_ACTS):
        force = equation.removeprefix(_ACTS)
        if terms[index].effect.place == "spring":
            force = force.removeprefix(_LINEAR_PART)
        return formula(row(sub("f", letter), "=", *from_tex(force).parts))
    if _BECOMES in equation:
        left, right = equation.split(_BECOMES, 1)
        parts = from_tex(left).parts
        return formula(row(sub(parts[0], letter), *parts[1:], "=", *from_tex(right).parts))
    return formula(from_tex(equation))


def _letters(terms: Sequence[EffectTerm]) -> str:
    return "abcdefgh"[: len(terms)]


def _input(terms: Sequence[EffectTerm]) -> Term:
    """Return the symbol of what drives cart 1: u, or what the drive makes of it."""
    for letter, term in reversed(list(zip(_letters(terms), terms, strict=True))):
        if _BECOMES in term.effect.equation:
            return sub("u", letter)
    return "u"


def _sum(parts: list[Term]) -> Term:
    if not parts:
        return "0"
    return row(*(parts[1:] if parts[0] == "+" else parts))
