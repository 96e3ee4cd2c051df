"""Read a `.mat` file: its variables, which of them form the recording, and their columns.

scipy reads version 5, h5py version 7.3. A few changed bytes can crash scipy's reader and its whole
process, so `files` reads files of strangers in a process of their own.
"""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.columns import is_time
from pipeline.ingest.table import (
    MOST_COLUMNS,
    MOST_NAMED,
    SETTING,
    FileTable,
    Format,
    Signal,
    binary_table,
    checked_names,
    not_read,
    printable,
)
from pipeline.words.numbers import first_few

_VECTORS = Format(title="vectors, .mat", positions="unknown", inputs="unknown")
_MATRIX = Format(title="bare matrix, .mat", positions="unknown", inputs="unknown")
_BENCH_LOG = Format(title="bench log, .mat", positions="unknown", inputs="count")
_MOST_SETTINGS = 8  # numbers in a variable; a recording has more samples
_BENCH = ({"enc1", "duty", "time"}, {"cart1pos", "duty_cycle", "t_received"})
_LONGEST_NAME, _DEEPEST = 64, 4  # characters; structs in structs
_NUMBERS = frozenset(
    "double single logical int8 uint8 int16 uint16 int32 uint32 int64 uint64".split()
)


def is_mat(raw: bytes) -> bool:
    """Return whether the first bytes are those of a `.mat` file of version 5 or later."""
    return raw.startswith(b"MATLAB")


def read_mat(raw: bytes, *, source: str) -> list[FileTable]:
    """Read the vectors, or the only matrix, of a `.mat` file.

    Raises
    ------
    SubmissionError : the file is broken, or contains no usable numbers.
    """
    variables = _read_variables(raw, source=source)
    if tables := _structures(variables, source=source):
        return tables
    record = _record(variables, source=source)
    notes: list[str] = []
    columns: dict[str, np.ndarray] = {}
    joined = len(record) > 1
    for signal in record:
        if signal.is_vector:
            columns[signal.name] = signal.numbers.ravel()
            continue
        values = signal.numbers
        if values.shape[0] < values.shape[1]:
            values = values.T
            notes.append(f"{signal.name} is transposed: its rows are read as columns")
        for i, column in enumerate(values.T, start=1):
            columns[f"{signal.name} column {i}" if joined else str(i)] = column
    format = _VECTORS if joined or record[0].is_vector else _MATRIX
    if any(bench <= {signal.name for signal in record} for bench in _BENCH):
        format = _BENCH_LOG
    longest = max(signal.samples for signal in record)
    entries = [
        v.entry(read=v in record, advice="" if v in record else _advice(v, longest=longest))
        for v in variables
    ]
    notes += not_read(entries)
    for name, column in columns.items():
        columns[name] = _unwrap(column)
        if columns[name] is not column:
            notes.append(f"{name}: a {column.dtype} counter that overflowed was made continuous")
    return [
        binary_table(
            [*columns.values()],
            names=[*columns],
            source=source,
            format=format,
            notes=notes,
            variables=entries,
        )
    ]


def _structures(variables: Sequence[Signal], *, source: str) -> list[FileTable]:
    """Return the recordings in structs, or nothing if the file also has vectors.

    Simulink's "structure with time" has the fields `time` and `signals`, whose elements have
    `values` and perhaps a `label`. Other structs have a vector for each signal.
    """
    own = {v.name: v for v in variables}
    if "signals" in own and (table := _structure("", own, source=source)) is not None:
        return [table]
    if sum(v.values is not None and v.samples > _MOST_SETTINGS for v in variables) > 1:
        return []
    found = (
        _structure(v.name, element, source=source) for v in variables for element in v.elements
    )
    return [table for table in found if table is not None]


def _structure(name: str, fields: Mapping[str, Signal], *, source: str) -> FileTable | None:
    elements = fields["signals"].elements if "signals" in fields else ()
    if not elements and not name:
        return None
    parts = [*fields.items()]
    if elements:
        parts = [("time", fields[key]) for key in fields if is_time(key)][:1]
        for one in elements:
            label = printable(one["label"].text.strip()) if "label" in one else ""
            parts += [(label, one["values"])] if "values" in one else []
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
    return binary_table(
        [column for _, column in columns],
        names=checked_names(names, place=f"{source} {name}".strip()),
        source=source,
        format=_VECTORS if named else _MATRIX,
        run=name,
    )


