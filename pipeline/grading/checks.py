"""The checks of a rubric: each gives a share of the points, and says why."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from pipeline.grading import rubric as asked
from pipeline.grading.controller import Controller
from pipeline.grading.laws import judge_laws
from pipeline.grading.pieces import asked_pieces, missing_pieces
from pipeline.grading.reference import Reference, References
from pipeline.grading.rubric import Rubric, is_damping, matching
from pipeline.grading.state_model import compare_entries
from pipeline.grading.tolerance import credit, exact, percent_off
from pipeline.plant.chain import Array
from pipeline.results import Analysis
from pipeline.submission import Reported, Submission

_ALL, _NONE = Fraction(1), Fraction(0)
_NAMED = 4  # so many are named in a message


@dataclass(frozen=True, kw_only=True)
class Work:
    """All that a check may look at.

    Attributes
    ----------
    state_models : what [A B] may rightly be.
    bad : runs that do not hold what they should, each with what is wrong.
    """

    submission: Submission
    analysis: Analysis
    rubric: Rubric
    references: References
    controller: Controller | None
    state_models: Sequence[Array]
    bad: Mapping[str, str]

    @property
    def reported(self) -> Reported:
        """What the students claim; empty where they claim nothing."""
        return self.submission.reported or Reported()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The share of the points; None where nothing could be judged, and `message` says why."""

    share: Fraction | None
    message: str
    expected: dict[str, Any] = field(default_factory=dict)
    found: dict[str, Any] = field(default_factory=dict)


def judge(criterion: asked.Criterion, work: Work) -> Verdict:
    """Judge one criterion on its own; what it requires is seen to elsewhere."""
    match criterion:
        case asked.RequiredPieces():
            return _required(work)
        case asked.DataQuality():
            return _data(work)
        case asked.Parameters():
            return _parameters(criterion, work)
        case asked.InitialFinal():
            return _initial_final(criterion, work)
        case asked.Laws():
            return _laws(criterion, work)
        case asked.StateModel():
            return _state_space(criterion, work)
        case asked.Gains():
            return _gains(criterion, work)
        case asked.Claims():
            return _claims(criterion, work)
        case asked.Prefilter():
            return _prefilter(criterion, work)
        case asked.Hardware():
            return _hardware(criterion, work)


def _mean(shares: Sequence[Fraction]) -> Fraction:
    return sum(shares, _NONE) / len(shares)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


# ------------------------------------------------------------------- pieces and data


def _required(work: Work) -> Verdict:
    pieces, missing = asked_pieces(work.rubric), missing_pieces(work.submission, work.rubric)
    if not pieces:
        return Verdict(share=_ALL, message="Nothing in particular was asked for.")
    return Verdict(
        share=_ALL - Fraction(len(missing), len(pieces)),
        message=f"Missing: {_listed(missing)}." if missing else "All that was asked for is here.",
        expected={"pieces": pieces},
        found={"missing": missing},
    )


def _data(work: Work) -> Verdict:
    runs = len(work.submission.experiments)
    bad = work.bad
    return Verdict(
        share=_ALL - Fraction(min(len(bad), runs), runs) if runs else _NONE,
        message="; ".join(f"{run}: {why.rstrip('.')}" for run, why in list(bad.items())[:_NAMED])
        + "."
        if bad
        else "The recordings hold what they should.",
        found={"problems": dict(bad)},
    )


# ------------------------------------------------------------------------ parameters


def _parameters(criterion: asked.Parameters, work: Work) -> Verdict:
    """Reported against recomputed; a parameter that is not reported earns nothing."""
    table: Mapping[str, Decimal] = getattr(work.reported, criterion.check)
    known: Mapping[str, Reference] = getattr(work.references, criterion.check)
    names = matching(criterion.parameters, work.rubric.names)
    judged = [n for n in names if n in known or (n in table and table[n] <= 0)]
    guessed = [n for n in names if n not in known and n not in judged]
    if not judged:
        reasons = [s.reason for s in work.analysis.skipped]
        why = reasons[0] if reasons else "these are first guesses, and no recording decides them"
        return Verdict(share=None, message=f"Not checked: {why}.")
    shares, off = [], []
    for name in judged:
        if name not in table:
            shares.append(_NONE)
            off.append(f"{name} is not reported")
            continue
        error = (
            percent_off(table[name], known[name], sigmas=criterion.sigmas)
            if name in known
            else Fraction(10**6)
        )
        shares.append(_credit(error, name, criterion))
        if shares[-1] < 1:
            there = f", your recordings give {known[name].value:.4g}" if name in known else ""
            off.append(f"{name}: you report {table[name]}{there}")
    left = f" Not judged: {_listed(guessed)}." if guessed and criterion.check == "final" else ""
    message = f"{'; '.join(off[:_NAMED])}." if off else "As your own recordings say."
    return Verdict(
        share=_mean(shares),
        message=message + left,
        expected={n: known[n].value for n in judged if n in known},
        found={n: float(table[n]) for n in judged if n in table},
    )


