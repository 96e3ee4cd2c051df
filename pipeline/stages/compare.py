"""Compare: initial against final estimates, and the laws a real chain of carts obeys.

Nearly every parameter is estimated in two ways (Throne 2005, Tables 1-3): frequencies and gains
usually agree within some percent, damping ratios often do not.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from pipeline.plant.chain import Chain, parameter_unit, recover_from_parameters
from pipeline.results import (
    ChainFit,
    Check,
    Estimate,
    HardwareCheck,
    LogDecrement,
    Outcome,
    ParameterRow,
    Record,
    SinePoint,
    StepGain,
)

# The paper's own tables: gains and frequencies change by up to 14 % between the two estimates
# (one null, read off by eye, by 29 %), damping ratios by half and more.
GAIN_AND_FREQUENCY_LIMIT = 15.0  # percent
DAMPING_LIMIT = 50.0  # percent
SIGMA_LIMIT = 3.0  # combined standard errors: below, a difference may be chance
_UNDECIDED = "the two estimates are too uncertain to agree or to disagree"
REDUNDANCY_LIMIT = 1e-9  # two routes to one number through unrounded values
CHI_SQUARE_LIMIT = 2.0  # by chance under 1.5 with 30 points and more; errors of 40 % give 2
HELD_SHARE = 0.2  # of a held cart's swing: a free one that moves less is not the free one
AT_BOUND = (
    "the fit ends at its bound, zero: its data are too few to tell, so there is no final value"
)
NOT_DETERMINED = (
    "not determined: the standard error is {percent:.0f} % of the value, more than the "
    "{limit:.0f} % that initial and final may differ by"
)
_ONE_SOURCE = "the fit's own points do not tell it: the final value rests on the decay as well"
_DWELL_LIMIT = 0.1  # relative: a dwell stated so far off is another one
_DWELL_FACTORS = {
    2 * np.pi: "the stated ones look to be in rad/s, and `frequency` is in Hz",
    1 / (2 * np.pi): "the stated ones look to be divided by 2π",
    1e3: "the time columns look to be in milliseconds; head them `time [ms]`",
    1e6: "the time columns look to be in microseconds; head them `time [us]`",
}
_DWELLS_NAMED = 3
HEAVY_DAMPING = 0.3  # above it the orderings, exact without damping, may bend


def compare(
    initial: Mapping[str, Estimate],
    *,
    final: Mapping[str, Estimate],
    names: Sequence[str],
    position_unit: str,
    input_unit: str,
) -> tuple[ParameterRow, ...]:
    """Set the initial beside the final estimate of every parameter in `names`."""
    rows = []
    for name in names:
        before, after = initial.get(name), final.get(name)
        percent = sigmas = consistent = None
        note = ""
        if before is not None and before.source == "assumed":
            note = "the initial value was assumed, not measured"
        if after is not None and (reason := why_open(name, after)):
            note, after = reason, None
        one_source = before is not None and after is not None and before.source == after.source
        if one_source:
            note = _ONE_SOURCE
        elif before is not None and after is not None and before.value != 0:
            percent = 100 * (after.value - before.value) / abs(before.value)
            if before.source != "assumed":
                sigmas = _combined_sigmas(before, after)
                consistent = abs(percent) <= _limit(name)
                if not consistent and sigmas is not None and sigmas <= SIGMA_LIMIT:
                    consistent, note = None, _UNDECIDED
        rows.append(
            ParameterRow(
                name=name,
                unit=parameter_unit(name, position=position_unit, input=input_unit),
                initial=before,
                final=after,
                change_percent=percent,
                change_sigmas=sigmas,
                consistent=consistent,
                note=note,
            )
        )
    return tuple(rows)


def why_open(name: str, final: Estimate) -> str:
    """Return why what a fit gives for a parameter is no number to go by, or ""."""
    if final.at_bound:
        return AT_BOUND
    percent = 100 * (final.std or 0.0) / abs(final.value) if final.value else np.inf
    limit = _limit(name)
    return NOT_DETERMINED.format(percent=percent, limit=limit) if percent > limit else ""


def _limit(name: str) -> float:
    return DAMPING_LIMIT if name.startswith(("zeta", "damping")) else GAIN_AND_FREQUENCY_LIMIT


def _combined_sigmas(before: Estimate, after: Estimate) -> float | None:
    if before.std is None or after.std is None:
        return None
    combined = float(np.hypot(before.std, after.std))
    return abs(after.value - before.value) / combined if combined > 0 else None


# ---------------------------------------------------------------------- checks


def check_files(unreadable: Mapping[str, str]) -> list[Check]:
    """Fail for each experiment whose file could not be read."""
    return [
        Check(
            id=f"data.{name}",
            outcome="fail",
            value=None,
            limit=None,
            message=f"{name} could not be read, so all else is without it: {reason}",
        )
        for name, reason in unreadable.items()
    ]


def check_rows(rows: Sequence[ParameterRow]) -> list[Check]:
    """Judge every parameter that was measured in two ways; a wide error is no agreement."""
    verdicts: dict[bool | None, tuple[Outcome, str]] = {
        True: ("pass", "agree"),
        False: ("fail", "disagree"),
        None: ("skip", "are too uncertain to compare"),
    }
    checks = []
    for row in rows:
        if row.change_percent is None or (row.consistent is None and row.change_sigmas is None):
            continue
        limit = _limit(row.name)
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
    if row.initial and row.final and row.initial.value * row.final.value < 0:
        return " Their signs differ: is the sign of the input in submission.toml right?"
    if row.name.startswith("zeta"):
        return (
            " Damping ratios differ where dry friction is at work: a dwell of amplitude A sees "
            "ζ + 2d/(πA), so ask which of the two methods saw the larger amplitude."
        )
    if row.name.startswith("K"):
        return " Look at the rest and settled levels of the steps, and at the lowest frequencies."
    return " Look at the peaks of the decay and at the dwells near this frequency."


def check_decays(decays: Sequence[LogDecrement], *, position_unit: str) -> list[Check]:
    """Ask of every decay whether viscous damping alone explains it."""
    return [
        Check(
            id=f"decay.{decay.experiment}.cart_{decay.cart}",
            outcome="fail" if decay.friction.present else "pass",
            value=decay.friction.f_statistic,
            limit=decay.friction.threshold,
            message=f"{decay.experiment}: the decay of cart {decay.cart} "
            + (
                "is not exponential: dry friction can hold the cart within "
                f"±{decay.friction.drop:.3g} {position_unit} of its rest. The envelope's "
                f"ζ = {decay.zeta:.3g} is biased; ζ = {decay.friction.zeta:.3g} once friction is "
                "taken out."
                if decay.friction.present
                else "is as exponential as its noise lets one see "
                f"(F = {decay.friction.f_statistic:.1f}, dry friction from "
                f"{decay.friction.threshold:.1f} on)."
            ),
        )
        for decay in decays
        if decay.friction is not None
    ]


def check_steps(steps: Sequence[StepGain], *, gain_unit: str) -> list[Check]:
    """Ask whether every step has one gain: a cart that sticks has an interval of them."""
    return [
        Check(
            id=f"step.{step.experiment}.cart_{step.cart}",
            outcome="pass" if step.interval is None else "fail",
            value=None if step.interval is None else step.interval[1] - step.interval[0],
            limit=None,
            message=f"{step.experiment}: cart {step.cart} "
            + (
                "settles where its springs put it."
                if step.interval is None
                else "sticks: its static gain is only known to lie between "
                f"{step.interval[0]:.4g} and {step.interval[1]:.4g} {gain_unit}."
            ),
        )
        for step in steps
    ]


def check_setup(records: Sequence[Record]) -> list[Check]:
    """Ask whether the carts that should be free are those that move (where all were measured)."""
    checks = []
    for record in records:
        swing = {cart: float(np.ptp(record.position(cart))) for cart in record.carts}
        free = max((swing[cart] for cart in record.carts if cart in record.free), default=0.0)
        held = {cart: swing[cart] for cart in record.carts if cart not in record.free}
        if not held or not any(cart in record.free for cart in record.carts):
            continue
        mover = max(held, key=lambda cart: held[cart])
        good = free >= HELD_SHARE * held[mover]
        named = ", ".join(map(str, record.free))
        checks.append(
            Check(
                id=f"setup.{record.id}",
                outcome="pass" if good else "fail",
                value=held[mover] / free if free > 0 else None,
                limit=1 / HELD_SHARE,
                message=f"{record.id}: "
                + (
                    f"the carts said to be free ({named}) are those that move."
                    if good
                    else f"cart {mover} moves and cart {named} does not, but cart {named} is said "
                    "to be free: is `carts` right, and is each cart in its column?"
                ),
            )
        )
    return checks


def check_dwells(records: Sequence[Record], points: Sequence[SinePoint]) -> list[Check]:
    """Check that the dwells swing at the frequencies stated of them, as a class or one by one."""
    stated = {record.id: record.omega for record in records if record.omega}
    ratios = {
        point.experiment: stated[point.experiment] / point.omega
        for point in points
        if point.experiment in stated
    }
    off = {name: r for name, r in ratios.items() if abs(np.log(r)) > _DWELL_LIMIT}
    if not off:
        return []
    ratio = float(np.median(list(off.values())))
    why = why_other_frequency(ratio)
    alike = all(abs(r / ratio - 1) < _DWELL_LIMIT for r in off.values())
    told = f", {ratio:.4g} times: {why}" if why and alike else ""
    named = ", ".join(list(off)[:_DWELLS_NAMED]) + (" …" if len(off) > _DWELLS_NAMED else "")
    return [
        Check(
            id="dwells.frequency",
            outcome="fail",
            value=ratio,
            limit=1.0,
            message=f"{len(off)} of {len(ratios)} dwells ({named}) do not swing at the frequency "
            f"stated{told}.",
        )
    ]


def check_loops(hardware: Sequence[HardwareCheck]) -> list[Check]:
    """Return a failed check for each run of which the log or the stated controller is wrong."""
    wrong = [check for check in hardware if check.contradicted]
    return [
        Check(
            id=f"hardware.{run}",
            outcome="fail",
            value=None,
            limit=None,
            message=f"{run}: {'; '.join(c.note for c in wrong if c.experiment == run and c.note)}.",
        )
        for run in dict.fromkeys(check.experiment for check in wrong)
    ]


def why_other_frequency(ratio: float) -> str:
    """Return what a dwell stated at so many times its frequency looks to be, or ""."""
    close = (
        why for factor, why in _DWELL_FACTORS.items() if abs(ratio / factor - 1) < _DWELL_LIMIT
    )
    return next(close, "")


NOT_IDENTIFIED = Check(
    id="fit.identified",
    outcome="fail",
    value=None,
    limit=None,
    message="No model was identified: the reasons are among what was skipped.",
)


def check_chain(fit: ChainFit, *, springs: Sequence[bool]) -> list[Check]:
    """Check the fit, and its chain against the laws of a real one: signs, redundancies, orders."""
    chain = fit.chain
    values = {name: estimate.value for name, estimate in fit.parameters.items()}
    checks = [*_fit_checks(fit), _sign_check(fit, springs=springs)]
    if chain.n in (2, 3) and "omega_a" in values and all(springs[1:-1]):
        checks += _redundancy_checks(values)
    if chain.n >= 2 and "omega_a" in values:
        checks.append(_gain_order_check(values, chain=chain))
        checks += _frequency_order_checks(values, n=chain.n)
    return checks


def _fit_checks(fit: ChainFit) -> list[Check]:
    explained = fit.chi_square_per_dof <= CHI_SQUARE_LIMIT
    return [
        Check(
            id="fit.converged",
            outcome="pass" if fit.converged else "fail",
            value=None,
            limit=None,
            message="The fit converged." if fit.converged else f"The fit failed: {fit.message}.",
        ),
        Check(
            id="fit.explains_data",
            outcome="pass" if explained else "fail",
            value=fit.chi_square_per_dof,
            limit=CHI_SQUARE_LIMIT,
            message=f"χ² per degree of freedom is {fit.chi_square_per_dof:.3g}: the linear carts "
            + (
                "and the noise explain the data."
                if explained
                else "leave more than the noise; look where model and measurement part."
            ),
        ),
    ]


def _sign_check(fit: ChainFit, *, springs: Sequence[bool]) -> Check:
    """No mass, damping or spring may be negative by more than its standard error allows."""
    chain = fit.chain
    values = {f"m_{i}": m for i, m in enumerate(chain.m, start=1)}
    values |= {f"c_{i}": c for i, c in enumerate(chain.c, start=1)}
    values |= {f"k_{i}": k for i, k in enumerate(chain.k, start=1) if springs[i - 1]}
    std = dict(zip(fit.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    below = {
        name: -value / std.get(name, np.inf) if std.get(name) else np.inf
        for name, value in values.items()
        if value < 0
    }
    worst = max(below.values(), default=0.0)
    names = ", ".join(f"{name} = {values[name]:.3g}" for name in below)
    return Check(
        id="physical.signs",
        outcome="pass" if worst <= 2.0 else "fail",
        value=float(worst) if np.isfinite(worst) else None,
        limit=2.0,
        message="All masses, dampings and springs are positive."
        if not below
        else f"Not positive: {names}; up to {worst:.1f} standard errors below zero.",
    )


def _redundancy_checks(values: Mapping[str, float]) -> list[Check]:
    meaning = "two routes through the transfer functions to one physical number agree"
    return [
        Check(
            id=f"redundancy.{name}",
            outcome="pass" if residual <= REDUNDANCY_LIMIT else "fail",
            value=float(residual),
            limit=REDUNDANCY_LIMIT,
            message=f"Redundancy {name} ({meaning}): relative difference {residual:.1e}.",
        )
        for name, residual in recover_from_parameters(values).residuals.items()
    ]


def _gain_order_check(values: Mapping[str, float], *, chain: Chain) -> Check:
    """The further from the motor, the smaller the static displacement."""
    gains = [values[f"K_{i}"] for i in range(1, chain.n + 1)]
    # Equal gains are right where no spring holds the far end: rounding then decides the sign.
    rise = max(later / earlier - 1 for earlier, later in pairwise(gains))
    good = rise <= REDUNDANCY_LIMIT and min(gains) >= 0
    text = " ≥ ".join(f"K_{i}" for i in range(1, chain.n + 1))
    return Check(
        id="order.gains",
        outcome="pass" if good else "fail",
        value=max(float(rise), 0.0),
        limit=REDUNDANCY_LIMIT,
        message=f"Static gains fall along the chain ({text} > 0): {'yes' if good else 'no'}.",
    )


def _frequency_order_checks(values: Mapping[str, float], *, n: int) -> list[Check]:
    """Carts held still raise every frequency: resonances and nulls interlace (Cauchy)."""
    modes = [f"omega_{mode}" for mode in "abcdefgh"[:n]]
    first, last = modes[0], modes[-1]
    laws = [(first, f"omega_{i}", last) for i in range(1, n + 1)]
    if n == 3:
        laws += [("omega_a", "omega_x", "omega_b"), ("omega_b", "omega_y", "omega_c")]
        laws += [("omega_x", f"omega_{i}", "omega_y") for i in (2, 3)]
    damped = any(value > HEAVY_DAMPING for name, value in values.items() if name[:4] == "zeta")
    checks = []
    for low, middle, high in laws:
        # How far outside the bracket, in percent of the value.
        excess = max(values[low] / values[middle], values[middle] / values[high]) - 1
        good = excess <= REDUNDANCY_LIMIT
        text = f"{low} < {middle} < {high}"
        reason = " (not exact where a damping ratio is above 0.3)" if damped and not good else ""
        checks.append(
            Check(
                id=f"order.{middle}" + (f"_in_{low[6:]}{high[6:]}" if n == 3 else ""),
                outcome="pass" if good else ("skip" if damped else "fail"),
                value=100 * max(float(excess), 0.0),
                limit=0.0,
                message=f"{text}: {'yes' if good else 'no'}{reason}.",
            )
        )
    return checks
