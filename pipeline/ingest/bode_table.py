"""Tables of amplitude ratios that the students computed themselves."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import SubmissionError
from pipeline.ingest.columns import Column, conversion
from pipeline.ingest.table import FileTable, refuse_extreme
from pipeline.results import FrequencyResponse

# relative standard error of a ratio read off two plots, assumed if there are no repeats
_RATIO_SPREAD = 0.01
Points = dict[int, list[tuple[float, float]]]


def read_points(table: FileTable, columns: Mapping[str, Column], *, carts: Sequence[int]) -> Points:
    """Return (omega in rad/s, amplitude ratio) for every row, by cart.

    Raises
    ------
    SubmissionError : the table has no frequencies or no ratios, or a value is not positive.
    """
    if "frequency" not in columns:
        raise SubmissionError(
            f"{table.source}: a bode table needs a column 'frequency' (Hz); "
            f"it has {table.headings()}"
        )
    measured = [c for role, c in columns.items() if role[0] == "x" and c.cart in carts]
    if not measured:
        raise SubmissionError(
            f"{table.source}: a bode table needs amplitude ratios in 'x1', 'x2', …; "
            f"it has {table.headings()}"
        )
    frequency = columns["frequency"]
    is_omega = frequency.name.casefold().startswith(("omega", "w"))
    factor = conversion(frequency.unit or ("rad/s" if is_omega else None), "Hz")
    if factor is None:
        raise SubmissionError(
            f"{table.source}: {frequency.name!r} is in {frequency.unit}, expected Hz"
        )
    omega = _measured(2 * np.pi * factor * _positive(table, frequency), table, frequency)
    return {
        column.cart: list(zip(omega.tolist(), _ratios(table, column).tolist(), strict=True))
        for column in measured
    }


def _ratios(table: FileTable, column: Column) -> Array:
    if column.unit is not None and column.unit.casefold() == "db":
        with np.errstate(over="ignore"):
            return _measured(10 ** (table.values[column.index] / 20), table, column)
    return _measured(_positive(table, column), table, column)


def _measured(values: Array, table: FileTable, column: Column) -> Array:
    """Return the values, after checking that they are positive and possible on a bench."""
    for extreme in (values.min(), values.max()):
        refuse_extreme(extreme, what=f"{table.source}: {column.name!r}")
    return values


def _positive(table: FileTable, column: Column) -> Array:
    values = table.values[column.index]
    if (values <= 0).any():
        row = int(np.argmax(values <= 0))
        raise SubmissionError(
            f"{table.source} {table.place(row)}: {column.name!r} must be above 0, "
            f"found {values[row]:g}"
        )
    return values


def frequency_responses(
    points: Points, *, experiments: Sequence[str] = ()
) -> tuple[tuple[FrequencyResponse, ...], str]:
    """Return one response per cart with repeats averaged, and the source of its standard errors.

    Rows at one frequency are repeats. Their pooled relative spread is the standard error of all
    points. If there are too few repeats, 1 % is assumed.
    """
    squares, freedom = 0.0, 0
    averaged: dict[int, tuple[Array, Array, Array]] = {}
    for cart, rows in sorted(points.items()):
        omega, which = np.unique(np.round([w for w, _ in rows], 9), return_inverse=True)
        logs = np.log([ratio for _, ratio in rows])
        repeats = np.bincount(which).astype(np.float64)
        means: Array = np.bincount(which, weights=logs) / repeats
        squares += float(((logs - means[which]) ** 2).sum())
        freedom += logs.size - omega.size
        averaged[cart] = (omega, np.exp(means), repeats)
    # Fewer than three degrees of freedom do not show the true spread.
    spread = np.sqrt(squares / freedom) if freedom >= 3 and squares > 0 else None
    relative = _RATIO_SPREAD if spread is None else float(spread)
    source = (
        f"standard errors of the amplitude ratios are taken as {_RATIO_SPREAD:.0%}, because the "
        f"table has no repeats"
        if spread is None
        else f"standard errors of the amplitude ratios are {relative:.2%}, from {freedom} repeats"
    )
    responses = tuple(
        FrequencyResponse(
            cart=cart,
            omega=omega,
            magnitude=magnitude,
            magnitude_std=relative * magnitude / np.sqrt(repeats),
            phase=None,
            phase_std=None,
            source="table",
            experiments=tuple(experiments),
        )
        for cart, (omega, magnitude, repeats) in averaged.items()
    )
    return responses, source
