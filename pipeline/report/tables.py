"""The results of an analysis as pandas tables, with columns named as in `results.json`.

The units of the columns are in `frame.attrs["units"]`.
"""

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.io import savemat

from pipeline.arrays import Array
from pipeline.json_files import keys, plain
from pipeline.output import csv_text, own_folder, write_file
from pipeline.results import (
    Analysis,
    Check,
    DecayLaw,
    Estimate,
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

_HEADER = b"MATLAB 5.0 MAT-file".ljust(116)  # scipy's own header contains the time
_LONGEST_NAME = 63  # most characters in the name of a MATLAB variable
_RESERVED = set(
    "break case catch classdef continue else elseif end for function global if otherwise parfor "
    "persistent return spmd switch try while".split()
)


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
    frame.attrs["kind"] = record.kind
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


# ----------------------------------------------------------------------------------------- files


def save_tables(analysis: Analysis, out: Path) -> None:
    """Write `results.mat`, and one file `tables/*.csv` for each table, into the folder `out`."""
    folder = own_folder(out, "tables")
    folder.mkdir(parents=True, exist_ok=True)
    for name, frame in tables(analysis).items():
        write_file(folder / f"{name}.csv", _csv(frame))
    write_file(out / "results.mat", matlab_file(analysis))


def _csv(frame: "pd.DataFrame") -> str:
    """Return the table as text; each heading ends with the column's unit in brackets."""
    units = frame.attrs["units"]
    head = [f"{name} [{units[name]}]" if name in units else name for name in frame.columns]
    rows = frame.astype(object).where(frame.notna(), None)
    return csv_text(head, plain(rows.to_numpy().tolist()))


def matlab_file(analysis: Analysis) -> bytes:
    """Return a MAT-file (level 5) whose variables are named as in `results.json`.

    The variables are:

    - `parameters.initial.K_1`, `parameters.initial_std.K_1`, … and the same for `final`.
    - `A`, `B`, `C`, `D`, and `m`, `c`, `k` of the chain.
    - `gains`, `prefilter`, `sample_time`, `margins`, and LQR's weights `Q` and `R`.
    - `frequency_response`. One structure per cart.
    - `records.ID` with `time`, `u`, `x1`, ….
    - `units`.

    A number that could not be computed is NaN. A result that the analysis lacks is left out.
    """
    chain, design, bench = analysis.chain, analysis.feedback, analysis.bench
    variables: dict[str, Any] = {
        "units": {"position": bench.units.position, "input": bench.units.input, "time": "s"},
        "parameters": {
            "initial": {row.name: _value(row.initial) for row in analysis.rows},
            "initial_std": {row.name: _std(row.initial) for row in analysis.rows},
            "final": {row.name: _value(row.final) for row in analysis.rows},
            "final_std": {row.name: _std(row.final) for row in analysis.rows},
        },
        "frequency_response": _responses(analysis.frequency_responses),
        "records": _named(
            {
                record.id: {"id": record.id, "kind": record.kind, **record_series(record)}
                for record in analysis.records
            }
        ),
    }
    if chain is not None:
        variables |= dict(zip("ABCD", chain.state_space(), strict=True))
        variables |= {"m": chain.m, "c": chain.c, "k": chain.k}
    if design is not None:
        variables |= {
            "gains": design.gains[None, :],
            "prefilter": design.prefilter,
            "sample_time": design.sample_time,
        }
        if design.Q is not None:
            variables |= {"Q": design.Q, "R": design.R}
        if design.margins is not None:
            values = vars(design.margins).items()
            variables["margins"] = {k: np.nan if v is None else v for k, v in values}
    stream = BytesIO()
    savemat(stream, variables, oned_as="column", long_field_names=True)
    return _HEADER + stream.getvalue()[len(_HEADER) :]


def _value(estimate: Estimate | None) -> float:
    return np.nan if estimate is None else estimate.value


def _std(estimate: Estimate | None) -> float:
    return np.nan if estimate is None or estimate.std is None else estimate.std


def _responses(responses: Sequence[FrequencyResponse]) -> Any:
    """Return a MATLAB array of structures (1, n); an unknown phase is an empty array."""
    names = keys(FrequencyResponse)[:-1]  # without `source`, which is not a number
    array = np.empty((1, len(responses)), dtype=[(name, object) for name in names])
    for i, response in enumerate(responses):
        values = (getattr(response, name) for name in names)
        array[0, i] = tuple(np.zeros((0, 0)) if value is None else value for value in values)
    return array


def _named(records: Mapping[str, Any]) -> dict[str, Any]:
    """Return the records by names that are unique and valid in MATLAB: `step-1` is `step_1`."""
    named: dict[str, Any] = {}
    for id_, record in records.items():
        plain = re.sub(r"\W", "_", id_, flags=re.ASCII)
        if not plain[:1].isalpha() or plain in _RESERVED:
            plain = f"r_{plain}"
        name, count = plain[:_LONGEST_NAME], 1
        while name in named:
            count += 1
            name = f"{plain[: _LONGEST_NAME - 4]}_{count}"
        named[name] = record
    return named
