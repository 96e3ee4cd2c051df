"""Initial estimates, their comparison with the final ones, and what determines each number."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from decimal import Decimal

import numpy as np

from pipeline import results
from pipeline.arrays import Array
from pipeline.estimation.noise import local_noise
from pipeline.names import gain_name, own_omega, own_zeta, read_name
from pipeline.setup import Setup

# ------------------------------------------------------- initial estimates, as in Throne's paper


def combine_repeats(
    values: Sequence[float], *, std: Sequence[float], source: str, experiments: Sequence[str] = ()
) -> results.Estimate:
    """Combine repeats of one number into their mean.

    Its standard error follows from their spread or from their errors, whichever makes it larger.
    """
    v = np.array(values, dtype=float)
    within = float(np.sqrt(np.sum(np.square(std))) / v.size)
    spread = float(np.std(v, ddof=1) / np.sqrt(v.size)) if v.size > 1 else 0.0
    return results.Estimate(
        value=float(np.mean(v)),
        std=max(within, spread),
        source=source,
        experiments=tuple(dict.fromkeys(experiments)),
    )


def estimate_initially(
    *,
    carts: int,
    log_decrements: Sequence[results.LogDecrement],
    step_gains: Sequence[results.StepGain],
) -> dict[str, results.Estimate]:
    """Estimate gains from steps, and each cart's own frequency and damping from decays."""
    measured: dict[str, list[tuple[float, float, str, str]]] = {}
    for decay in log_decrements:
        for name, value, std in (
            (own_omega(decay.cart, n=carts), decay.omega_n, decay.omega_n_std),
            (own_zeta(decay.cart, n=carts), decay.zeta, decay.zeta_std),
        ):
            measured.setdefault(name, []).append((value, std, "log_decrement", decay.experiment))
    for step in step_gains:
        name = gain_name(step.cart, n=carts)
        measured.setdefault(name, []).append((step.gain, step.gain_std, "step", step.experiment))
    return {
        name: combine_repeats(
            [value for value, *_ in ones],
            std=[std for _, std, *_ in ones],
            source=ones[0][2],
            experiments=[run for *_, run in ones],
        )
        for name, ones in measured.items()
    }


# ------------------------------------------------------------------- initial and final estimates
#
# Nearly every parameter is estimated in two ways (Throne 2005, Tables 1-3). Frequencies and gains
# usually agree within some percent, damping ratios often do not.

# In Throne's tables, the two estimates of gains and frequencies differ by up to 14 %. For one null,
# read by eye, it is 29 %. Damping ratios differ by half and more.
GAIN_AND_FREQUENCY_LIMIT, DAMPING_LIMIT = 15.0, 50.0  # percent
SIGMA_LIMIT = 3.0  # combined standard errors; a smaller difference may be due to chance


def compare(
    initial: Mapping[str, results.Estimate],
    *,
    final: Mapping[str, results.Estimate],
    names: Sequence[str],
    bench: Setup,
    fitted_to: Collection[str] = (),
) -> tuple[results.ParameterRow, ...]:
    """Combine the initial and the final estimate of every parameter in `names`.

    Parameters
    ----------
    fitted_to : the recordings used for the final estimates.
    """
    rows = []
    for name in names:
        before, after = initial.get(name), final.get(name)
        percent = sigmas = consistent = independent = None
        note = ""
        if before is not None and before.source == "assumed":
            note = "the initial value was assumed, not measured"
        if after is not None and (reason := undetermined_reason(name, after)):
            note, after = reason, None
        one_source = before is not None and after is not None and before.source == after.source
        if one_source:
            note = "the fit's own points do not determine it, so the final value uses the decay too"
        elif before is not None and after is not None and before.value != 0:
            percent = 100 * (after.value - before.value) / abs(before.value)
            if before.source != "assumed":
                independent = set(before.experiments).isdisjoint(fitted_to)
                sigmas = _combined_sigmas(before, after)
                consistent = abs(percent) <= change_limit(name)
                if not consistent and sigmas is not None and sigmas <= SIGMA_LIMIT:
                    consistent = None
                    note = "the two estimates are too uncertain to agree or to disagree"
        rows.append(
            results.ParameterRow(
                name=name,
                unit=read_name(name).unit(bench.units),
                initial=before,
                final=after,
                change_percent=percent,
                change_sigmas=sigmas,
                consistent=consistent,
                independent=independent,
                determined_by=_determined_by(name, before, after, agree=bool(consistent)),
                note=note,
            )
        )
    return tuple(rows)


def _determined_by(
    name: str, before: results.Estimate | None, after: results.Estimate | None, *, agree: bool
) -> results.DeterminedBy | None:
    """Return what determines a final frequency or damping ratio; None for other parameters.

    A decay that agrees with an extrapolated number measures it.
    """
    read = read_name(name)
    if after is None or not (read.is_frequency or read.is_ratio):
        return None
    near = after.coverage
    if near is None:
        return "decay" if after.source == "log_decrement" else None
    if near.extrapolated:
        measured = agree and before is not None and before.source == "log_decrement"
        return "decay" if measured else "model"
    if name not in (near.of, read_name(near.of).damping):
        return "parameters"
    return "points" if after.source == "bode_fit" else "motion"


def undetermined_reason(name: str, final: results.Estimate) -> str:
    """Return why a fitted value cannot be relied on, or ""."""
    if final.at_bound:
        return "the fit puts it at zero because it has too few data, so there is no final value"
    percent = 100 * (final.std or 0.0) / abs(final.value) if final.value else np.inf
    limit = change_limit(name)
    if not percent > limit:
        return ""
    return (
        f"not determined: the standard error is {percent:.0f} % of the value, more than the "
        f"{limit:.0f} % that initial and final may differ by"
    )


