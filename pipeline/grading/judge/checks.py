"""The checks of a rubric: each one returns a share of the points and a message."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.grading import limits
from pipeline.grading import rubric as asked
from pipeline.grading.judge.checks_loop import (
    judge_claims,
    judge_gains,
    judge_hardware,
    judge_prefilter,
)
from pipeline.grading.judge.context import (
    GradingContext,
    Judgement,
    Verdict,
    lacking,
    pieces_for,
    say_missing,
    share_sound,
    share_there,
)
from pipeline.grading.mistakes.state_model import derived_numbers, model_harm, order_names
from pipeline.grading.mistakes.undo import Number
from pipeline.grading.reference import OFF_SCALE, OWN, Reference, is_linear, off_scale
from pipeline.grading.rubric import matching
from pipeline.grading.tolerance import (
    ALL,
    NO_CREDIT,
    NONE,
    Deviation,
    as_typed,
    percent_off,
    points_for,
    points_for_one,
)
from pipeline.grading.words import WORDS
from pipeline.names import parameter_names, read_name
from pipeline.plant.identities import parameter_orders, recover_from_parameters
from pipeline.words.numbers import first_few, group_messages
from pipeline.words.text import sentence

_NAMED = 4  # largest number of parameters or laws in one message


def judge(criterion: asked.Criterion, context: GradingContext) -> Verdict:
    """Judge one criterion, without regard to the criteria that it requires; see `award.py`."""
    return _JUDGES[criterion.check](criterion, context)


def judge_with_undoing(criterion: asked.Criterion, context: GradingContext) -> Judgement:
    """Judge one criterion as typed, and again with the mistakes of the student undone."""
    typed, slips = judge(criterion, context), context.slips(criterion.check)
    # No law can judge numbers that were left out; those that cannot be read cost only themselves.
    if not slips or (criterion.check == "laws" and context.omits_final):
        return Judgement.plain(typed)
    undone = judge(criterion, context.leaving(()))
    only = {
        slip: typed if len(slips) == 1 else judge(criterion, context.leaving((slip,)))
        for slip in slips
    }
    matters = {
        slip: one
        for slip, one in only.items()
        if (one.share, one.models) != (undone.share, undone.models)
    }
    return Judgement(typed=typed, undone=undone, only=matters)


# ------------------------------------------------------------------- pieces and data


def _required(criterion: asked.RequiredPieces, context: GradingContext) -> Verdict:
    pieces = pieces_for(criterion, context.pieces, context.rubric)
    if not pieces:
        return Verdict(share=ALL, message="Nothing in particular is required.")
    missing = [piece for piece in pieces if piece.share < 1]
    unread = first_few(list(context.analysis.unreadable), _NAMED)
    said = say_missing(missing, most=_NAMED) or "Everything required is here."
    if any(piece.kind is None for piece in pieces) and context.strange:
        unknown = "; ".join(context.strange[:_NAMED])
        said += f" Cannot be read: {sentence(unknown)}"
    return Verdict(
        share=share_there(pieces),
        message=said + (f" Not counted, because they cannot be read: {unread}." if unread else ""),
        expected={"pieces": [piece.name for piece in pieces]},
        found={"missing": [piece.name for piece in missing]},
    )


def _data(_: asked.DataQuality, context: GradingContext) -> Verdict:
    problems, runs = context.problems, len(context.submission.experiments)
    share = share_sound(context)
    said = group_messages((run, why.rstrip(".")) for run, why in problems.items())[:_NAMED]
    faults = " ".join(map(sentence, said))
    if not runs and not problems:
        faults = "There are no recordings."
    elif share == 1 and problems:
        faults = f"{faults} The other recordings are as many as the lab asks for."
    return Verdict(
        share=share, message=faults or "The recordings are sound.", found={"problems": problems}
    )


# ------------------------------------------------------------------------ parameters


def _parameters(criterion: asked.Parameters, context: GradingContext) -> Verdict:
    """Judge the reported parameters against those from the recordings.

    A parameter that is not reported earns nothing.
    """
    table = context.numbers(criterion.check)
    known: Mapping[str, Reference] = getattr(context.references, criterion.check)
    by_own = asked.source_of(criterion) == OWN
    if by_own:
        known = derived_numbers(table, n=context.rubric.system.carts)
        if not known:
            return Verdict(share=None, message="Not checked: the table is not complete.")
    names = matching(criterion.parameters, context.rubric.names)
    impossible = [name for name, number in table.items() if number.value <= 0]
    judged = [n for n in names if n in known or n in impossible]
    guessed = [n for n in names if n not in known and n not in judged]
    needs = lacking(context) if criterion.check == "initial" and not by_own else {}
    unproved = {n: f"no usable {needs[n]}" for n in judged if n in needs and n in table}
    if unproved and len(unproved) == len(judged):
        why = "; ".join(group_messages(unproved.items()))
        return Verdict(share=None, message=f"Not checked, so it earns no points. {sentence(why)}")
    if not judged:
        reasons = [s.reason for s in context.analysis.skipped]
        if off_scale(context.analysis):
            reasons = [OFF_SCALE]
        why = reasons[0] if reasons else "these are first guesses that no recording can confirm"
        return Verdict(share=None, message=f"Not checked: {sentence(why)}")
    unread = {name: context.why_unread(criterion.check, name) for name in judged}
    said = group_messages(unread.items())
    off = [f"Cannot be read: {'; '.join(said)}"] if said else []
    deviations, wrong = [], set()
    for name in judged:
        if name not in table:
            wrong.add(name)
            deviations.append(_deviation(NO_CREDIT, name))
            off += [] if unread[name] else [f"{name} is not reported"]
            continue
        if name in unproved:
            deviations.append(_deviation(NO_CREDIT, name))
            continue
        error = (
            table[name].percent_off(known[name], sigmas=criterion.sigmas)
            if name in known
            else NO_CREDIT
        )
        deviations.append(_deviation(error, name))
        if points_for_one(criterion, deviations[-1]) < 1:
            wrong.add(name)
            there = f", but {known[name].said_of} {known[name].text}" if name in known else ""
            off.append(f"{name}: you report {table[name].text}{there}")
    left = (
        f" Not judged: {first_few(guessed, _NAMED)}."
        if guessed and criterion.check == "final"
        else ""
    )
    loose = any(n in known for n in judged) and not by_own and not is_linear(context.analysis)
    right = WORDS.text("agrees_loosely" if loose else "agrees")
    if by_own:
        right = "They follow from your other numbers."
    message = f"{'; '.join(off[:_NAMED])}." if off else right
    if unproved:
        left += f" Not checked, so without points: {'; '.join(group_messages(unproved.items()))}."
    look = f" {WORDS.text('judged_loosely')}" if loose else ""
    return Verdict(
        share=points_for(criterion, deviations),
        models=(tuple(deviations),),
        message=message + left + look,
        explained=bool(wrong or unproved) and wrong <= context.named[criterion.check],
        expected={n: known[n].value for n in judged if n in known},
        found={n: float(table[n].value) for n in judged if n in table},
        agrees={n: n not in wrong for n in judged if n in table and n not in unproved},
    )


def _deviation(error: Fraction, name: str) -> Deviation:
    return Deviation(error=error, by="damping" if read_name(name).is_damping else "number")


def _initial_final(criterion: asked.InitialFinal, context: GradingContext) -> Verdict:
    """Judge how well the initial and the final table agree, after allowing for rounding.

    Dampings that the recordings do not determine are left out, because students can only guess
    them.
    """
    initial, final = context.numbers("initial"), context.numbers("final")
    names = matching(criterion.parameters, context.rubric.names)
    both = [
        n
        for n in names
        if n in initial
        and n in final
        and not (read_name(n).is_damping and n not in context.references.initial)
    ]
    if not both:
        return Verdict(share=None, message="Not checked: no parameter is in both tables.")
    deviations, apart = [], []
    for name in both:
        deviations.append(_deviation(between(initial[name], final[name]), name))
        if points_for_one(criterion, deviations[-1]) < 1:
            apart.append(f"{name}: first {initial[name].text}, then {final[name].text}")
    return Verdict(
        share=points_for(criterion, deviations),
        models=(tuple(deviations),),
        message=f"{'; '.join(apart[:_NAMED])}." if apart else "Both estimates agree.",
        expected={n: float(initial[n].value) for n in both},
        found={n: float(final[n].value) for n in both},
    )


def between(initial: Number, final: Number) -> Fraction:
    """Return how far two reported numbers differ, in percent, beyond the rounding of each.

    Two negative numbers can agree; their wrong sign is reported by another check.
    """
    if initial.value * final.value <= 0:
        return NO_CREDIT
    std = float(initial.rounding)
    reference = Reference.at(float(abs(initial.value)), std=std, source="initial")
    size = Number(typed=abs(final.typed), factor=abs(final.factor))
    return size.percent_off(reference, sigmas=1.0)


def _laws(criterion: asked.Laws, context: GradingContext) -> Verdict:
    laws = judge_laws(
        context.numbers("final"),
        n=context.rubric.system.carts,
        frequency_percent=criterion.frequency_percent,
        damping_percent=criterion.damping_percent,
    )
    if laws is None:
        missing = (n for n in context.rubric.names if n not in context.reported.final)
        why = next(filter(None, (context.because_unread("final", n) for n in missing)), "")
        return Verdict(share=None, message=f"Not checked: the final table is not complete.{why}")
    broken = [law for law in laws if law.widening > 0]
    said = dict.fromkeys(law.broken for law in broken)
    worst = max((law.widening for law in laws), default=Fraction(0))
    return Verdict(
        share=ALL - worst / _MOST_WIDENING,
        message=f"{'; '.join(list(said)[:_NAMED])}."
        if broken
        else f"All {len(laws)} laws hold within the rounding.",
        expected={"laws": [law.name for law in laws]},
        found={"broken": [law.name for law in broken]},
    )


# ------------------------------------------------------------- state model and controller


def _state_space(criterion: asked.StateModel, context: GradingContext) -> Verdict:
    space = context.reported.state_space
    if space is None or not (space.A and space.B):
        why = [context.because_unread("state_space", n) for n in "AB"]
        told = "".join(dict.fromkeys(why))
        return Verdict(share=NONE, message=f"A and B are not both reported.{told}")
    models = context.models_from(asked.source_of(criterion))
    if not (entries := context.entries_from(models)):
        return Verdict(share=None, message="Not checked: there is no table or fit to compare with.")
    deviations = tuple(
        Deviation(error=e.error, by="number" if e.kind == "stiffness" else e.kind) for e in entries
    )
    shares = [points_for_one(criterion, deviation) for deviation in deviations]
    off = [e for e, share in zip(entries, shares, strict=True) if share < 1]
    named = "; ".join(
        f"{e.name} = {as_typed(e.typed)}, expected {e.right[0]:.4g}" for e in off[:_NAMED]
    )
    message = f"{named}." if off else "A and B follow from the table."
    springs = context.analysis.bench.springs
    n, tied = len(springs) - 1, springs[0] or springs[-1]
    harm = model_harm(space, entries, models=models, n=n, tied=tied, order=context.order)
    most = limits.KEPT_IF_HARMFUL if harm else ALL
    if harm:
        message = f"{WORDS.text(f'model_{harm}')} {message}"
    if (order := order_names(context.order)) != (
        ", ".join(criterion.states) or order_names(range(2 * n))
    ):
        message = f"{message} {WORDS.text('other_order', order=order)}"
    return Verdict(
        share=min(points_for(criterion, deviations), most),
        models=(deviations,),
        most=most,
        message=message,
        expected={e.name: e.right[0] for e in entries if e.kind != "exact" or e in off},
        found={e.name: float(e.typed) for e in entries if e.kind != "exact" or e in off},
        agrees={e.name: e not in off for e in entries if e.kind != "exact" or e in off},
    )


def _effects(criterion: asked.Effects, context: GradingContext) -> Verdict:
    """Judge the named effects against those of the team's bench."""
    if context.effects is None:
        return Verdict(
            share=None, message="Not checked: no answer key has this bench in these units."
        )
    named = context.reported.effects
    if named is None:
        why = context.because_unread("effects")
        return Verdict(share=NONE, message=f"No effect is reported.{why}")
    hidden = {term.effect.key: term for term in context.effects}
    deviations: list[Deviation] = []
    off: dict[str, list[str]] = {}  # what is wrong, by effect
    for key, term in hidden.items():
        stated, wrong = named.get(key, {}), off.setdefault(key, [])
        if key not in named:
            wrong.append(f"an effect is missing{context.because_unread('effects', key)}")
        errors = {"": Fraction(0) if key in named else NO_CREDIT}
        for place, number in term.where.items():
            errors[place] = Fraction(0) if stated.get(place) == number else NO_CREDIT
        for parameter in term.effect.parameters:
            if parameter.reported:
                value, typed = term.parameters[parameter.name], stated.get(parameter.name)
                errors[parameter.name] = _signed_error(typed, value)
        for name, error in errors.items():
            deviations.append(Deviation(error=error))
            if key in named and points_for_one(criterion, deviations[-1]) < 1:
                right = f"your bench has {(term.where | term.parameters)[name]:.3g}"
                typed = f"{name} = {as_typed(stated[name])}" if name in stated else f"no {name}"
                wrong.append(f"{key}: you report {typed}, but {right}")
    for key in named.keys() - hidden.keys():
        deviations.append(Deviation(error=NO_CREDIT))
        off[key] = [f"{key}: your bench does not have it"]
    said = [text for texts in off.values() for text in texts]
    return Verdict(
        share=points_for(criterion, deviations) if deviations else ALL,
        models=(tuple(deviations),) if deviations else (),
        message=f"{'; '.join(said[:_NAMED])}." if said else "The effects of your bench are named.",
        expected={key: {**term.where, **term.parameters} for key, term in hidden.items()},
        found={key: {n: float(v) for n, v in one.items()} for key, one in named.items()},
        agrees={key: not off[key] for key in named},
    )


