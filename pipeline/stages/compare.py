"""Compare initial with final estimates, parameter by parameter.

Nearly every parameter is estimated in two ways (Throne 2005, Tables 1-3). Frequencies and gains
usually agree within some percent, damping ratios often do not.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from pipeline.names import read_name
from pipeline.results import DeterminedBy, Estimate, ParameterRow
from pipeline.setup import Setup

# In Throne's tables, the two estimates of gains and frequencies differ by up to 14 %. For one null,
# read by eye, it is 29 %. Damping ratios differ by half and more.
GAIN_AND_FREQUENCY_LIMIT, DAMPING_LIMIT = 15.0, 50.0  # percent
SIGMA_LIMIT = 3.0  # combined standard errors; a smaller difference may be due to chance
_UNDECIDED = "the two estimates are too uncertain to agree or to disagree"
AT_BOUND = "the fit puts it at zero because it has too few data, so there is no final value"
NOT_DETERMINED = (
    "not determined: the standard error is {percent:.0f} % of the value, more than the "
    "{limit:.0f} % that initial and final may differ by"
)
_ONE_SOURCE = "the fit's own points do not determine it, so the final value uses the decay too"


def compare(
    initial: Mapping[str, Estimate],
    *,
    final: Mapping[str, Estimate],
    names: Sequence[str],
    bench: Setup,
    fitted_to: Collection[str] = (),
) -> tuple[ParameterRow, ...]:
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
            note = _ONE_SOURCE
        elif before is not None and after is not None and before.value != 0:
            percent = 100 * (after.value - before.value) / abs(before.value)
            if before.source != "assumed":
                independent = set(before.experiments).isdisjoint(fitted_to)
                sigmas = _combined_sigmas(before, after)
                consistent = abs(percent) <= change_limit(name)
                if not consistent and sigmas is not None and sigmas <= SIGMA_LIMIT:
                    consistent, note = None, _UNDECIDED
        rows.append(
            ParameterRow(
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
    name: str, before: Estimate | None, after: Estimate | None, *, agree: bool
) -> DeterminedBy | None:
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


def undetermined_reason(name: str, final: Estimate) -> str:
    """Return why a fitted value cannot be relied on, or ""."""
    if final.at_bound:
        return AT_BOUND
    percent = 100 * (final.std or 0.0) / abs(final.value) if final.value else np.inf
    limit = change_limit(name)
    return NOT_DETERMINED.format(percent=percent, limit=limit) if percent > limit else ""


def change_limit(name: str) -> float:
    """Return how far initial and final estimates may differ, in percent."""
    return DAMPING_LIMIT if read_name(name).is_damping else GAIN_AND_FREQUENCY_LIMIT


def _combined_sigmas(before: Estimate, after: Estimate) -> float | None:
    if before.std is None or after.std is None:
        return None
    combined = float(np.hypot(before.std, after.std))
    return abs(after.value - before.value) / combined if combined > 0 else None
