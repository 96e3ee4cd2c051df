"""Advise what to record next: what decides between explanations, or shows what they lack.

The advice follows from the verdict, from how the explanations differ, and from the recordings that
are there. If a recording was proposed (`experiments.discriminate`), the advice describes this one.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np

from pipeline.experiments.plan import Recording
from pipeline.gap.limits import CLOSE_ERROR
from pipeline.gap.types import (
    Advice,
    Aim,
    Alternative,
    Change,
    DifferIn,
    EffectAt,
    FoundEffect,
    Gap,
    GapWindow,
    RecordingKind,
    Trace,
    Verdict,
)
from pipeline.plant.effect import AugmentedChain, Effect, Motions
from pipeline.words.numbers import join_names, listing, significant
from pipeline.words.phrases import phrases
from pipeline.words.text import capital

Option = tuple[RecordingKind, Change | None]
Wanted = tuple[int, RecordingKind, Change | None]  # cart, kind, change
Sides = tuple[tuple[EffectAt, ...], ...]

_WORDS = phrases("gap")
MOST_NAMES = 3  # most effects named in a sentence
_TWO_SIZES = 3.0  # motions of one kind whose sizes differ by this factor are small and large ones
_SHARP = 0.05  # a smaller relative standard error needs no further recording
_EDGE, _FLAT = 0.2, 0.01  # changes of the input from sample to sample, as shares of its range

# The recordings that show an effect or a misfit, the most telling first.
_OPTIONS: Mapping[Motions, tuple[Option, ...]] = {
    "small motions": (("decay", "smaller"), ("step", "smaller")),
    "large motions": (("decay", "larger"), ("step", "larger")),
    "both sides": (("step", "both_signs"), ("step", "larger")),
    "about zero": (("step", "smaller"),),
    "slow motions": (("ramp", None),),
    "driven motions": (("decay", None), ("step", None), ("step", "larger")),
    "held carts": (("held", None),),
    "edges": (("step", None), ("step", "finer")),
    "sweeps": (("sweep", None), ("sweep", "faster")),
    "ruler": (("ruler", None),),
}
_BOTH_SIZES = (*_OPTIONS["large motions"], *_OPTIONS["small motions"])
_DRIVEN: frozenset[RecordingKind | None] = frozenset({"step", "ramp", "sweep"})
# The recordings that show more of a misfit, by what the cart does there.
_SHOWING: Mapping[str, tuple[Option, ...]] = {
    "velocity near zero": _OPTIONS["small motions"],
    "fast motion": _OPTIONS["large motions"],
    "large displacement, positive side": _OPTIONS["both sides"],
    "large displacement, negative side": _OPTIONS["both sides"],
    "after an edge of the input": (("step", "larger"), ("step", "finer")),
    "input on": _OPTIONS["driven motions"],
    "input off": _OPTIONS["driven motions"],
}
_AIMS: Mapping[Verdict, Aim] = {
    "none": "extend",
    "named": "check",
    "ambiguous": "decide",
    "partial": "explain",
    "unexplained": "explain",
}


def advised(gap: Gap) -> Gap:
    """Return the gap with the advice that follows from it, also in words."""
    advice = _advise(gap)
    return replace(gap, advice=advice, next_experiment=_in_words(advice, gap) if advice else "")


def differences(one: AugmentedChain, other: AugmentedChain) -> Sides:
    """Return, for each of two models, the effects that the other one lacks."""
    first, second = (
        tuple(EffectAt(effect=term.effect, where=term.where) for term in model.terms)
        for model in (one, other)
    )
    return tuple(e for e in first if e not in second), tuple(e for e in second if e not in first)


def disputed(gap: Gap) -> tuple[FoundEffect, Alternative | None]:
    """Return the chosen effect, and the rival (if any) that the data cannot distinguish from it."""
    close = [
        (rival.confidence, i, found, rival)
        for i, found in enumerate(gap.effects)
        for rival in found.rivals
        if rival.nrmse_after <= CLOSE_ERROR * gap.final
        and rival.effect.grows_from != found.effect.key
    ]
    if not close:
        return gap.effects[-1], None
    _, _, found, rival = max(close, key=lambda entry: entry[:2])
    return found, rival


def side_names(sides: Sides, *, most: int | None = None) -> tuple[str, str]:
    """Return names such as "with backlash" for two models that differ in these effects.

    If the second list is empty, the second model is "without it" or "without them".
    """
    one, other = ([effect.name for effect in side] for side in sides)
    less = _WORDS.text("without_it" if len(one) == 1 else "without_them")
    return f"with {listing(one, most=most)}", f"with {listing(other, most=most)}" if other else less


def proposed_recording(recording: Recording, *, drive: str) -> str:
    """Return a proposed recording as a noun phrase."""
    if recording.release:
        return _WORDS.text("predicted_release", cart=recording.release, note=recording.note)
    end = recording.frequency_end
    return _WORDS.text(
        "predicted_driven" if end is None else "predicted_chirp",
        wave=recording.wave,
        amplitude=f"{recording.amplitude:g}",
        frequency=f"{recording.frequency:g}",
        end=f"{end or 0.0:g}",
        drive=drive,
    )


# ---------------------------------------------------------------------------- the advice


def _advise(gap: Gap) -> Advice | None:
    """Return what to record next; None if nothing would help, or if the set-up comes first."""
    if gap.causes and (gap.verdict in ("none", "named") or not (gap.effects or gap.suspects)):
        return None
    there, prediction = _Recordings(gap), gap.proposal and gap.proposal.prediction
    if gap.proposal and prediction:
        sides = _ordered(differences(*(gap.contenders[i] for i in prediction.pair)))
        one, other = prediction.positions[list(prediction.pair)]
        return Advice(
            aim=_AIMS[gap.verdict],
            between=sides,
            differ_in=_differ_in(sides),
            kind=cast(RecordingKind, gap.proposal.recording.kind),  # a decay, step or sweep
            cart=prediction.cart,
            difference=float(np.abs(one - other).max()),
        )
    match gap.verdict:
        case "named":
            return _sharpen(gap, there) or _check(gap, there)
        case "ambiguous":
            return _decide(gap, there)
        case "none":
            return there.advice(_wanted(_BOTH_SIZES, 1), aim="extend")
        case _:
            window = _window(gap)
            what, cart = (window.what, window.cart) if window else ("", 1)
            wanted = _wanted(_SHOWING.get(what, _BOTH_SIZES), cart)
            return there.advice(wanted, aim="explain")


def _sharpen(gap: Gap, there: "_Recordings") -> Advice | None:
    """Return how to sharpen the parameter with the largest relative standard error."""
    each = [(found, name) for found in gap.effects for name in found.parameters]
    found, parameter = max(each, key=lambda one: _relative_error(*one))
    if _relative_error(found, parameter) <= _SHARP:
        return None
    wanted = there.showing(found)
    return there.advice(wanted, aim="sharpen", between=((_alone(found),),), parameter=parameter)


def _check(gap: Gap, there: "_Recordings") -> Advice | None:
    """Return a recording of a kind that shows an effect and is not there yet."""
    for found in gap.effects:
        wanted = [one for one in there.showing(found) if one[2] not in ("finer", "faster")]
        advice = there.advice(wanted, aim="check", between=((_alone(found),),))
        if advice:
            return advice
    return None


def _decide(gap: Gap, there: "_Recordings") -> Advice | None:
    """Return what decides between the two likeliest explanations."""
    if gap.effects:
        last, rival = disputed(gap)
        sides = (_alone(last),), (() if rival is None else (_alone(rival),))
    else:
        sides = _ordered(differences(*gap.contenders[:2]))
    effects = [effect for side in sides for effect in side]
    differ_in = _differ_in(sides)
    first = {"drive": _OPTIONS["driven motions"][:2], "place": _OPTIONS["held carts"]}
    wanted = _wanted(first.get(differ_in or "", ()), there.cart_of(effects[0]))
    wanted += [one for effect in effects for one in there.showing(effect)]
    return there.advice(wanted, aim="decide", between=sides, differ_in=differ_in)


def _ordered(sides: Sides) -> Sides:
    """Return the two sides, the first of them with effects."""
    return sides if sides[0] else sides[::-1]


def _alone(found: EffectAt) -> EffectAt:
    return EffectAt(effect=found.effect, where=found.where)


def _window(gap: Gap) -> GapWindow | None:
    """Return the worst window in which the cart does something special, or else the worst."""
    return next((one for one in gap.left if one.what in _SHOWING), next(iter(gap.left), None))


def _relative_error(found: FoundEffect, name: str) -> float:
    """Return the standard error of a parameter relative to its distance from its neutral value."""
    (neutral,) = (p.neutral for p in found.effect.parameters if p.name == name)
    value = found.parameters[name]
    return (value.std or 0.0) / max(abs(value.value - (neutral or 0.0)), 1e-300)


def _differ_in(sides: Sides) -> DifferIn | None:
    """Return what distinguishes two effects; None for larger differences between two models."""
    if [len(side) for side in sides] != [1, 1]:
        return None
    one, other = (side[0].effect for side in sides)
    if one.key == other.key:
        return "place"
    if _is_driven(one) != _is_driven(other):
        return "drive"
    if one.shown_by != other.shown_by:
        return "motion"
    return "quantity" if one.axis != other.axis else None


def _is_driven(effect: Effect) -> bool:
    """Return whether an effect changes nothing in free motion."""
    return effect.needs_input or effect.shown_by == "driven motions"


# ---------------------------------------------------------------- the recordings that are there


def _wanted(options: Sequence[Option], cart: int) -> list[Wanted]:
    return [(cart, kind, change) for kind, change in options]


class _Recordings:
    """The recordings that are there, by kind and by how far each cart moves."""

    def __init__(self, gap: Gap) -> None:
        self._n = gap.bench.n
        runs: dict[str, list[Trace]] = defaultdict(list)
        for trace in gap.traces:
            runs[trace.experiment].append(trace)
        rates = np.abs(gap.model.chain.poles) / (2 * np.pi)
        slow = 0.5 * float(min(rates[rates > 0.0], default=0.0))
        # The longest piece with an input represents a recording of several pieces.
        inputs = {
            run: max(pieces, key=lambda one: (bool(one.u.any()), one.t.size))
            for run, pieces in runs.items()
        }
        self._kinds = {run: _kind(trace, slow=slow) for run, trace in inputs.items()}
        self._signs = {run: {*np.sign(trace.u).tolist()} for run, trace in inputs.items()}
        # Repeats show how much runs differ only if they have the same input.
        self._to_repeat = gap.repeatability is None and bool({*self._kinds.values()} & _DRIVEN)
        self._reach: dict[str, dict[int, float]] = {run: {} for run in runs}
        for trace in gap.traces:
            own = self._reach[trace.experiment]
            far = float(np.abs(trace.measured - trace.zero).max())
            own[trace.cart] = max(far, own.get(trace.cart, 0.0))

    def advice(
        self, wanted: Sequence[Wanted], *, aim: Aim, between: Sides = (), **why: Any
    ) -> Advice | None:
        """Return advice to make the first recording of a kind that is not there.

        If all are there, runs may be repeated, or the advice is only what distinguishes two
        explanations. It is None if it would be empty.
        """
        needed = aim in ("decide", "sharpen", "explain")
        if needed and self._n > 1:
            wanted = [*wanted, *_wanted(_OPTIONS["held carts"], wanted[0][0])]
        missing = (one for one in wanted if not self._has(*one))
        cart, kind, change = next(missing, (None, None, None))
        repeat = needed and self._to_repeat and (aim == "explain" or kind is None)
        if kind is None and not repeat and aim not in ("decide", "explain"):
            return None
        if kind in _DRIVEN and not {*self._kinds.values()} & _DRIVEN:
            kind, change = "first_input", None
        sizes = self._sizes(kind, cart) or self._sizes(None, cart)
        reach = {"smaller": min(sizes) / _TWO_SIZES, "larger": max(sizes)} if sizes else {}
        if not sizes and change in ("smaller", "larger"):
            change = None
        return Advice(
            aim=aim,
            between=between,
            kind=kind,
            change=change,
            cart=cart,
            reach=reach.get(change or ""),
            there=tuple(run for run, its in self._kinds.items() if its == kind),
            repeat=repeat,
            **why,
        )

    def showing(self, found: EffectAt) -> list[Wanted]:
        """Return the recordings that show an effect, the most telling first."""
        effect = found.effect
        options = _OPTIONS[effect.shown_by]
        if effect.needs_input and effect.shown_by != "driven motions":
            options = tuple(option for option in options if option[0] != "decay")
        return _wanted(options, self.cart_of(found))

    def cart_of(self, found: EffectAt) -> int:
        """Return the cart whose motion shows an effect: its own, or one beside its spring."""
        return min(next(iter(found.where.values()), 1), self._n)

    def _has(self, cart: int, kind: RecordingKind, change: Change | None) -> bool:
        """Return whether there is a recording that shows the cart in this way."""
        if kind == "held":
            return self._n == 1 or len({frozenset(reach) for reach in self._reach.values()}) > 1
        runs = [run for run, its in self._kinds.items() if its == kind and cart in self._reach[run]]
        match change:
            case None:
                return bool(runs)
            case "smaller" | "larger":
                sizes = self._sizes(kind, cart)
                return bool(sizes) and max(sizes) >= _TWO_SIZES * min(sizes)
            case "both_signs":
                return {s for run in runs for s in self._signs[run]} >= {-1.0, 1.0}
            case "finer" | "faster":  # than all that are there
                return False

    def _sizes(self, kind: RecordingKind | None, cart: int | None) -> list[float]:
        """Return how far a cart moves in each recording of a kind, or of any kind."""
        return [
            reach[cart]
            for run, reach in self._reach.items()
            if cart in reach and kind in (None, self._kinds[run])
        ]


def _kind(trace: Trace, *, slow: float) -> RecordingKind:
    """Return the kind of a recording by its input; a ramp is slower than `slow` Hz."""
    u, extent = trace.u, float(np.ptp(trace.u))
    if not u.any():
        return "decay"
    changes = np.abs(np.diff(u)) / (extent or 1.0)
    if not extent or (changes.max() > _EDGE and np.median(changes) < _FLAT):
        return "step"
    turns = np.count_nonzero(np.diff(np.sign(u - u.mean())))
    return "ramp" if turns < 2 * slow * float(trace.t[-1] - trace.t[0]) else "sweep"


# ------------------------------------------------------------------------------ in words


def _in_words(advice: Advice, gap: Gap) -> str:
    """Return the advice as a few sentences, with one effect in each."""
    units, window = gap.bench.units, _window(gap)
    said = []
    if advice.aim == "explain" and window:
        what = {"throughout": _WORDS.text("throughout")}.get(window.what, window.what)
        said.append(_WORDS.text("most_left", cart=window.cart, run=window.experiment, what=what))
    effects = [effect for side in advice.between for effect in side]
    if advice.parameter:
        (found,) = effects
        parameter = advice.parameter.replace("_", " ")
        said.append(_WORDS.text("unsure", parameter=parameter, name=found.name))
    elif advice.differ_in in ("drive", "quantity"):
        for found in effects:
            key = f"depends_{found.effect.axis}"
            if advice.differ_in == "drive":
                key = "acts_driven" if _is_driven(found.effect) else "acts_free"
            said.append(_WORDS.text(key, Name=capital(found.name)))
    elif advice.difference is None and (advice.aim == "check" or advice.differ_in == "motion"):
        for found in effects:
            run = phrases("effects").text(f"in_{found.effect.shown_by.replace(' ', '_')}")
            said.append(_WORDS.text("shows_most", Name=capital(found.name), run=run))
    two = len(advice.between) == 2
    one, other = side_names(advice.between, most=MOST_NAMES) if two else ("", "")
    if advice.aim == "decide" and advice.difference is None and not said:
        said.append(_WORDS.text("either", one=one, other=other))
    if advice.difference is not None and gap.proposal:
        said.append(
            _WORDS.text(
                "record_proposed",
                recording=proposed_recording(gap.proposal.recording, drive=units.input),
                cart=advice.cart,
                difference=significant(advice.difference, digits=2),
                position=units.position,
                one=one,
                other=other,
            )
        )
    elif advice.kind:
        key = f"record_{advice.kind}" + (f"_{advice.change}" if advice.change else "")
        reach = f"{significant(advice.reach, digits=2)} {units.position}"
        said.append(_WORDS.text(key, cart=advice.cart, reach=reach))
        if advice.change and advice.there:
            said.append(_WORDS.text("recorded", runs=join_names(advice.there)))
    elif not advice.repeat:
        said.append(_WORDS.text("record_none"))
    if advice.repeat:
        said.append(_WORDS.text("repeat_runs"))
    return " ".join(said)
