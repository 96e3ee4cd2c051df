"""The checks of the closed loop: gains, claims, prefilter, hardware."""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from pipeline.grading import limits
from pipeline.grading import rubric as asked
from pipeline.grading.judge.context import GradingContext, Verdict
from pipeline.grading.mistakes.controller import Controller, LoopNumbers, does, same_gains
from pipeline.grading.mistakes.state_model import order_names
from pipeline.grading.reference import OFF_SCALE, Reference, clock_units, off_scale
from pipeline.grading.tolerance import (
    ALL,
    NO_CREDIT,
    NONE,
    Deviation,
    as_typed,
    exact,
    percent_off,
    points_for,
    points_for_one,
    rounding,
)
from pipeline.grading.words import WORDS
from pipeline.results import Stage
from pipeline.words.text import sentence


@dataclass(frozen=True, kw_only=True)
class _Best:
    """The simulated response that earns the most points of all models, and its share of the points.

    Attributes
    ----------
    models : for each model, the errors of the response.
    """

    share: Fraction
    numbers: LoopNumbers
    models: tuple[tuple[Deviation, ...], ...]


def _controller(
    criterion: asked.Gains | asked.Claims | asked.Prefilter, context: GradingContext
) -> Controller | Verdict:
    """Return the controller with the models that count, or a verdict without them."""
    feedback = context.reported.feedback
    if feedback is None or not feedback.gains:
        why = context.because_unread("feedback", "gains")
        return Verdict(share=NONE, message=f"No gains are reported.{why}")
    if context.controller is None or context.controller.gains is None:
        return Verdict(share=None, message="Not checked: the carts were not identified.")
    source = asked.source_of(criterion)
    controller = context.controller.judged_from(source)
    if not controller.models:
        own = "your final table is not complete, so it gives no model"
        why = own if source == "own" else "the carts were not identified"
        return Verdict(share=None, message=f"Not checked: {why}.")
    return controller


def _best(
    criterion: asked.Criterion,
    controller: Controller,
    errors: Callable[[LoopNumbers], tuple[Deviation, ...]],
) -> _Best | Verdict:
    """Simulate the gains on each model; without a result, a verdict says why."""
    assert controller.gains is not None
    every = controller.numbers(controller.gains)
    if not every:
        return Verdict(share=NONE, message="These gains cannot be simulated.")
    models = tuple(map(errors, every))
    shares = [points_for(criterion, model) for model in models]
    share, numbers = max(zip(shares, every, strict=True), key=lambda one: one[0])
    return _Best(share=share, numbers=numbers, models=models)


def judge_gains(criterion: asked.Gains, context: GradingContext) -> Verdict:
    """Judge the gains by simulation against the design goal.

    If several models are acceptable, the one with the best result counts.
    """
    controller = _controller(criterion, context)
    if isinstance(controller, Verdict):
        return controller
    goal = controller.goal

    def errors(numbers: LoopNumbers) -> tuple[Deviation, ...]:
        if not numbers.stable or numbers.settling_time is None:
            return (Deviation(error=NO_CREDIT, by="settling"),)
        over = Fraction(max(numbers.overshoot - goal.overshoot_percent, 0.0))
        late = Fraction(100 * max(numbers.settling_time / goal.settling_time - 1, 0.0))
        return Deviation(error=over, by="overshoot"), Deviation(error=late, by="settling")

    best = _best(criterion, controller, errors)
    if isinstance(best, Verdict):
        return best
    numbers, most, only_on_paper, ordered = best.numbers, ALL, "", ""
    if context.gains_order:
        said = WORDS.text("other_order_of_gains", order=order_names(context.gains_order))
        ordered = f" {said}"
    assert controller.gains is not None
    if runaway := controller.runaway(controller.gains):
        if numbers.stable:
            only_on_paper = f" {WORDS.text('only_on_paper', does=does(numbers))}"
        most, numbers = limits.KEPT_IF_HARMFUL, runaway
    return Verdict(
        share=min(best.share, most),
        models=best.models,
        most=most,
        message=f"On your carts: {does(numbers)}; the goal is {goal.overshoot_percent:g} % and "
        f"{goal.settling_time:g} s.{only_on_paper}{ordered}",
        expected={
            "overshoot_percent": goal.overshoot_percent,
            "settling_time": goal.settling_time,
        },
        found={
            "stable": numbers.stable,
            **_claimable(numbers),
            "poles": [[p.real, p.imag] for p in numbers.poles],
        },
        agrees={"gains": min(best.share, most) == 1},
    )


def _claimable(numbers: LoopNumbers) -> dict[str, float | None]:
    overshoot = numbers.overshoot if np.isfinite(numbers.overshoot) else None
    return {"overshoot_percent": overshoot, "settling_time": numbers.settling_time}


