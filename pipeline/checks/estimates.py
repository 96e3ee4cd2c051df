"""Checks of single estimates: two ways to one number; decays and steps against their models."""

from collections.abc import Sequence

from pipeline.names import read_name
from pipeline.results import Check, CheckOutcome, LogDecrement, ParameterRow, StepGain
from pipeline.stages.compare import change_limit


def check_rows(rows: Sequence[ParameterRow]) -> list[Check]:
    """Judge every parameter that was measured in two ways; a wide error is no agreement."""
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
        sigmas = "" if row.change_sigmas is None else f", {row.change_sigmas:.1f} standard errors"
        advice = _advice(row) if outcome == "fail" else ""
        checks.append(
            Check(
                id=f"initial_final.{row.name}",
                outcome=outcome,
                value=abs(row.change_percent),
                limit=limit,
                message=f"Initial and final {row.name} {verdict}: "
                f"{row.change_percent:+.1f} %{sigmas} (limit {limit:.0f} %).{advice}",
            )
        )
    return checks


def _advice(row: ParameterRow) -> str:
    name = read_name(row.name)
    if row.initial and row.final and row.initial.value * row.final.value < 0:
        return " Their signs differ: is the sign of the input in submission.toml right?"
    if name.is_ratio:
        return (
            " Damping ratios differ where dry friction is at work: a dwell of amplitude A sees "
            "ζ + 2d/(πA), so ask which of the two methods saw the larger amplitude."
        )
    if name.is_gain:
        return " Look at the rest and settled levels of the steps, and at the lowest frequencies."
    return " Look at the peaks of the decay and at the dwells near this frequency."


def check_decays(decays: Sequence[LogDecrement], *, position_unit: str) -> list[Check]:
    """Ask of every decay whether viscous damping alone explains it."""
    checks = []
    for decay in decays:
        if (test := decay.friction) is None:
            continue
        found = (
            "is not exponential: dry friction can hold the cart within "
            f"±{test.drop:.3g} {position_unit} of its rest. The envelope's ζ = {decay.zeta:.3g} is "
            f"biased; ζ = {test.zeta:.3g} once friction is taken out."
            if test.present
            else "is as exponential as its noise lets one see "
            f"(F = {test.f_statistic:.1f}, dry friction from {test.threshold:.1f} on)."
        )
        checks.append(
            Check.of(
                f"decay.{decay.experiment}.cart_{decay.cart}",
                not test.present,
                f"{decay.experiment}: the decay of cart {decay.cart} {found}",
                value=test.f_statistic,
                limit=test.threshold,
            )
        )
    return checks


def check_steps(steps: Sequence[StepGain], *, gain_unit: str) -> list[Check]:
    """Ask whether every step has one gain: a cart that sticks has at least an interval of them."""
    checks = []
    for step in steps:
        found, width = "settles where its springs put it.", None
        if step.interval:
            low, high = step.interval
            width = high - low
            found = (  # the rest points show the least that friction can hold, not the most
                f"sticks: its rest points put the static gain between {low:.4g} and {high:.4g} "
                f"{gain_unit}, and it may be farther off."
            )
        name = f"step.{step.experiment}.cart_{step.cart}"
        message = f"{step.experiment}: cart {step.cart} {found}"
        checks.append(Check.of(name, step.interval is None, message, value=width))
    return checks