def _signed_error(typed: Decimal | None, value: float) -> Fraction:
    """Return the error of a number that may be negative, in percent; a missing one is all wrong."""
    if typed is None:
        return NO_CREDIT
    size = typed if value > 0 else -typed
    return percent_off(size, Reference.at(abs(value)), sigmas=0.0)


def _manual(_criterion: asked.Manual, _work: GradingContext) -> Verdict:
    return Verdict(share=None, message="Graded by a person; not yet.")


_JUDGES: Mapping[str, Callable[[Any, GradingContext], Verdict]] = {
    "required": _required,
    "data": _data,
    "initial": _parameters,
    "final": _parameters,
    "initial_final": _initial_final,
    "laws": _laws,
    "state_space": _state_space,
    "gains": judge_gains,
    "claims": judge_claims,
    "prefilter": judge_prefilter,
    "hardware": judge_hardware,
    "effects": _effects,
    "manual": _manual,
}


# -------------------------------------------------- the laws of a final table's parameters
#
# Two carts have eight transfer-function parameters but seven physical ones, three carts fifteen but
# ten. So the extra parameters must agree with the others.
#
# Because of rounding, each number stands for an interval, and the whole table for a box. An
# inequality holds if it is true at one corner of the box. An equation holds if its left side is at
# least the right side at one corner, and at most the right side at another. All corners are
# evaluated at once.