def _credit(error: Fraction, name: str, limits: asked.Parameters | asked.InitialFinal) -> Fraction:
    if is_damping(name):
        full, none = limits.damping_full_percent, limits.damping_none_percent
    else:
        full, none = limits.full_percent, limits.none_percent
    return credit(error, full=full, none=none)


def _initial_final(criterion: asked.InitialFinal, work: Work) -> Verdict:
    """The two tables against each other, rounding of both off; guessed dampings are left out."""
    initial, final = work.reported.initial, work.reported.final
    names = matching(criterion.parameters, work.rubric.names)
    both = [
        n
        for n in names
        if n in initial and n in final and not (is_damping(n) and n not in work.references.initial)
    ]
    if not both:
        return Verdict(share=None, message="Not checked: no parameter is in both tables.")
    shares, apart = [], []
    for name in both:
        shares.append(_credit(between(initial[name], final[name]), name, criterion))
        if shares[-1] < 1:
            apart.append(f"{name}: first {initial[name]}, then {final[name]}")
    return Verdict(
        share=_mean(shares),
        message=f"{'; '.join(apart[:_NAMED])}." if apart else "Both estimates agree.",
        expected={n: float(initial[n]) for n in both},
        found={n: float(final[n]) for n in both},
    )


def between(initial: Decimal, final: Decimal) -> Fraction:
    """Return how far two typed numbers are apart, in percent, half the last digit of each off."""
    value = float(initial)
    point = Reference(value=value, low=value, high=value, std=0.0, source="initial")
    # The wider rounding of the two would count for both: take each once.
    from pipeline.grading.tolerance import half_digit

    widened = Reference(
        value=value, low=value, high=value, std=float(half_digit(initial)), source="initial"
    )
    return percent_off(final, widened if value > 0 else point, sigmas=1.0)


def _laws(criterion: asked.Laws, work: Work) -> Verdict:
    laws = judge_laws(
        work.reported.final,
        n=work.rubric.system.carts,
        frequency_percent=criterion.frequency_percent,
        damping_percent=criterion.damping_percent,
    )
    if laws is None:
        return Verdict(share=None, message="Not checked: the final table is not complete.")
    shares = [_ALL if law.within_rounding else Fraction(law.within_tolerance, 2) for law in laws]
    broken = [law for law in laws if not law.within_rounding]
    return Verdict(
        share=_mean(shares),
        message="; ".join(f"{law.name} fails ({law.meaning})" for law in broken[:_NAMED]) + "."
        if broken
        else f"All {len(laws)} laws hold within the rounding.",
        expected={"laws": [law.name for law in laws]},
        found={"broken": [law.name for law in broken]},
    )


# ------------------------------------------------------------- state model and controller


def _state_space(criterion: asked.StateModel, work: Work) -> Verdict:
    space = work.reported.state_space
    if space is None or not (space.A and space.B):
        return Verdict(share=_NONE, message="A and B are not both reported.")
    entries = compare_entries(space, models=work.state_models, n=work.rubric.system.carts)
    if not entries:
        return Verdict(
            share=None, message="Not checked: neither a table nor a fit to compare with."
        )
    shares = []
    for entry in entries:
        damping = entry.kind == "damping"
        shares.append(
            credit(
                entry.error,
                full=criterion.damping_full_percent if damping else criterion.full_percent,
                none=criterion.damping_none_percent if damping else criterion.none_percent,
            )
        )
    # The noughts and ones are given away; a wrong one among them costs as a wrong number does.
    counted = [
        share
        for share, entry in zip(shares, entries, strict=True)
        if entry.kind != "exact" or share < 1
    ]
    off = [e for e, share in zip(entries, shares, strict=True) if share < 1]
    return Verdict(
        share=_mean(counted),
        message="; ".join(f"{e.name} = {e.typed}, expected {e.right[0]:.4g}" for e in off[:_NAMED])
        + "."
        if off
        else "A and B follow from the table.",
        expected={e.name: e.right[0] for e in entries if e.kind != "exact" or e in off},
        found={e.name: float(e.typed) for e in entries if e.kind != "exact" or e in off},
    )


def _needs_gains(work: Work) -> Verdict | None:
    feedback = work.reported.feedback
    if feedback is None or not feedback.gains:
        return Verdict(share=_NONE, message="No gains are reported.")
    if work.controller is None:
        return Verdict(share=None, message="Not checked: the carts are not identified.")
    return None