def _record(variables: Sequence[Signal], *, source: str) -> list[Signal]:
    """Return the variables that form the recording; all of them have the same number of samples.

    Raises
    ------
    SubmissionError : no variable is a recording, or its parts do not fit together.
    """
    signals = [v for v in variables if v.values is not None and v.samples > 1]
    if not signals:
        found = first_few([str(v.entry(read=False)) for v in variables], MOST_NAMED) or "nothing"
        told = (f"; {v.name}: {advice}" for v in variables if (advice := _advice(v, longest=0)))
        raise SubmissionError(
            f"{source}: holds no vector or matrix of numbers, but {found}{next(told, '')}"
        )
    signals = [v for v in signals if min(v.size) <= MOST_COLUMNS] or signals
    longest = max(v.samples for v in signals)
    signals = [v for v in signals if v.samples > SETTING * longest]
    vectors = [v for v in signals if v.is_vector]
    if all(v.samples < longest for v in vectors):  # the longest variable is a matrix
        vectors = []
    n = vectors[0].samples if vectors else longest
    matrices = [v for v in signals if not v.is_vector and v.samples == n]
    sizes = first_few([str(v.entry(read=True)) for v in signals], MOST_NAMED)
    if any(v.samples != n for v in vectors):
        raise SubmissionError(f"{source}: the vectors differ in length: {sizes}")
    if not vectors and len(matrices) > 1:
        raise SubmissionError(f"{source}: holds several matrices ({sizes}); keep one")
    if any(bench <= {v.name for v in vectors} for bench in _BENCH):
        matrices = []  # a bench log is complete; other variables were computed from it
    if vectors and len(vectors) + sum(min(v.size) for v in matrices) > MOST_COLUMNS:
        matrices = []
    if sum(min(v.size) for v in (*vectors, *matrices)) > MOST_COLUMNS:
        raise SubmissionError(f"{source}: more than {MOST_COLUMNS} columns: {sizes}")
    return [*vectors, *matrices]


# Advice on variables that may hold a recording, by kind.
_ADVICE = {
    "struct": "if the recording is in it, save its fields: save('new.mat', '-struct', '{name}')",
    "object": "if it is a table or a timetable, write it as text: writetable({name}, 'new.csv') or "
    "writetimetable({name}, 'new.csv')",
    "cell": "if the recording is in it, save each of its vectors as a variable",
    "sparse": "if it is a recording, save full({name})",
    "complex": "if it is a recording, save it as real vectors, one per signal",
    "array of more than two dimensions": "if it is a recording, save it as real vectors, one per "
    "signal",
}


def _advice(variable: Signal, *, longest: int) -> str:
    """Return advice for a variable that may hold a recording; "" for others.

    `longest` is the number of samples of the recording found in the file.
    """
    if variable.values is not None:
        large = "if it is a recording, save it in a separate file: save('new.mat', '{name}')"
        advice = large if variable.samples > MOST_COLUMNS else ""
    else:  # a smaller one cannot hold even the times
        advice = _ADVICE.get(variable.kind, "") if variable.bytes >= 8 * longest else ""
    return advice.format(name=variable.name)


def _unwrap(values: np.ndarray) -> np.ndarray:
    """Undo the overflow of a 16-bit encoder counter: a jump of more than half its range."""
    if values.dtype.kind not in "iu" or values.dtype.itemsize != 2:
        return values
    wide = values.astype(np.float64)
    return np.unwrap(wide, period=2**16) if np.abs(np.diff(wide)).max() > 2**15 else values


# ------------------------------------------------------------------------------- variables


def _read_variables(raw: bytes, *, source: str) -> list[Signal]:
    """Return the variables of a `.mat` file, in the order of the file.

    Raises
    ------
    SubmissionError : the file is broken.
    """
    is_7_3 = raw.startswith(b"MATLAB 7.3") or raw[512:516] == b"\x89HDF"
    try:
        found = _version_7_3(raw) if is_7_3 else _version_5(raw)
        if not all(v.name.isprintable() and len(v.name) <= _LONGEST_NAME for v in found):
            raise ValueError("a name that MATLAB would not write")
    except MemoryError:
        raise
    except Exception:  # scipy and h5py raise many kinds
        raise SubmissionError(f"{source}: the .mat file is damaged or truncated") from None
    return found


def _version_5(raw: bytes) -> list[Signal]:
    from scipy.io import loadmat

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        content = loadmat(BytesIO(raw), mat_dtype=True, chars_as_strings=False)
    if any(issubclass(one.category, np.exceptions.ComplexWarning) for one in said):
        # With `mat_dtype`, scipy drops imaginary parts.
        stored = loadmat(BytesIO(raw), chars_as_strings=False)
        content |= {k: v for k, v in stored.items() if any(map(np.iscomplexobj, _leaves(v)))}
    # Names with two underscores are those of scipy.
    return [_of_scipy(name, one) for name, one in content.items() if not name.startswith("__")]


