"""Check the estimates, the decays, the steps, the fitted carts and the loops.

Two estimates of one number must agree, the fit must explain the data, the chain must be possible,
and loops must be those that were requested or logged.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from pipeline.arrays import Array
from pipeline.errors import DataError
from pipeline.estimation.estimates import SIGMA_LIMIT, change_limit
from pipeline.identify.findings import say
from pipeline.names import gain_name, own_zeta, read_name, toml_flags
from pipeline.plant.chain import Chain
from pipeline.plant.identities import (
    HEAVY_DAMPING,
    interlacing_brackets,
    recover_from_parameters,
)
from pipeline.plant.margins import Margins, stability_margins
from pipeline.plant.sampled_loop import discretise
from pipeline.results import (
    EXPLAINED,
    ChainFit,
    Check,
    CheckOutcome,
    Coverage,
    DecayLaw,
    FeedbackDesign,
    Finding,
    HardwareCheck,
    LogDecrement,
    ParameterRow,
    Record,
    StepGain,
    passed,
)
from pipeline.setup import Setup
from pipeline.words.numbers import join_names, listing, significant, with_error
from pipeline.words.phrases import phrases

_REDUNDANCY = 1e-9  # relative difference of one number computed in two ways, without rounding
_BELOW_ZERO = 2.0  # standard errors by which a mass, damping or spring may be below zero
# A parameter below this share of its larger neighbour may not exist: on no bench do masses, dampers
# or springs differ by a factor of 50. If a spring is missing, dry friction and loose screws look
# like a spring of up to 1 % of its neighbour.
NEGLIGIBLE = 0.02
_LAWS = phrases("decays")
# Largest difference between the polynomials of two loops that count as the same. Rounding leaves
# 1e-13 on realistic plants, and gains from another program up to 1e-8.
_SAME_LOOP = 1e-6


def check_carts(
    fit: ChainFit | None, *, decays: Sequence[LogDecrement] = (), bench: Setup
) -> list[Check]:
    """Check the fit, and whether the chain has the signs, redundancies and orders of real carts."""
    if fit is None:
        return [Finding(code="no_model", kind="fit", part="identified").check]
    if not fit.converged:
        return _fit_checks(fit)
    chain = fit.chain
    values = {name: estimate.value for name, estimate in fit.parameters.items()}
    checks = [*_fit_checks(fit), _sign_check(fit, bench=bench)]
    checks += check_vanishing(fit, decays=decays, bench=bench)
    if chain.n in (2, 3) and "omega_a" in values and all(bench.springs[1:-1]):
        checks += _redundancy_checks(values)
    if chain.n >= 2 and "omega_a" in values:
        checks.append(_gain_order_check(values, chain=chain))
        checks += _frequency_order_checks(values, n=chain.n)
    return checks


def _fit_checks(fit: ChainFit) -> list[Check]:
    found = (
        "the linear carts leave a residual above the noise; look where model and measurement "
        "differ."
    )
    if not fit.converged:
        found = "not judged, because the fit failed."
    elif fit.explains_data:
        found = "the linear carts and the noise explain the data."
    return [
        Check(
            kind="fit",
            part="converged",
            outcome=passed(fit.converged),
            message="The fit converged." if fit.converged else f"The fit failed: {fit.message}.",
        ),
        Check(
            kind="fit",
            part="explains_data",
            outcome=passed(fit.explains_data) if fit.converged else "skip",
            message=f"χ² per degree of freedom is {fit.chi_square_per_dof:.3g}: {found}",
            value=fit.chi_square_per_dof,
            limit=EXPLAINED,
        ),
    ]


def _sign_check(fit: ChainFit, *, bench: Setup) -> Check:
    """Check that no mass, damping or spring is negative by more than its standard error allows."""
    std = fit.std
    below = {k: v for k, v in physical_values(fit.chain, bench=bench).items() if v < 0}
    sigmas = [-value / std[name] if std.get(name) else np.inf for name, value in below.items()]
    worst, message = float(max(sigmas, default=0.0)), "No mass, damping or spring is below zero."
    if below:
        names = ", ".join(f"{name} = {value:.3g}" for name, value in below.items())
        message = f"Not positive: {names}; up to {worst:.1f} standard errors below zero."
    return Check(
        kind="physical",
        part="signs",
        outcome=passed(worst <= _BELOW_ZERO),
        value=worst if np.isfinite(worst) else None,
        limit=_BELOW_ZERO,
        message=message,
    )


def physical_values(chain: Chain, *, bench: Setup) -> dict[str, float]:
    """Return the masses, dampings and springs that the bench has, by name."""
    values = {f"m_{i}": float(m) for i, m in enumerate(chain.m, start=1)}
    values |= {f"c_{i}": float(c) for i, c in enumerate(chain.c, start=1)}
    springs = enumerate(zip(chain.k, bench.stiff, strict=True), start=1)
    return values | {f"k_{i}": float(k) for i, (k, there) in springs if there}


def check_vanishing(
    fit: ChainFit, *, decays: Sequence[LogDecrement] = (), bench: Setup
) -> list[Check]:
    """Return a failed check for each mass, damping or spring that may not exist.

    A parameter may not exist if its value is zero within its standard error, or small compared with
    its larger neighbour of the same kind.
    """
    if not fit.converged:
        return []
    values, std = physical_values(fit.chain, bench=bench), fit.std
    checks = []
    for name, value in values.items():
        sigmas = value / std[name] if std.get(name) else None
        beside = _larger_neighbour(name, values)
        share = value / values[beside] if beside else 1.0
        if value == 0 or (sigmas is not None and abs(sigmas) <= SIGMA_LIMIT):
            seen = "zero_within_error" if sigmas else "ends_at_zero"
            measured, limit = sigmas, SIGMA_LIMIT
        elif 0 < share < NEGLIGIBLE:
            seen, measured, limit = "almost_nothing", share, NEGLIGIBLE
        else:
            continue
        found = say(
            seen,
            name=name,
            value=with_error(value, std.get(name)) if sigmas else f"{value:.2g}",
            percent=f"{100 * share:.2g}",
            beside=beside,
        )
        code, details = _ask_if_there(name, decays=decays, bench=bench)
        finding = Finding(code=code, kind="vanishing", parameter=name, limit=limit)
        details |= {"found": found}
        checks.append(replace(finding, details=details, value=measured or 0.0).check)
    return checks


def _larger_neighbour(name: str, values: Mapping[str, float]) -> str:
    """Return the larger of the two neighbouring parameters of the same kind, by name.

    Only positive neighbours count. Without one the result is "".
    """
    read = read_name(name)
    assert read.cart is not None
    beside = [f"{read.symbol}_{read.cart + step}" for step in (-1, 1)]
    return max((o for o in beside if values.get(o, 0.0) > 0), key=lambda o: values[o], default="")


def _ask_if_there(
    name: str, *, decays: Sequence[LogDecrement], bench: Setup
) -> tuple[str, dict[str, object]]:
    """Return the code of the question to the student about a vanishing parameter, with its values.

    Its sentence has the line of submission.toml to change.
    """
    read, n = read_name(name), bench.n
    assert read.cart is not None
    i = read.cart
    if read.symbol == "c" and (alike := [one for one in decays if one.cart == i]):
        runs = join_names(list(dict.fromkeys(one.experiment for one in alike)))
        zeta = f"{alike[0].zeta:.2g}"
        return "damping_of_decay", {"runs": runs, "zeta": own_zeta(i, n=n), "value": zeta}
    if read.symbol == "c":
        return "no_damping", {"n": i, "alone": f", carts = [{i}]" if n > 1 else ""}
    if read.symbol == "m":
        return "no_cart", {"n": i, "fewer": f"carts = {n - 1}, or " if n > 1 else ""}
    if 1 < i <= n:
        return "no_link", {"n": i, "before": i - 1}
    fewer = [flag and n > 1 and j != i for j, flag in enumerate(bench.springs, start=1)]
    end = "at all" if n == 1 else f"wall-{i}" if i == 1 else f"{n}-wall"
    return "no_end_spring", {"end": end, "springs": toml_flags(fewer)}


def _redundancy_checks(values: Mapping[str, float]) -> list[Check]:
    meaning = "two computations of the same physical number from the transfer functions"
    return [
        Check(
            kind="redundancy",
            parameter=name,
            outcome=passed(residual <= _REDUNDANCY),
            value=float(residual),
            limit=_REDUNDANCY,
            message=f"Redundancy {name}: {meaning} differ by {residual:.1e} (relative).",
        )
        for name, residual in recover_from_parameters(values).residuals.items()
    ]


def _gain_order_check(values: Mapping[str, float], *, chain: Chain) -> Check:
    """Check that a constant input moves no cart further than the cart before it."""
    names = [gain_name(cart, n=chain.n) for cart in range(1, chain.n + 1)]
    gains = [values[name] for name in names]
    # If no spring holds the far end, all static gains are equal and rounding decides which is
    # larger.
    rise = max(later / earlier - 1 for earlier, later in pairwise(gains))
    good = rise <= _REDUNDANCY and min(gains) >= 0
    said = "yes" if good else "no"
    return Check(
        kind="order",
        part="gains",
        outcome=passed(good),
        value=max(float(rise), 0.0),
        limit=_REDUNDANCY,
        message=f"Static gains fall along the chain ({' ≥ '.join(names)} > 0): {said}.",
    )


def _frequency_order_checks(values: Mapping[str, float], *, n: int) -> list[Check]:
    """Check the order of resonances, nulls, and frequencies of single carts.

    With heavy damping, a wrong order is no failure, because damping may change the order.
    """
    damped = any(v > HEAVY_DAMPING for name, v in values.items() if read_name(name).is_ratio)
    wrong = "no (not exact where a damping ratio is above 0.3)" if damped else "no"
    checks = []
    for low, middle, high, _ in interlacing_brackets(n):
        # Distance of the frequency from its allowed range, in percent of the frequency.
        excess = max(values[low] / values[middle], values[middle] / values[high]) - 1
        good = excess <= _REDUNDANCY
        check = Check(
            kind="order",
            parameter=middle,
            part=f"in_{read_name(low).suffix}{read_name(high).suffix}" if n == 3 else "",
            outcome="pass" if good else ("skip" if damped else "fail"),
            value=100 * max(float(excess), 0.0),
            limit=0.0,
            message=f"{low} < {middle} < {high}: {'yes' if good else wrong}.",
        )
        checks.append(check)
    return checks


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
        limit, change = change_limit(row.name), row.change_percent
        outcome, verdict = verdicts[row.consistent]
        parts = [f"Initial and final {row.name} {verdict} (limit {limit:.0f} %): "]
        parts.append(f"the difference is {change:+.1f} %")
        if row.change_sigmas is not None:
            parts.append(f", or {row.change_sigmas:.1f} standard errors")
        parts.append("." if row.independent is not False else ". Both use the same recordings.")
        message = "".join(parts) + (_advice(row) if outcome == "fail" else "")
        check = Check(
            kind="initial_final",
            parameter=row.name,
            outcome=outcome,
            value=abs(change),
            limit=limit,
            message=message,
        )
        checks.append(check)
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
        message = say(
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
        return say("dampings_of_points" if response else "dampings_of_records")
    looks = {
        "step": "the rest and settled levels of {runs}",
        "log_decrement": "the peaks of {runs}",
        "frequency_response": "the points at the lowest frequencies"
        if name.is_gain
        else "the points near this frequency",
    }
    look = looks.get(before.source, "{runs}").format(runs=join_names(before.experiments))
    if response and name.is_frequency:
        look += ", and at the points of the response near this frequency"
    if response and before.source == "step":
        look += ", and at the lowest frequencies"
    return f" Look at {look}."


def check_decays(
    decays: Sequence[LogDecrement], *, records: Sequence[Record] = (), bench: Setup
) -> list[Check]:
    """Check for every decay whether it is exponential within the noise."""
    checks, steps = [], {record.id for record in records if record.kind == "step"}
    for decay in decays:
        cart, law = decay.cart, decay.law
        rings = f"the ringing of cart {cart} after the step"
        what = rings if decay.experiment in steps else f"the decay of cart {cart}"
        check = Check(
            kind="decay",
            run=decay.experiment,
            cart=cart,
            part=str(decay.number or ""),
            outcome="skip" if law.is_untested else passed(law.is_exponential),
            value=law.statistic,
            limit=law.limit,
            message=f"{decay.name}: {what} {say_law(decay, unit=bench.units.position)}",
        )
        checks.append(check)
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
    """Return the check of one step, whose cart shows dry friction in the runs `shown`."""
    run, cart, edges = step.experiment, step.cart, len(step.edges)
    if step.interval:
        low, high = step.interval
        # The shift of the rest points gives the least friction that can hold the cart.
        details = {"low": f"{low:.4g}", "high": f"{high:.4g}", "unit": bench.units.gain}
        return Finding(
            code="sticks", kind="step", run=run, cart=cart, details=details, value=high - low
        ).check
    outcome: CheckOutcome = "skip"
    if shown:
        found = say("step_with_friction", runs=join_names(list(dict.fromkeys(shown))))
    elif edges < 2:
        found = say("step_with_one_edge")
    else:
        all_edges = "both edges" if edges == 2 else f"all {edges} edges"
        back = "" if step.rest_shift is None else say("step_returns")
        outcome, found = "pass", say("step_agrees", all_edges=all_edges, back=back)
    message = f"{run}: cart {cart} {found}"
    return Check(kind="step", run=run, cart=cart, outcome=outcome, message=message)


def say_law(decay: LogDecrement, *, unit: str) -> str:
    """Return the law with its numbers, as the end of a sentence about the decay."""
    said = _numbers(decay, unit=unit)
    numbers = _LAWS.text("numbers", zeta=said["zeta"], omega_n=said["omega_n"])
    return _LAWS.text(_key(decay.law), numbers=numbers, **said)


def name_law(decay: LogDecrement, *, unit: str) -> str:
    """Return the law in a few words, with the size of its cause."""
    law = decay.law
    said = _numbers(decay, unit=unit) | {"size": with_error(law.size, law.size_std)}
    return _LAWS.text(f"short_{_key(law)}", **said)


def _key(law: DecayLaw) -> str:
    return "untested" if law.is_untested else law.name


def _numbers(decay: LogDecrement, *, unit: str) -> dict[str, str]:
    law = decay.law
    return {
        "statistic": f"{law.statistic:.1f}",
        "limit": f"{law.limit:.1f}",
        "size": significant(law.size, digits=3),
        "percent": f"{100 * abs(law.size):.2g}",
        "side": "higher" if law.size > 0 else "lower",
        "zeta": significant(law.zeta, digits=3),
        "omega_n": significant(law.omega_n, digits=4),
        "apparent": significant(decay.zeta, digits=3),
        "unit": unit,
    }


def check_loops(hardware: Sequence[HardwareCheck]) -> list[Check]:
    """Return a failed check for each run whose log or stated controller is wrong."""
    notes: dict[str, list[str]] = {}
    for check in hardware:
        if check.contradicted:
            notes.setdefault(check.experiment, []).extend([check.note] if check.note else [])
    return [
        Finding(code="loop", kind="hardware", run=run, details={"notes": "; ".join(texts)}).check
        for run, texts in notes.items()
    ]


def design_margins(chain: Chain, design: FeedbackDesign, *, on_bench: bool = False) -> Margins:
    """Return the margins of the designed loop, including its observer and delay.

    The observer predicts with the chain or, `on_bench`, with constant velocities.

    Raises
    ------
    DataError : the loop is not stable, a mode of the carts is undamped, or the numbers of the chain
        differ by too many orders of magnitude.
    """
    controller = design.controller(None if on_bench else chain)
    try:
        return Margins.of(*stability_margins(chain, controller, sample_time=design.sample_time))
    except np.linalg.LinAlgError:
        raise DataError("no margins: the numbers of this loop differ too much in size") from None


def verify_design(chain: Chain, design: FeedbackDesign) -> Check:
    """Check that the designed gains give the requested loop.

    The check's value is the largest difference between coefficients of two polynomials in z, or the
    relative error of the static gain if that is larger. One polynomial belongs to the designed
    loop. The other one belongs to the requested poles or, with LQR, to the loop that scipy's
    Riccati solver gives.
    """
    asked = "the requested poles" if design.Q is None else "the same loop as scipy's Riccati solver"
    message = f"the gains give {asked}"
    verified = Check(
        kind="feedback", part="gains", outcome="pass", limit=_SAME_LOOP, message=message
    )
    try:
        ours, wanted, level = _loops(chain, design)
    except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
        message = "not verified: the plant's numbers differ too much in size"
        return replace(verified, outcome="skip", message=message)
    # Rounding beyond twelve decimals depends on the linear algebra library.
    value = float(np.max(np.append(np.abs(ours - wanted), abs(level - 1))).round(12))
    if value <= _SAME_LOOP:
        return replace(verified, value=value)
    finite = bool(np.isfinite(value))
    return Finding(
        code="other_loop" if finite else "no_polynomial",
        kind="feedback",
        part="gains",
        details={"asked": asked},
        value=value if finite else None,
        limit=_SAME_LOOP,
    ).check


def _loops(chain: Chain, design: FeedbackDesign) -> tuple[Array, Array, float]:
    """Return the polynomials of the designed and the requested loop, and the static gain."""
    phi, gamma = discretise(chain, design.sample_time)

    def fed_back(gains: Array) -> Array:
        return phi - np.outer(gamma, gains)

    ours = fed_back(design.gains)
    settled = np.linalg.solve(np.eye(gamma.size) - ours, design.prefilter * gamma)
    if design.requested_poles is not None:
        z = np.exp(design.sample_time * design.requested_poles)
    else:
        assert design.Q is not None
        assert design.R is not None
        z = np.linalg.eigvals(fed_back(_riccati_gains(phi, gamma, Q=design.Q, R=design.R)))
    level = float(settled[2 * (design.cart - 1)])
    return _from_roots(np.linalg.eigvals(ours)), _from_roots(z), level


def _riccati_gains(phi: Array, gamma: Array, *, Q: Array, R: float) -> Array:
    """Return the LQR gains from scipy's Riccati solver, independently of the design."""
    from scipy.linalg import solve_discrete_are  # takes a tenth of a second, so it is imported here

    cost = solve_discrete_are(phi, gamma[:, None], Q, R)
    return (gamma @ cost @ phi) / (R + gamma @ cost @ gamma)


def _from_roots(z: ArrayLike) -> Array:
    return np.poly(z).real.astype(np.float64)
