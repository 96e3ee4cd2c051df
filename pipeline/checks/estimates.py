"""Compare two estimates of one number, and compare decays and steps with their models."""

from collections.abc import Sequence

import numpy as np

from pipeline.checks.decays import say_law
from pipeline.names import read_name
from pipeline.results import (
    Check,
    CheckOutcome,
    Coverage,
    LogDecrement,
    ParameterRow,
    Record,
    StepGain,
    passed,
)
from pipeline.setup import Setup
from pipeline.stages.compare import change_limit
from pipeline.words.numbers import join_names, listing, significant
from pipeline.words.phrases import phrases

_WORDS = phrases("checks")


def check_rows(rows: Sequence[ParameterRow]) -> list[Check]:
    """Check that two estimates of each parameter agree.

    Estimates that are too uncertain to compare are skipped.
    """
    verdicts: dict[bool | None, tuple[CheckOutcome, str]] = {
        True: ("pass", "agree"),
        False: ("fail", "disagree"),
        None: ("skip", "are too uncertain to compare"),
    }
    checks = []
    for row in rows:
        if row.change_percent is None or (row.consistent is None and row.change_sigmas is None):
            continue
        limit = change_limit(row.name)
        outcome, verdict = verdicts[row.consistent]
        sigmas = (
            "" if row.change_sigmas is None else f", or {row.change_sigmas:.1f} standard errors"
        )
        advice = _advice(row) if outcome == "fail" else ""
        same = "" if row.independent is not False else " Both use the same recordings."
        checks.append(
            Check(
                kind="initial_final",
                parameter=row.name,
                outcome=outcome,
                value=abs(row.change_percent),
                limit=limit,
                message=f"Initial and final {row.name} {verdict} (limit {limit:.0f} %): the "
                f"difference is {row.change_percent:+.1f} %{sigmas}.{same}{advice}",
            )
        )
    return checks


def check_coverage(rows: Sequence[ParameterRow]) -> list[Check]:
    """Check that a measurement determines every resonance and null that is claimed."""
    checks = []
    for row in rows:
        near = row.final.coverage if row.final else None
        if near is None or near.of != row.name:
            continue
        found = sorted({w for w in (near.below, near.above) if w is not None})
        nearest = found[int(np.argmin(np.abs(np.array(found) - near.omega)))] if found else 0.0
        key = f"determined_by_{row.determined_by}"
        message = _WORDS.text(
            key if found else "extrapolated_from_nothing",
            name=row.name,
            zeta=read_name(row.name).damping,
            omega=significant(near.omega, digits=3),
            near=listing([significant(w, digits=3) for w in found]),
            nearest=significant(nearest, digits=3),
            wanted=wanted_dwells(near),
        )
        checks.append(
            Check(
                kind="covered",
                parameter=row.name,
                outcome=passed(not row.extrapolated),
                value=near.distance,
                limit=near.limit,
                message=message,
            )
        )
    return checks


def wanted_dwells(coverage: Coverage) -> str:
    """Return the frequencies of dwells that would determine a resonance or null, in words."""
    # Without damping in the fit, 2 % on both sides.
    apart = max(coverage.half_width, 0.02 * coverage.omega)
    omegas = [coverage.omega + side * apart for side in (-1, 0, 1)]
    by_unit = [
        listing([significant(omega / scale, digits=3) for omega in omegas])
        for scale in (1.0, 2 * np.pi)
    ]
    return f"{by_unit[0]} rad/s ({by_unit[1]} Hz)"