def _of_scipy(name: str, value: Any, *, depth: int = 0) -> Signal:
    """Return a variable as scipy reads it.

    Raises
    ------
    ValueError : scipy could not read it, or it has no usable name.
    """
    from scipy.io.matlab import MatlabFunction, MatlabObject, MatlabOpaque

    if isinstance(value, MatlabOpaque):  # scipy gives its name as a value
        return Signal(name=value.flat[0]["s0"].decode("ascii"), kind="object")
    if not isinstance(value, np.ndarray):
        if isinstance(value, str):  # scipy's error
            raise ValueError(value)
        return Signal(name=name, kind="sparse", size=value.shape, bytes=16 * value.nnz)
    if value.dtype.kind == "U":
        text = "".join(value.ravel())[:_LONGEST_NAME]
        return Signal(name=name, kind="text", size=value.shape, bytes=value.nbytes, text=text)
    if not value.dtype.hasobject:
        return _matrix(name, value)
    taken = sum(getattr(leaf, "nbytes", 0) for leaf in _leaves(value))
    kind = "struct" if value.dtype.names else "cell"
    if isinstance(value, MatlabFunction | MatlabObject):
        kind = "function" if isinstance(value, MatlabFunction) else "object"
    elements: tuple[dict[str, Signal], ...] = ()
    if kind == "struct" and depth < _DEEPEST:
        elements = tuple(
            {key: _of_scipy(key, one[key], depth=depth + 1) for key in value.dtype.names or ()}
            for one in value.flat
        )
    return Signal(name=name, kind=kind, size=value.shape, bytes=taken, elements=elements)


def _leaves(value: Any) -> Iterator[Any]:
    """Yield all arrays in a cell array or a struct; another variable itself."""
    if not isinstance(value, np.ndarray) or not value.dtype.hasobject:
        yield value
        return
    for one in value.flat:
        for part in one if value.dtype.names else [one]:
            yield from _leaves(part)


def _version_7_3(raw: bytes) -> list[Signal]:
    import h5py

    with h5py.File(BytesIO(raw), "r") as file:
        return [*_of_group(file, depth=0, seen=set()).values()]


def _of_group(group: Any, *, depth: int, seen: set[int]) -> dict[str, Signal]:
    """Return the variables in an HDF5 file, or the fields of a struct in it.

    `seen` are the addresses of objects: MATLAB writes each once, a bomb gives one a million names.

    Raises
    ------
    ValueError : a name is not usable, or its numbers are in another file.
    """
    import h5py

    found: dict[str, Signal] = {}
    for name in map(str, group):
        if name.startswith("#"):  # parts of MATLAB's cells and objects
            continue
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            raise ValueError(name)
        item = group[name]
        address = hash(item)  # h5py computes it from the address
        if address in seen:
            raise ValueError(name)
        seen.add(address)
        if isinstance(item, h5py.Dataset):
            found[name] = _of_data_set(name, item)
        elif isinstance(item, h5py.Group):  # a named type has no numbers
            kind = "sparse" if "MATLAB_sparse" in item.attrs else "struct"
            inner = _of_group(item, depth=depth + 1, seen=seen) if depth < _DEEPEST else {}
            taken = sum(v.bytes if v.values is None else v.values.nbytes for v in inner.values())
            elements = (inner,) if kind == "struct" else ()
            found[name] = Signal(name=name, kind=kind, size=(1, 1), bytes=taken, elements=elements)
    return found


def _of_data_set(name: str, item: Any) -> Signal:
    if item.is_virtual or item.external:
        raise ValueError(name)
    size = tuple(reversed(item.shape)) if len(item.shape) > 1 else (item.size, 1)
    kind, pair = _class_of(item), item.dtype.names == ("real", "imag")
    parts = [item.dtype[part] for part in item.dtype.names] if pair else [item.dtype]
    if kind in _NUMBERS and not all(part.kind in "biuf" and not part.shape for part in parts):
        kind = "unknown"
    if kind not in _NUMBERS:
        return Signal(name=name, kind=kind, size=size, bytes=item.nbytes)
    values = np.atleast_1d(item[()])
    values = values["real"] + 1j * values["imag"] if pair else values
    return _matrix(name, values.T.reshape(size))


def _class_of(item: Any) -> str:
    """Return MATLAB's class of a data set; numbers without a stated class are "double"."""
    if "MATLAB_empty" in item.attrs:
        return "empty"
    of = item.attrs.get("MATLAB_class", b"double" if item.dtype.kind in "fiu" else b"unknown")
    name = of.decode("ascii") if isinstance(of, bytes) else str(of)
    if not name.isprintable() or len(name) > _LONGEST_NAME:
        return "unknown"
    if name not in _NUMBERS and "MATLAB_object_decode" in item.attrs:
        return "object"
    return "text" if name == "char" else name


def _matrix(name: str, values: np.ndarray) -> Signal:
    """Return a variable with its numbers, or with a description if it is not a real matrix."""
    kind = "empty" if 0 in values.shape else "complex" if np.iscomplexobj(values) else ""
    if len(values.shape) != 2:
        kind = "array of more than two dimensions"
    if kind:
        return Signal(name=name, kind=kind, size=values.shape, bytes=values.nbytes)
    dtype = np.dtype("u1") if values.dtype == bool else values.dtype.newbyteorder("=")
    values = values.astype(dtype)
    return Signal(name=name, values=values, kind=str(dtype), size=values.shape)
