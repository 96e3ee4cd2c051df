"""Save an analysis for other programs: `tables/*.csv`, and `results.mat` for MATLAB.

The same analysis always gives the same bytes.
"""

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.io import savemat

from pipeline.json_files import keys, plain
from pipeline.output import csv_text, own_folder, write_file
from pipeline.report.tables import record_series, tables
from pipeline.results import Analysis, Estimate, FrequencyResponse

if TYPE_CHECKING:
    import pandas as pd

_HEADER = b"MATLAB 5.0 MAT-file".ljust(116)  # scipy's own header contains the time
_LONGEST_NAME = 63  # most characters in the name of a MATLAB variable
_RESERVED = set(
    "break case catch classdef continue else elseif end for function global if otherwise parfor "
    "persistent return spmd switch try while".split()
)


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