def _advice(row: ParameterRow) -> str:
    """Return advice on where to look in the recordings that the two estimates use."""
    name, before, after = read_name(row.name), row.initial, row.final
    assert before is not None
    assert after is not None
    if before.value * after.value < 0:
        return " Their signs differ: is the sign of the input in submission.toml right?"
    response = after.source == "bode_fit"
    if name.is_ratio:
        seen = (
            "a steady sine of amplitude A gives ζ + 2d/(πA)"
            if response
            else "it raises them more for small swings"
        )
        return (
            f" Dry friction makes damping ratios differ: {seen}. Check which of the two methods "
            "used the larger amplitude."
        )
    looks = {
        "step": "the rest and settled levels of {runs}",
        "log_decrement": "the peaks of {runs}",
        "frequency_response": "the points near this frequency",
    }
    if name.is_gain:
        looks["frequency_response"] = "the points at the lowest frequencies"
    look = looks.get(before.source, "{runs}").format(runs=join_names(before.experiments))
    beside = (
        ", and at the points of the response near this frequency"
        if response and name.is_frequency
        else ""
    )
    lowest = ", and at the lowest frequencies" if response and before.source == "step" else ""
    return f" Look at {look}{beside}{lowest}."


def check_decays(
    decays: Sequence[LogDecrement], *, records: Sequence[Record] = (), bench: Setup
) -> list[Check]:
    """Check for every decay whether it is exponential within the noise."""
    checks, kinds = [], {record.id: record.kind for record in records}
    for decay in decays:
        what = f"the decay of cart {decay.cart}"
        if kinds.get(decay.experiment) == "step":
            what = f"the ringing of cart {decay.cart} after the step"
        said = say_law(decay, unit=bench.units.position)
        checks.append(
            Check(
                kind="decay",
                run=decay.experiment,
                cart=decay.cart,
                part=str(decay.number or ""),
                outcome="skip" if decay.law.is_untested else passed(decay.law.is_exponential),
                value=decay.law.statistic,
                limit=decay.law.limit,
                message=f"{decay.name}: {what} {said}",
            )
        )
    return checks


def check_steps(
    steps: Sequence[StepGain], *, decays: Sequence[LogDecrement] = (), bench: Setup
) -> list[Check]:
    """Check whether every step has one static gain, or only an interval because the cart sticks.

    If friction makes the cart stop equally short on the way out and back, all edges agree on a
    wrong gain. So the check passes only if several edges agree and nothing shows dry friction on
    that cart.
    """
    rubs: dict[int, list[str]] = {}
    for decay in decays:
        if decay.law.is_friction:
            rubs.setdefault(decay.cart, []).append(decay.experiment)
    for step in steps:
        if step.interval:
            rubs.setdefault(step.cart, []).append(step.experiment)
    return [_step_check(step, shown=rubs.get(step.cart, ()), bench=bench) for step in steps]


def _step_check(step: StepGain, *, shown: Sequence[str], bench: Setup) -> Check:
    outcome: CheckOutcome
    edges, width = len(step.edges), None
    if step.interval:
        low, high = step.interval
        width = high - low
        outcome, found = (
            "fail",
            (  # the shift of the rest points gives the least friction that can hold the cart
                f"sticks: its rest positions give static gains from {low:.4g} to {high:.4g} "
                f"{bench.units.gain}, but the true gain may be outside this range."
            ),
        )
    elif shown:
        runs = join_names(list(dict.fromkeys(shown)))
        outcome, found = (
            "skip",
            (
                f"has the same gain at every edge, but shows dry friction in {runs}. Friction may "
                "stop it short of its level here too, by the same distance at every edge."
            ),
        )
    elif edges < 2:
        outcome, found = (
            "skip",
            (
                "settles after one edge of the input only, so it is unknown whether friction holds "
                "it off its level. A step on and off again would show it."
            ),
        )
    else:
        back = "" if step.rest_shift is None else " and returns to its initial rest position"
        all_edges = "both edges" if edges == 2 else f"all {edges} edges"
        outcome, found = "pass", f"has the same gain at {all_edges} of the input{back}."
    return Check(
        kind="step",
        run=step.experiment,
        cart=step.cart,
        outcome=outcome,
        value=width,
        limit=None,
        message=f"{step.experiment}: cart {step.cart} {found}",
    )