_MOST_WIDENING = 4  # tolerances; a law that needs this much widening earns no points
_PER_TOLERANCE = 2  # steps of widening per tolerance


@dataclass(frozen=True, kw_only=True)
class ParameterLaw:
    """One law, and how much the box of rounding must be widened for the law to hold.

    Attributes
    ----------
    broken : a sentence that says what disagrees if the law does not hold.
    widening : the least widening for which the law holds, in tolerances; 0 if rounding is enough.
    """

    name: str
    broken: str
    widening: Fraction


def judge_laws(
    final: Mapping[str, Number], *, n: int, frequency_percent: float, damping_percent: float
) -> list[ParameterLaw] | None:
    """Judge every law of a final table; return None if the table is incomplete.

    Parameters
    ----------
    frequency_percent, damping_percent : tolerances that widen the box; the first also applies to
        gains.
    """
    names = parameter_names(n)
    if any(name not in final for name in names):
        return None
    half = {name: float(final[name].rounding) for name in names}
    value = {name: float(final[name].value) for name in names}
    percent = {
        name: (damping_percent if read_name(name).is_damping else frequency_percent) / 100
        for name in names
    }

    def box(step: int) -> dict[str, float]:
        share = step / _PER_TOLERANCE
        return {x: max(half[x], share * percent[x] * abs(value[x])) for x in names}

    results, last = _evaluate(value, box(0), n=n), _MOST_WIDENING * _PER_TOLERANCE
    needed = {name: 0 if holds else last for name, (_, holds) in results.items()}
    failing = {name for name, step in needed.items() if step}
    for step in range(1, last) if failing else ():
        wider = _evaluate(value, box(step), n=n)
        met = {name for name in failing if wider[name][1]}
        needed |= dict.fromkeys(met, step)
        failing -= met
        if not failing:
            break
    return [
        ParameterLaw(name=name, broken=broken, widening=Fraction(needed[name], _PER_TOLERANCE))
        for name, (broken, _) in results.items()
    ]


