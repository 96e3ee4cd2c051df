"""The equations of motion with effects included."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from string import ascii_lowercase

from pipeline.plant.effect import EffectTerm, ForceLaw, input_steps
from pipeline.report.document import Formula
from pipeline.report.equations.model import equations_of_motion, formula
from pipeline.words.math import WIDE_SPACE, Math, Term, dot, row, sub, upright

_LINEAR_PART = ("k", "d", "+")  # start of a spring's law that is already part of the linear chain
_ACTS = ("f", "=")
_COMMAND = sub("u", "command")
_MOTOR_MASS = sub("m", "m")


def in_order(terms: Sequence[EffectTerm]) -> list[int]:
    """Return the indices of the effects in the order in which they get their letters.

    This is the order of `terms`, except that effects on the input follow the simulator's order.
    """
    steps = input_steps(terms)
    after = iter(steps)
    return [terms.index(next(after) if term in steps else term) for term in terms]


def augmented_equations(springs: Sequence[bool], terms: Sequence[EffectTerm]) -> Formula:
    """Return Newton's law of every cart, in which each effect adds a force.

    The forces are named by the letters a, b, … of the effects. Cart 1 is driven by the input as
    changed by all effects on the input. If there is play between the motor and cart 1, the force of
    the contact drives the cart, and the motor's mass is subtracted from the cart's mass.
    """
    n = len(springs) - 1
    letters = _letters(terms)
    forces: list[list[Term]] = [[] for _ in range(n)]
    play = _play(terms)
    if play is None:
        forces[0] = [_arriving(terms)]
    else:
        forces[0] = [sub("f", letters[play]), "+", _MOTOR_MASS, sub(dot("x", order=2), "1")]
    for index in in_order(terms):
        term, f = terms[index], sub("f", letters[index])
        if term.effect.formula.parts[:2] != _ACTS or (play is not None and _on_motor(term)):
            continue
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
    """Return the law of one effect, marked with the effect's letter.

    Effects on the input form a sequence: each one changes the output of the previous one. A force
    that depends on the input uses the last output.
    """
    term, letter = terms[index], _letters(terms)[index]
    effect, parts = term.effect, term.effect.formula.parts
    steps = input_steps(terms)
    if term in steps:
        before, after = _arriving(terms, before=term), sub("u", letter)
        if "→" in parts:
            at = parts.index("→")
            changed = _replaced(parts[at + 1 :], {"u": before})
            return formula(row(after, *parts[1:at], "=", *changed))
        own = {_COMMAND: before, "u": after, dot("u"): sub(dot("u"), letter)}
        return formula(row(*_replaced(parts, own)))
    if effect.has_play:
        return formula(row(*_across(terms, index)))
    if parts[:2] != _ACTS:
        return formula(effect.formula)  # a sensor
    force = parts[2:]
    if effect.place == "spring" and force[:3] == _LINEAR_PART:
        force = force[3:]
    # A drive is powered while its logged input is not zero.
    powered = upright(" while ")
    end = force.index(powered) if powered in force else len(force)
    symbols: dict[Term, Term] = {"u": _arriving(terms), "f": sub("f", letter)}
    if _on_motor(term) and _play(terms) is not None:
        symbols |= {sub(letter, "1"): sub(letter, "m") for letter in "xv"}
    return formula(row(sub("f", letter), "=", *_replaced(force[:end], symbols), *force[end:]))


def _across(terms: Sequence[EffectTerm], index: int) -> list[Term]:
    """Return the contact force between motor and cart 1, and Newton's law of the motor."""
    letters = _letters(terms)
    force = sub("f", letters[index])
    motor: list[Term] = [_arriving(terms), "−", force]
    for i in in_order(terms):
        if _on_motor(terms[i]):
            motor += ["+", sub("f", letters[i])]
    contact = _replaced(terms[index].effect.formula.parts, {sub("f", "1"): force})
    return [*contact, ",", WIDE_SPACE, _MOTOR_MASS, sub(dot("x", order=2), "m"), "=", *motor]


def _letters(terms: Sequence[EffectTerm]) -> dict[int, str]:
    """Return the letter of each effect, by its index."""
    return dict(zip(in_order(terms), ascii_lowercase, strict=False))


def _arriving(terms: Sequence[EffectTerm], *, before: EffectTerm | None = None) -> Term:
    """Return the symbol of the input after all effects on it, or only those before `before`."""
    steps = input_steps(terms)
    done = steps if before is None else steps[: steps.index(before)]
    return sub("u", _letters(terms)[terms.index(done[-1])]) if done else "u"


def _play(terms: Sequence[EffectTerm]) -> int | None:
    """Return the index of the play between motor and cart 1; None if there is no play."""
    return next((i for i, term in enumerate(terms) if term.effect.has_play), None)


def _on_motor(term: EffectTerm) -> bool:
    """Return whether the force acts on the motor, rather than on cart 1, if there is play."""
    return isinstance(term.effect.law, ForceLaw) and term.effect.law.on_motor


def _replaced(terms: Sequence[Term], by: Mapping[Term, Term]) -> list[Term]:
    """Return the terms with symbols replaced, also inside nested terms."""
    return [
        by[term]
        if term in by
        else replace(term, parts=tuple(_replaced(term.parts, by)))
        if isinstance(term, Math)
        else term
        for term in terms
    ]


def _sum(parts: list[Term]) -> Term:
    if not parts:
        return "0"
    return row(*(parts[1:] if parts[0] == "+" else parts))