def judge_claims(criterion: asked.Claims, context: GradingContext) -> Verdict:
    """Judge the reported overshoot and settling time by a simulation with the reported gains."""
    controller = _controller(criterion, context)
    if isinstance(controller, Verdict):
        return controller
    claims = {"overshoot_percent": controller.overshoot, "settling_time": controller.settling}

    def errors(numbers: LoopNumbers) -> tuple[Deviation, ...]:
        over = late = NO_CREDIT
        if controller.overshoot is not None and np.isfinite(numbers.overshoot):
            off = abs(Fraction(controller.overshoot) - Fraction(numbers.overshoot))
            over = max(off - rounding(controller.overshoot), Fraction(0))
        if controller.settling is not None and numbers.settling_time is not None:
            right = Reference.at(numbers.settling_time)
            late = percent_off(controller.settling, right, sigmas=0.0)
        return Deviation(error=over, by="overshoot"), Deviation(error=late, by="settling")

    best = _best(criterion, controller, errors)
    if isinstance(best, Verdict):
        return best
    share, expected = best.share, _claimable(best.numbers)
    unread = "".join(context.because_unread("feedback", name) for name in claims)
    return Verdict(
        share=share,
        models=best.models,
        message="The reported numbers match the gains."
        if share == 1
        else f"Simulated on your carts with these gains: {does(best.numbers)}.{unread}",
        expected=expected,
        found={name: float(v) for name, v in claims.items() if v is not None},
        agrees={
            name: points_for_one(criterion, off) == 1
            for (name, claim), off in zip(claims.items(), errors(best.numbers), strict=True)
            if claim is not None
        },
    )


def judge_prefilter(criterion: asked.Prefilter, context: GradingContext) -> Verdict:
    """Judge the prefilter against the reciprocal of the loop's static gain."""
    controller = _controller(criterion, context)
    if isinstance(controller, Verdict):
        return controller
    typed = controller.prefilter
    if typed is None:
        why = context.because_unread("feedback", "prefilter")
        return Verdict(share=NONE, message=f"No prefilter is reported.{why}")

    def errors(numbers: LoopNumbers) -> tuple[Deviation, ...]:
        signed = typed if numbers.prefilter > 0 else -typed
        right = Reference.at(abs(numbers.prefilter))
        return (Deviation(error=percent_off(signed, right, sigmas=0.0)),)

    best = _best(criterion, controller, errors)
    if isinstance(best, Verdict):
        return best
    share, right = best.share, best.numbers.prefilter
    return Verdict(
        share=share,
        models=best.models,
        message="The prefilter is the reciprocal of the loop's static gain, as it should be."
        if share == 1
        else f"These gains need {right:.4g}, you report {as_typed(typed)}.",
        expected={"prefilter": right},
        found={"prefilter": float(typed)},
        agrees={"prefilter": share == 1},
    )


def judge_hardware(criterion: asked.Hardware, context: GradingContext) -> Verdict:
    """Judge the recorded closed loop against its simulation.

    The run with the best result counts.
    """
    runs = {e.id for e in context.submission.experiments if e.kind == "closed_loop"}
    if not runs:
        return Verdict(share=NONE, message="No closed-loop recording was submitted.")
    if off_scale(context.analysis) or clock_units(context.analysis) != 1.0:
        return Verdict(share=None, message=f"Not checked: {OFF_SCALE}.")
    closed: dict[str, list[float]] = {}
    for check in context.analysis.hardware:
        if check.experiment in runs and check.loop == "closed":
            closed.setdefault(check.experiment, []).append(check.nrmse)
    if not closed:
        skipped = context.analysis.skipped
        reasons = [one.reason for one in skipped if one.stage is Stage.HARDWARE_CHECK]
        why = reasons[0] if reasons else "the controller that ran or its gains are not stated"
        fit = context.analysis.fit
        if fit is None or not fit.converged:  # this proves nothing about the loop
            return Verdict(share=None, message=f"Not checked: {sentence(why)}")
        return Verdict(share=NONE, message=f"The loop cannot be compared: {sentence(why)}")
    errors = {run: 100 * float(np.sqrt(np.mean(np.square(e)))) for run, e in closed.items()}
    run = min(errors, key=lambda name: errors[name])
    deviation = Deviation(error=exact(errors[run]))
    return Verdict(
        share=points_for(criterion, [deviation]),
        models=((deviation,),),
        message=f"{run}: model and measurement differ by {errors[run]:.3g} % of the motion."
        + (
            " The gains used in the recording are not the reported ones."
            if _others_ran(context)
            else ""
        ),
        expected={"nrmse_percent": criterion.full_percent},
        found={"nrmse_percent": errors[run]},
    )


def _others_ran(context: GradingContext) -> bool:
    controller = context.controller
    if controller is None or controller.ran is None or controller.gains is None:
        return False
    return not same_gains(controller.ran, controller.gains)