def _evaluate(
    value: Mapping[str, float], half: Mapping[str, float], *, n: int
) -> dict[str, tuple[str, bool]]:
    """Return, for each law, what disagrees if it is broken, and whether it holds in a box.

    Parameters
    ----------
    half : half the width of the box for each parameter.
    """
    results: dict[str, tuple[str, bool]] = {}
    for name in parameter_names(n):
        results[f"positive.{name}"] = (f"{name} is not positive", value[name] > 0)
    for lesser, greater, reason in parameter_orders(parameter_names(n)):
        holds = value[lesser] - half[lesser] <= value[greater] + half[greater]
        said = (
            f"{lesser} = {value[lesser]:.4g} is above {greater} = {value[greater]:.4g} ({reason})"
        )
        results[f"order.{lesser}.{greater}"] = (said, holds)
    if n not in (2, 3):  # no other number of carts has redundant parameters
        return results
    with np.errstate(all="ignore"):
        found = recover_from_parameters(_corners(value, half, n=n))
        for name, (one, other) in found.routes.items():
            holds = bool((one - other).min() <= 0 <= (one - other).max())
            said = (
                "two ways through the transfer functions to one number give "
                f"{_range(one)} and {_range(other)}"
            )
            results[f"redundancy.{name}"] = (said, holds)
        kappas = {"kappa" if n == 2 else f"kappa_{i}": x for i, x in enumerate(found.couplings, 2)}
        for name, number in {**kappas, "k_1": found.k[0], f"k_{n + 1}": found.k[n]}.items():
            what = "the coupling of two carts" if name in kappas else name
            said = f"the table gives a negative value for {what}"
            results[f"sign.{name}"] = (said, bool(number.max() >= 0))
        for cart in range(1, n):
            omega = np.sqrt(found.stiffness_terms[cart - 1])
            zeta = found.damping_terms[cart - 1] / (2 * omega)
            for name, numbers in ((f"omega_{cart}", omega), (f"zeta_{cart}", zeta)):
                real = numbers[np.isfinite(numbers)]  # omega² may be negative at some corners
                low = float(np.min(real, initial=np.inf))
                high = float(np.max(real, initial=-np.inf))
                holds = low <= value[name] + half[name] and high >= value[name] - half[name]
                text = (
                    f"{name} is {value[name]:.4g}, but the other numbers of this table give "
                    f"{low:.4g} to {high:.4g}"
                )
                results[f"recomputed.{name}"] = (text, holds)
    return results


def _range(numbers: Array) -> str:
    low, high = f"{np.min(numbers):.4g}", f"{np.max(numbers):.4g}"
    return low if low == high else f"{low} to {high}"


def _corners(value: Mapping[str, float], half: Mapping[str, float], *, n: int) -> dict[str, Array]:
    """Return the p independent parameters at every corner of the box, each with shape (2^p,)."""
    own = [f"{symbol}_{cart}" for symbol in ("omega", "zeta") for cart in range(1, n)]
    names = [name for name in parameter_names(n) if name not in own]
    bits = np.arange(2 ** len(names)) >> np.arange(len(names))[:, None] & 1
    signs = 2.0 * bits - 1.0
    return {name: value[name] + half[name] * side for name, side in zip(names, signs, strict=True)}
