"""The results of an analysis as pandas tables, their columns named as in `results.json`.

A column's unit, where it has one, stands in `frame.attrs["units"]`.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.arrays import Array
from pipeline.results import Analysis, Record
from pipeline.results_json import results_dict
from pipeline.schemas.base import Document
from pipeline.schemas.results import Check, Friction, LogDecrement, Parameter, StepGain

if TYPE_CHECKING:
    import pandas as pd  # a fifth of a second: imported where it is used

_DWELL = (
    "experiment", "cart", "omega", "gain", "gain_std", "phase", "phase_std", "amplitude",
    "amplitude_std", "input_amplitude", "input_amplitude_std", "steady_from", "settled", "note",
)  # fmt: skip
RESPONSE = ("cart", "omega", "magnitude", "magnitude_std", "phase", "phase_std", "source")


def parameters(analysis: Analysis) -> "pd.DataFrame":
    """Return initial and final estimates, one row a parameter; the index is its name."""
    frame = _frame(results_dict(analysis)["parameters"], _keys(Parameter), analysis=analysis)
    frame["consistent"] = frame["consistent"].astype("boolean")  # None where there is none
    return frame.set_axis(frame["name"].to_list(), axis="index")


def checks(analysis: Analysis) -> "pd.DataFrame":
    """Return one row a consistency check; the index is its id."""
    frame = _frame(results_dict(analysis)["checks"], _keys(Check), analysis=analysis)
    return frame.set_axis(frame["id"].to_list(), axis="index")


def decays(analysis: Analysis) -> "pd.DataFrame":
    """Return one row a decay; the friction test is in columns `friction_…`."""
    rows = [
        row | {f"friction_{key}": value for key, value in (row["friction"] or {}).items()}
        for row in results_dict(analysis)["log_decrements"]
    ]
    own = [key for key in _keys(LogDecrement) if key not in ("friction", "note")]
    columns = [*own, *(f"friction_{key}" for key in _keys(Friction)), "note"]
    return _frame(rows, columns, analysis=analysis)


def steps(analysis: Analysis) -> "pd.DataFrame":
    """Return one row a step and cart: its static gain."""
    rows = []
    for row in results_dict(analysis)["step_gains"]:
        low, high = row["interval"] or (None, None)
        rows.append(row | {"interval_low": low, "interval_high": high})
    own = [key for key in _keys(StepGain) if key not in ("interval", "note")]
    return _frame(rows, [*own, "interval_low", "interval_high", "note"], analysis=analysis)


def dwells(analysis: Analysis) -> "pd.DataFrame":
    """Return one row a sine dwell and cart: amplitudes, their ratio, the phase."""
    rows = [{key: getattr(point, key) for key in _DWELL} for point in analysis.sine_points]
    return _frame(rows, _DWELL, analysis=analysis)


def frequency_response(analysis: Analysis) -> "pd.DataFrame":
    """Return one row a cart and frequency: the points of the Bode plots."""
    rows = []
    for response in analysis.frequency_responses:
        values = {key: getattr(response, key) for key in RESPONSE}
        for i in range(response.omega.size):
            rows.append({k: v[i] if isinstance(v, np.ndarray) else v for k, v in values.items()})
    return _frame(rows, RESPONSE, analysis=analysis)


def tables(analysis: Analysis) -> "dict[str, pd.DataFrame]":
    """Return every table of results by its name; the records are not among them."""
    made = (parameters, checks, decays, steps, dwells, frequency_response)
    return {make.__name__: make(analysis) for make in made}


def record_frame(record: Record, *, analysis: Analysis) -> "pd.DataFrame":
    """Return one record: the index is `time`, the columns those of `record_series`."""
    import pandas as pd

    series = record_series(record)
    frame = pd.DataFrame(series).set_index("time")
    frame.attrs["units"] = {
        name: {"time": "s", "u": analysis.input_unit}.get(name, analysis.position_unit)
        for name in series
    }
    return frame


def record_series(record: Record) -> dict[str, Array]:
    """Return `time`, `u` and `reference` where there are any, and positions `x1`, …: (n,) each."""
    series = {"time": record.t, "u": record.u, "reference": record.reference}
    positions = {f"x{cart}": record.position(cart) for cart in record.carts}
    return {name: values for name, values in series.items() if values is not None} | positions


def _keys(model: type[Document]) -> list[str]:
    return list(model.model_fields)


def _frame(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str], *, analysis: Analysis
) -> "pd.DataFrame":
    """Return the rows as a table whose columns are there, and numbers, also where it is empty."""
    import pandas as pd

    frame = pd.DataFrame(rows, columns=list(columns))
    nothing = frame.columns[frame.isna().all()]
    frame = frame.astype(dict.fromkeys(nothing, float))
    frame.attrs["units"] = _units(columns, analysis=analysis)
    return frame


def _units(columns: Sequence[str], *, analysis: Analysis) -> dict[str, str]:
    position, drive = analysis.position_unit, analysis.input_unit
    known = {
        "rad/s": ("omega", "omega_n", "omega_n_peaks"),
        "rad": ("phase",),
        "s": ("steady_from",),
        position: ("amplitude", "rest_shift", "friction_drop"),
        drive: ("input_amplitude",),
        f"{position}/{drive}": ("gain", "magnitude", "interval_low", "interval_high"),
    }
    units = {name: unit for unit, names in known.items() for name in names}
    own = {column: units.get(column.removesuffix("_std")) for column in columns}
    return {column: unit for column, unit in own.items() if unit}