def change_limit(name: str) -> float:
    """Return how far initial and final estimates may differ, in percent."""
    return DAMPING_LIMIT if read_name(name).is_damping else GAIN_AND_FREQUENCY_LIMIT


def is_off(name: str, typed: Decimal, found: results.Estimate | None) -> bool:
    """Return whether a number that students typed disagrees with the estimate from their data."""
    if found is None or not found.value or found.source == "assumed":
        return False
    rounding = 0.5 * 10.0 ** int(typed.as_tuple().exponent)
    # Other methods may give results that differ by this much: a third of the limit between initial
    # and final estimates.
    few = change_limit(name) / 3 / 100 * abs(found.value)
    return abs(float(typed) - found.value) > rounding + SIGMA_LIMIT * (found.std or 0.0) + few


def list_off(
    rows: Sequence[results.ParameterRow], typed: Mapping[str, Mapping[str, Decimal]]
) -> tuple[str, ...]:
    """Return the parameters for which a typed number disagrees with the data.

    `typed` has the initial and the final numbers by parameter.
    """
    return tuple(
        row.name
        for row in rows
        if any(
            row.name in numbers and is_off(row.name, numbers[row.name], getattr(row, column))
            for column, numbers in typed.items()
        )
    )


def _combined_sigmas(before: results.Estimate, after: results.Estimate) -> float | None:
    if before.std is None or after.std is None:
        return None
    combined = float(np.hypot(before.std, after.std))
    return abs(after.value - before.value) / combined if combined > 0 else None


# ------------------------------------------- measurements that determine each resonance and null
#
# A fit of few parameters predicts a resonance even from data far away from it. This prediction
# relies on the structure of the chain, so its standard error says nothing about a wrong structure.
# A number counts as measured only if there are measurements at its own frequency.


def points_measured(responses: Iterable[results.FrequencyResponse]) -> Array:
    """Return the frequencies, rad/s, at which a frequency response has a point above its error."""
    seen = [np.zeros(0)]
    for r in responses:
        # A table states no errors; NaN counts as seen.
        # A point with a larger relative error does not show the height of a peak.
        hidden = r.magnitude_std > 0.2 * r.magnitude
        seen.append(r.omega[~hidden & (r.omega > 0)])
    return np.unique(np.concatenate(seen))


def motion_measured(records: Iterable[results.Record]) -> Array:
    """Return the frequencies, rad/s, at which the motion in some record exceeds its noise."""
    return np.unique(np.concatenate([np.zeros(0), *map(_visible, records)]))


def _visible(record: results.Record) -> Array:
    n, dt = record.t.size, record.sample_time
    even = np.linspace(record.t[0], record.t[-1], n)
    window = np.hanning(n)
    # Padded to twice the length, so that the lines are half a resolution apart.
    omega: Array = 2 * np.pi * np.fft.rfftfreq(2 * n, dt).astype(np.float64)
    seen = np.zeros(omega.size, dtype=bool)
    for y, step in zip(record.y, record.resolution, strict=True):
        noise = max(local_noise(record.t, y), float(step) / np.sqrt(12))
        motion = np.interp(even, record.t, y)
        spectrum = np.abs(np.fft.rfft((motion - motion.mean()) * window, 2 * n))
        # A line is motion if it exceeds five times the noise. Noise alone does so once in e^12.5
        # lines.
        seen |= spectrum > 5.0 * noise * np.linalg.norm(window)
    # The lowest lines hold the mean and the drift.
    return omega[seen & (omega > 4 * np.pi / (n * dt))]


def with_coverage(fit: results.ChainFit, measured: Array) -> results.ChainFit:
    """Return the fit; each frequency and damping ratio has its `Coverage`.

    Frequencies of carts held alone that are no null follow from all resonances and nulls, so they
    have the worst coverage of these. A damping ratio from decays is measured and gets none.

    Parameters
    ----------
    measured : (n,) ascending frequencies with a measurement, rad/s.
    """
    found = fit.parameters
    omegas = [name for name in found if read_name(name).is_frequency]
    seen: dict[str, results.Coverage] = {}
    for name in omegas:
        zeta = found.get(read_name(name).damping)
        if _is_root(name, n=fit.chain.n) and found[name].value > 0:
            seen[name] = _coverage(
                name, omega=found[name].value, zeta=zeta.value if zeta else 0.0, measured=measured
            )
    if not seen:
        return fit
    worst = max(seen.values(), key=lambda one: one.distance / one.limit)
    by_name = {
        name: seen.get(omega, worst)
        for omega in omegas
        for name in (omega, read_name(omega).damping)
        if name in found and found[name].source == fit.method
    }
    covered = {name: replace(found[name], coverage=one) for name, one in by_name.items()}
    return replace(fit, parameters={**found, **covered})


def _is_root(omega: str, *, n: int) -> bool:
    """Whether a frequency is that of a pole or zero of a measured response."""
    read = read_name(omega)
    return read.is_by_eye or omega == own_omega(n, n=n)


def _coverage(name: str, *, omega: float, zeta: float, measured: Array) -> results.Coverage:
    half_width = max(zeta, 0.0) * omega

    def nearest(there: Array) -> float | None:
        return float(there[np.argmin(np.abs(there - omega))]) if there.size else None

    # Measurements must be within five half-widths (ζω) on both sides, where a mode still has a
    # fifth of its peak. At least 10 % and at most 30 % of the frequency is allowed.
    return results.Coverage(
        of=name,
        omega=omega,
        half_width=half_width,
        # A point on the peak, within a half-width, counts as a point on both sides.
        below=nearest(measured[measured <= omega + half_width]),
        above=nearest(measured[measured >= omega - half_width]),
        limit=float(np.clip(5.0 * zeta, 0.1, 0.3)),
    )
