"""The results of an analysis as pandas tables, with columns named as in `results.json`.

The units of the columns are in `frame.attrs["units"]`.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.arrays import Array
from pipeline.json_files import keys, plain
from pipeline.results import (
    Analysis,
    Check,
    DecayLaw,
    FrequencyResponse,
    LogDecrement,
    ParameterRow,
    Record,
    SinePoint,
    StepGain,
)

if TYPE_CHECKING:
    # Imported late, because this takes a fifth of a second.
    import pandas as pd


def parameters(analysis: Analysis) -> "pd.DataFrame":
    """Return initial and final estimates, one row per parameter, indexed by its name."""
    frame = _frame(_rows(analysis.rows), keys(ParameterRow), analysis=analysis)
    frame["consistent"] = frame["consistent"].astype("boolean")  # missing values stay missing
    return frame.set_axis(frame["name"].to_list(), axis="index")


def checks(analysis: Analysis) -> "pd.DataFrame":
    """Return the consistency checks, one row per check; the index is the check's id."""
    frame = _frame(_rows(analysis.checks), keys(Check), analysis=analysis)
    return frame.set_axis(frame["id"].to_list(), axis="index")


def decays(analysis: Analysis) -> "pd.DataFrame":
    """Return the decays, one row each; the law that each follows is in columns `law_…`."""
    rows = [
        row | {f"law_{key}": value for key, value in row["law"].items()}
        for row in _rows(analysis.log_decrements)
    ]
    own = [key for key in keys(LogDecrement) if key not in ("law", "note")]
    columns = [*own, *(f"law_{key}" for key in keys(DecayLaw)), "note"]
    return _frame(rows, columns, analysis=analysis)


def steps(analysis: Analysis) -> "pd.DataFrame":
    """Return the static gains, one row per step recording and cart."""
    rows = []
    for row in _rows(analysis.step_gains):
        low, high = row["interval"] or (None, None)
        rows.append(row | {"interval_low": low, "interval_high": high})
    own = [key for key in keys(StepGain) if key not in ("interval", "note")]
    return _frame(rows, [*own, "interval_low", "interval_high", "note"], analysis=analysis)


def dwells(analysis: Analysis) -> "pd.DataFrame":
    """Return the sine dwells, one row per dwell and cart: amplitudes, their ratio, the phase."""
    return _frame(_rows(analysis.sine_points), keys(SinePoint), analysis=analysis)


def frequency_response(analysis: Analysis) -> "pd.DataFrame":
    """Return the points of the Bode plots, one row per cart and frequency."""
    rows = []
    for values in _rows(analysis.frequency_responses):
        for i in range(len(values["omega"])):
            rows.append({k: v[i] if isinstance(v, list) else v for k, v in values.items()})
    return _frame(rows, keys(FrequencyResponse), analysis=analysis)


def tables(analysis: Analysis) -> "dict[str, pd.DataFrame]":
    """Return all tables of results by name, without the records."""
    made = (parameters, checks, decays, steps, dwells, frequency_response)
    return {make.__name__: make(analysis) for make in made}


def record_frame(record: Record, *, analysis: Analysis) -> "pd.DataFrame":
    """Return one record as a table; the index is `time`, the columns are as in `record_series`."""
    import pandas as pd

    series, units = record_series(record), analysis.bench.units
    frame = pd.DataFrame(series).set_index("time")
    frame.attrs["units"] = {
        name: {"time": "s", "u": units.input}.get(name, units.position) for name in series
    }
    return frame


def record_series(record: Record) -> dict[str, Array]:
    """Return arrays (n,): `time`, the positions `x1`, …, and, if recorded, `u` and `reference`."""
    series = {"time": record.t, "u": record.u, "reference": record.reference}
    positions = {f"x{cart}": record.position(cart) for cart in record.carts}
    return {name: values for name, values in series.items() if values is not None} | positions


def _rows(results: Sequence[object]) -> list[dict[str, Any]]:
    """Return the fields of each result as in `results.json`, but with all digits."""
    return [plain(one, digits=17) for one in results]


def _frame(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str], *, analysis: Analysis
) -> "pd.DataFrame":
    """Return the rows as a table; its columns and number types exist even if there are no rows."""
    import pandas as pd

    frame = pd.DataFrame(rows, columns=list(columns))
    nothing = frame.columns[frame.isna().all()]
    frame = frame.astype(dict.fromkeys(nothing, float))
    frame.attrs["units"] = _units(columns, analysis=analysis)
    return frame


def _units(columns: Sequence[str], *, analysis: Analysis) -> dict[str, str]:
    of = analysis.bench.units
    known = {
        "rad/s": ("omega", "omega_n", "omega_n_peaks"),
        "rad": ("phase",),
        "s": ("steady_from",),
        of.position: ("amplitude", "rest_shift"),
        of.input: ("input_amplitude",),
        of.gain: ("gain", "magnitude", "interval_low", "interval_high"),
    }
    units = {name: unit for unit, names in known.items() for name in names}
    own = {column: units.get(column.removesuffix("_std")) for column in columns}
    return {column: unit for column, unit in own.items() if unit}
