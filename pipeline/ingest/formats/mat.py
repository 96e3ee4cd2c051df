"""Find the recording in a `.mat` file: which variables form it, and their columns."""

from collections.abc import Mapping, Sequence

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.headings import is_time
from pipeline.ingest.formats.mat_variables import MatVariable, read_variables
from pipeline.ingest.formats.table import (
    MOST_COLUMNS,
    FileTable,
    checked_names,
    not_read,
    refuse_unusable,
)
from pipeline.words.numbers import first_few

_MAX_COLUMNS = 64
_MOST_SETTINGS = 8  # numbers in a variable; a recording has more samples
_MOST_NAMED = 8
_BENCH = ({"enc1", "duty", "time"}, {"cart1pos", "duty_cycle", "t_received"})


def read_mat(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the vectors, or the only matrix, of a `.mat` file.

    Raises
    ------
    SubmissionError : the file is broken, or contains no usable numbers.
    """
    variables = read_variables(raw, source=source)
    if tables := _structures(variables, source=source):
        return tables
    record = _record(variables, source=source)
    notes: list[str] = []
    names, arrays = [], []
    joined = len(record) > 1
    for variable in record:
        values = variable.numbers
        if variable.is_vector:
            names.append(variable.name)
            arrays.append(values.ravel())
            continue
        if values.shape[0] < values.shape[1]:
            values = values.T
            notes.append(f"{variable.name} is transposed: its rows are read as columns")
        arrays += list(values.T)
        numbers = range(1, values.shape[1] + 1)
        names += [f"{variable.name} column {i}" if joined else str(i) for i in numbers]
    used = {variable.name for variable in record}
    longest = max(variable.samples for variable in record)
    form = "variables" if joined or record[0].is_vector else "matrix"
    if any(bench <= used for bench in _BENCH):
        form = "bench_mat"
    made = tuple(
        v.entry(read=True)
        if v in record
        else v.entry(read=False, advice=_advice(v, longest=longest))
        for v in variables
    )
    notes += not_read([variable for variable in made if not variable.read])
    columns = []
    for name, column in zip(names, arrays, strict=True):
        wide = column.astype(np.float64)
        refuse_unusable(wide[None, :], names=[name], place=lambda row: f"{source} sample {row + 1}")
        unwrapped = _unwrap(wide, column.dtype)
        if unwrapped is not wide:
            notes.append(f"{name}: a {column.dtype} counter that overflowed was made continuous")
        columns.append(unwrapped)
    values = np.array(columns)
    return [
        FileTable(
            source=source,
            form=form,
            names=tuple(names),
            values=values,
            whole=tuple(bool((column == np.round(column)).all()) for column in values),
            lines=None,
            notes=tuple(notes),
            variables=made,
        )
    ]


def _structures(variables: Sequence[MatVariable], *, source: str) -> list[FileTable]:
    """Return the recordings in structs, or nothing if the file also has vectors.

    Simulink's "structure with time" has the fields `time` and `signals`, whose elements have
    `values` and perhaps a `label`. Other structs have a vector for each signal.
    """
    whole = {v.name: v for v in variables}
    if (one := _structure("", whole, source=source)) is not None:
        return [one]
    if sum(v.values is not None and v.samples > _MOST_SETTINGS for v in variables) > 1:
        return []
    found = (
        _structure(v.name, element, source=source) for v in variables for element in v.elements
    )
    return [table for table in found if table is not None]


def _structure(name: str, fields: Mapping[str, MatVariable], *, source: str) -> FileTable | None:
    signals = fields.get("signals")
    elements = signals.elements if signals else ()
    if not elements and not name:
        return None
    time = next((fields[key] for key in fields if is_time(key)), None)
    if elements:
        parts = [(_label(one), one["values"]) for one in elements if "values" in one]
        parts = [("time", time), *parts] if time else parts
    else:
        parts = [*fields.items()]
    parts = [(label, v) for label, v in parts if v.values is not None and v.samples > 1]
    longest = max((v.samples for _, v in parts), default=0)
    columns: list[tuple[str, np.ndarray]] = []
    for label, v in parts:
        values = v.numbers if v.numbers.shape[0] == longest else v.numbers.T
        if values.shape[0] == longest and values.shape[1] <= MOST_COLUMNS:
            label = label if values.shape[1] == 1 else ""  # it does not name several signals
            columns += [(label, column) for column in values.T]
    if len(columns) < 2 or longest <= _MOST_SETTINGS:
        return None
    named = all(label for label, _ in columns)
    names = [label if named else str(i) for i, (label, _) in enumerate(columns, start=1)]
    names = checked_names(names, place=f"{source} {name}".strip())
    values = np.array([column.astype(np.float64) for _, column in columns])
    refuse_unusable(values, names=names, place=lambda row: f"{source} sample {row + 1}")
    return FileTable(
        source=source,
        form="variables" if named else "matrix",
        names=tuple(names),
        values=values,
        whole=tuple(bool((column == np.round(column)).all()) for column in values),
        lines=None,
        run=name,
    )


def _label(element: Mapping[str, MatVariable]) -> str:
    """Return the label of a signal of Simulink, or ""."""
    text = element["label"].text.strip() if "label" in element else ""
    return text if text.isprintable() else ""


def _record(variables: Sequence[MatVariable], *, source: str) -> list[MatVariable]:
    """Return the variables that form the recording; all of them have the same number of samples.

    Raises
    ------
    SubmissionError : no variable is a recording, or its parts do not fit together.
    """
    signals = [v for v in variables if v.values is not None and v.samples > 1]
    if not signals:
        found = first_few([str(v) for v in variables], _MOST_NAMED) or "nothing"
        told = {v.name: advice for v in variables if (advice := _advice(v, longest=0))}
        first = next((f"; {name}: {advice}" for name, advice in told.items()), "")
        raise SubmissionError(f"{source}: holds no vector or matrix of numbers, but {found}{first}")
    signals = [v for v in signals if min(v.size) <= _MAX_COLUMNS] or signals
    longest = max(v.samples for v in signals)
    # Shorter than a tenth of the longest, a variable holds gains or poles, not a truncated signal.
    signals = [v for v in signals if v.samples > 0.1 * longest]
    sizes = first_few([str(v) for v in signals], _MOST_NAMED)
    vectors = [v for v in signals if v.is_vector]
    if all(v.samples < longest for v in vectors):  # the longest variable is a matrix
        vectors, signals = [], [v for v in signals if v.samples == longest]
    if len({v.samples for v in vectors}) > 1:
        raise SubmissionError(f"{source}: the vectors differ in length: {sizes}")
    matrices = [v for v in signals if not v.is_vector]
    if not vectors and len(matrices) > 1:
        raise SubmissionError(f"{source}: holds several matrices ({sizes}); keep one")
    if len(vectors) > _MAX_COLUMNS:
        raise SubmissionError(f"{source}: holds more than {_MAX_COLUMNS} vectors")
    if not vectors:
        if min(matrices[0].size) > _MAX_COLUMNS:
            raise SubmissionError(f"{source}: {matrices[0]} has more than {_MAX_COLUMNS} columns")
        return matrices
    if any(bench <= {v.name for v in vectors} for bench in _BENCH):
        return vectors  # a bench log is complete; other variables were computed from it
    matrices = [matrix for matrix in matrices if matrix.samples == vectors[0].samples]
    columns = len(vectors) + sum(min(matrix.size) for matrix in matrices)
    return [*vectors, *matrices] if columns <= _MAX_COLUMNS else vectors


def _advice(variable: MatVariable, *, longest: int) -> str:
    """Return advice for a variable that may hold a recording; "" for others.

    `longest` is the number of samples of the recording found in the file.
    """
    name = variable.name
    if variable.values is not None:
        if variable.samples <= _MAX_COLUMNS:
            return ""
        return f"if it is a recording, save it in a separate file: save('new.mat', '{name}')"
    if variable.bytes < 8 * longest:  # too small to hold even the times
        return ""
    match variable.kind:
        case "struct":
            return (
                f"if the recording is in it, save its fields: save('new.mat', '-struct', '{name}')"
            )
        case "object":
            return (
                "if it is a table or a timetable, write it as text: "
                f"writetable({name}, 'new.csv') or writetimetable({name}, 'new.csv')"
            )
        case "cell":
            return "if the recording is in it, save each of its vectors as a variable"
        case "sparse":
            return f"if it is a recording, save full({name})"
        case "complex" | "array of more than two dimensions" | "no real matrix":
            return "if it is a recording, save it as real vectors, one per signal"
    return ""


def _unwrap(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Undo the overflow of a 16-bit encoder counter: a jump of more than half its range."""
    if dtype.kind not in "iu" or dtype.itemsize != 2 or np.abs(np.diff(values)).max() <= 2**15:
        return values
    return np.unwrap(values, period=2**16)