def _gains(criterion: asked.Gains, work: Work) -> Verdict:
    if (missing := _needs_gains(work)) is not None:
        return missing
    assert work.controller is not None
    assert work.controller.gains is not None
    goal = work.controller.goal
    best, found = _NONE, {}
    for numbers in work.controller.numbers(work.controller.gains):
        share = _NONE
        if numbers.stable and numbers.settling_time is not None:
            over = Fraction(max(numbers.overshoot - goal.overshoot_percent, 0.0))
            late = Fraction(100 * max(numbers.settling_time / goal.settling_time - 1, 0.0))
            share = min(
                credit(over, full=criterion.overshoot_full, none=criterion.overshoot_none),
                credit(
                    late,
                    full=criterion.settling_full_percent,
                    none=criterion.settling_none_percent,
                ),
            )
        if not found or share > best:
            best = share
            found = {
                "stable": numbers.stable,
                "overshoot_percent": numbers.overshoot if np.isfinite(numbers.overshoot) else None,
                "settling_time": numbers.settling_time,
                "poles": [[p.real, p.imag] for p in numbers.poles],
            }
    if not found:
        return Verdict(share=_NONE, message="These gains cannot be simulated.")
    overshoot, settling = found["overshoot_percent"], found["settling_time"]
    does = (
        "the loop is unstable"
        if not found["stable"]
        else f"overshoot {overshoot:.3g} %, "
        + (f"settling in {settling:.3g} s" if settling is not None else "no settling in sight")
    )
    return Verdict(
        share=best,
        message=f"On your carts: {does}; the goal is {goal.overshoot_percent:g} % and "
        f"{goal.settling_time:g} s.",
        expected={
            "overshoot_percent": goal.overshoot_percent,
            "settling_time": goal.settling_time,
        },
        found=found,
    )


def _claims(criterion: asked.Claims, work: Work) -> Verdict:
    if (missing := _needs_gains(work)) is not None:
        return missing
    assert work.controller is not None
    assert work.controller.gains is not None
    controller = work.controller
    claims = {"overshoot_percent": controller.overshoot, "settling_time": controller.settling}
    best, expected = None, {}
    for numbers in controller.numbers(controller.gains):
        shares = [_NONE, _NONE]
        if controller.overshoot is not None and np.isfinite(numbers.overshoot):
            off = abs(Fraction(controller.overshoot) - Fraction(numbers.overshoot))
            shares[0] = credit(off, full=criterion.overshoot_full, none=criterion.overshoot_none)
        if controller.settling is not None and numbers.settling_time is not None:
            point = numbers.settling_time
            reference = Reference(value=point, low=point, high=point, std=0.0, source="")
            shares[1] = credit(
                percent_off(controller.settling, reference, sigmas=0.0),
                full=criterion.settling_full_percent,
                none=criterion.settling_none_percent,
            )
        if best is None or _mean(shares) > best:
            best = _mean(shares)
            expected = {
                "overshoot_percent": numbers.overshoot if np.isfinite(numbers.overshoot) else None,
                "settling_time": numbers.settling_time,
            }
    return Verdict(
        share=best if best is not None else _NONE,
        message="What the gains give."
        if best == 1
        else "Simulated on your carts these gains give "
        + ", ".join(f"{k} {v:.3g}" for k, v in expected.items() if v is not None)
        + ".",
        expected=expected,
        found={name: float(v) for name, v in claims.items() if v is not None},
    )


def _prefilter(criterion: asked.Prefilter, work: Work) -> Verdict:
    if (missing := _needs_gains(work)) is not None:
        return missing
    assert work.controller is not None
    assert work.controller.gains is not None
    typed = work.controller.prefilter
    if typed is None:
        return Verdict(share=_NONE, message="No prefilter is reported.")
    best, right = _NONE, None
    for numbers in work.controller.numbers(work.controller.gains):
        size = abs(numbers.prefilter)
        reference = Reference(value=size, low=size, high=size, std=0.0, source="")
        signed = typed if numbers.prefilter > 0 else -typed
        error = percent_off(signed, reference, sigmas=0.0)
        share = credit(error, full=criterion.full_percent, none=criterion.none_percent)
        if right is None or share > best:
            best, right = share, numbers.prefilter
    if right is None:
        return Verdict(share=_NONE, message="These gains cannot be simulated.")
    return Verdict(
        share=best,
        message="One over the static gain of the loop, as it should be."
        if best == 1
        else f"These gains need {right:.4g}, you report {typed}.",
        expected={"prefilter": right},
        found={"prefilter": float(typed)},
    )


def _hardware(criterion: asked.Hardware, work: Work) -> Verdict:
    """The closed loop that ran, simulated; the best of several runs counts."""
    runs = {e.id for e in work.submission.experiments if e.kind == "closed_loop"}
    if not runs:
        return Verdict(share=_NONE, message="No closed-loop run was handed in.")
    closed: dict[str, list[float]] = {}
    for check in work.analysis.hardware:
        if check.experiment in runs and check.loop == "closed":
            closed.setdefault(check.experiment, []).append(check.nrmse)
    if not closed:
        reasons = [s.reason for s in work.analysis.skipped if s.stage.startswith("hardware")]
        why = reasons[0] if reasons else "the controller that ran is not stated"
        return Verdict(share=_NONE, message=f"The loop cannot be compared: {why}.")
    errors = {run: 100 * float(np.sqrt(np.mean(np.square(e)))) for run, e in closed.items()}
    run = min(errors, key=lambda name: errors[name])
    error = exact(errors[run])
    return Verdict(
        share=credit(error, full=criterion.full_percent, none=criterion.none_percent),
        message=f"{run}: model and measurement differ by {errors[run]:.3g} % of the motion.",
        expected={"nrmse_percent": criterion.full_percent},
        found={"nrmse_percent": errors[run]},
    )
