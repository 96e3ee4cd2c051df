"""MATLAB `.mat` files (versions 4 to 7): their real matrices and nothing else.

A hostile file can ask scipy's reader for gigabytes or for objects to build; a log of a bench is
a handful of plain vectors. So only those are read here, every length checked first. Layout:
"MAT-File Format", The MathWorks, R2023b.
"""

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import Form, Table, Variable, refuse_unusable
from pipeline.names import first_few

_MAX_INFLATED_BYTES = 200_000_000
_MAX_COLUMNS = 64
_MOST_NAMED = 8
_MOST_VARIABLES, _MOST_DIMENSIONS, _LONGEST_NAME = 1000, 32, 64  # no workspace has more
_SETTINGS = 0.1  # of the longest: what is shorter is gains or a list of poles, no signal cut short
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_OTHER_CLASSES = {
    1: "cell", 2: "struct", 3: "object", 4: "text", 5: "sparse", 16: "function", 17: "object",
}  # fmt: skip
_OPAQUE = 17  # an object: its name stands where others have their size
_V4_TYPES = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}
_BENCH = ({"enc1", "duty", "time"}, {"cart1pos", "duty_cycle", "t_received"})


class _Broken(Exception):
    """The bytes do not follow the format."""


@dataclass(frozen=True, eq=False)
class _Variable:
    name: str
    values: np.ndarray | None  # None: not a real matrix
    kind: str
    shape: tuple[int, ...] = ()  # where there are no values …
    bytes: int = 0  # … and how many bytes it takes

    @property
    def size(self) -> tuple[int, ...]:
        return self.shape if self.values is None else self.values.shape

    @property
    def samples(self) -> int:
        return max(self.numbers.shape)

    @property
    def numbers(self) -> np.ndarray:
        assert self.values is not None
        return self.values

    def made(self, *, read: bool, advice: str = "") -> Variable:
        return Variable(name=self.name, size=self.size, kind=self.kind, read=read, advice=advice)

    def __str__(self) -> str:
        return str(self.made(read=False))


def is_mat(raw: bytes) -> bool:
    """Tell a `.mat` file by its first bytes."""
    return raw.startswith(b"MATLAB") or _is_v4(raw)


def read_mat(raw: bytes, *, source: str) -> Table:
    """Read the vectors, or the one matrix, of a `.mat` file.

    Raises
    ------
    SubmissionError : a version 7.3 file, a broken file, or no usable numbers in it.
    """
    if raw[:10] == b"MATLAB 7.3" or raw[512:516] == b"\x89HDF":
        raise SubmissionError(f"{source}: a MATLAB 7.3 file; save it again with save(…, '-v7')")
    try:
        read = _v4(raw) if _is_v4(raw) else _v5(raw)
        variables = list(islice(read, _MOST_VARIABLES + 1))
    except (_Broken, struct.error, zlib.error, ValueError, OverflowError, UnicodeDecodeError):
        raise SubmissionError(f"{source}: the .mat file is broken or cut short") from None
    if len(variables) > _MOST_VARIABLES:
        raise SubmissionError(
            f"{source}: holds more than {_MOST_VARIABLES:,} variables; keep those of the recording"
        )
    return _table(variables, source=source)


# ----------------------------------------------------------------------- variables to columns


def _table(variables: list[_Variable], *, source: str) -> Table:
    record = _record(variables, source=source)
    notes: list[str] = []
    names, arrays = [], []
    joined = len(record) > 1
    for variable in record:
        values = variable.numbers
        if _is_vector(values):
            names.append(variable.name)
            arrays.append(values.ravel())
            continue
        if values.shape[0] < values.shape[1]:
            values = values.T
            notes.append(f"{variable.name} lies on its side: its rows are taken as the columns")
        arrays += list(values.T)
        numbers = range(1, values.shape[1] + 1)
        names += [f"{variable.name} column {i}" if joined else str(i) for i in numbers]
    used = {variable.name for variable in record}
    longest = max(variable.samples for variable in record)
    form: Form = "variables" if joined or _is_vector(record[0].numbers) else "matrix"
    if any(bench <= used for bench in _BENCH):
        form = "bench_mat"
    made = tuple(
        v.made(read=True) if v in record else v.made(read=False, advice=_advice(v, longest=longest))
        for v in variables
    )
    notes += _not_read([variable for variable in made if not variable.read])
    columns = []
    for name, column in zip(names, arrays, strict=True):
        wide = column.astype(np.float64)
        refuse_unusable(wide[None, :], names=[name], place=lambda row: f"{source} sample {row + 1}")
        unwrapped = _unwrap(wide, column.dtype)
        if unwrapped is not wide:
            notes.append(f"{name}: a {column.dtype} counter that ran over was made continuous")
        columns.append(unwrapped)
    values = np.array(columns)
    return Table(
        source=source,
        form=form,
        names=tuple(names),
        values=values,
        whole=tuple(bool((column == np.round(column)).all()) for column in values),
        lines=None,
        notes=tuple(notes),
        variables=made,
    )


def _record(variables: Sequence[_Variable], *, source: str) -> list[_Variable]:
    """Return the variables that are the recording: those with as many samples as the longest.

    Raises
    ------
    SubmissionError : there is none, or its parts do not go together.
    """
    signals = [v for v in variables if v.values is not None and v.samples > 1]
    if not signals:
        found = first_few([str(v) for v in variables], _MOST_NAMED) or "nothing"
        told = {v.name: advice for v in variables if (advice := _advice(v, longest=0))}
        first = next((f"; {name}: {advice}" for name, advice in told.items()), "")
        raise SubmissionError(f"{source}: holds no vector or matrix of numbers, but {found}{first}")
    signals = [v for v in signals if min(v.size) <= _MAX_COLUMNS] or signals
    longest = max(v.samples for v in signals)
    signals = [v for v in signals if v.samples > _SETTINGS * longest]
    sizes = first_few([str(v) for v in signals], _MOST_NAMED)
    vectors = [v for v in signals if _is_vector(v.numbers)]
    if all(v.samples < longest for v in vectors):  # a matrix has more
        vectors, signals = [], [v for v in signals if v.samples == longest]
    if len({v.samples for v in vectors}) > 1:
        raise SubmissionError(f"{source}: the vectors differ in length: {sizes}")
    matrices = [v for v in signals if not _is_vector(v.numbers)]
    if not vectors and len(matrices) > 1:
        raise SubmissionError(f"{source}: holds several matrices ({sizes}); keep one")
    if len(vectors) > _MAX_COLUMNS:
        raise SubmissionError(f"{source}: holds more than {_MAX_COLUMNS} vectors")
    if not vectors:
        if min(matrices[0].size) > _MAX_COLUMNS:
            raise SubmissionError(f"{source}: {matrices[0]} has more than {_MAX_COLUMNS} columns")
        return matrices
    if any(bench <= {v.name for v in vectors} for bench in _BENCH):
        return vectors  # a bench log is complete; what lies beside it was made of it
    matrices = [matrix for matrix in matrices if matrix.samples == vectors[0].samples]
    columns = len(vectors) + sum(min(matrix.size) for matrix in matrices)
    return [*vectors, *matrices] if columns <= _MAX_COLUMNS else vectors


def _not_read(variables: Sequence[Variable]) -> list[str]:
    """Return a note on each variable that is not read, the largest first."""
    large = [v for v in variables if v.advice]
    large.sort(key=lambda v: -math.prod(v.size))
    notes = [f"not read: {v}; {v.advice}" for v in large[:_MOST_NAMED]]
    alike: dict[str, list[str]] = {}
    for v in (*large[_MOST_NAMED:], *(v for v in variables if not v.advice)):
        alike.setdefault(str(v).removeprefix(v.name), []).append(v.name)
    rest = [first_few(names, _MOST_NAMED) + what for what, names in alike.items()]
    return notes + ([f"not read: {first_few(rest, _MOST_NAMED)}"] if rest else [])


def _advice(variable: _Variable, *, longest: int) -> str:
    """Return what to do for a variable that may hold a recording to be read; "" of others.

    `longest` is how many samples the recording has that was found beside it.
    """
    name = variable.name
    if variable.values is not None:
        if variable.samples <= _MAX_COLUMNS:
            return ""
        return f"if it is a recording, save it in a file of its own: save('new.mat', '{name}')"
    if variable.bytes < 8 * longest:  # too few for the times alone
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
            return "if it is a recording, save it as real vectors, one a signal"
    return ""


def _is_vector(values: np.ndarray) -> bool:
    return values.size > 1 and min(values.shape) == 1


def _unwrap(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Undo the overflow of a 16-bit encoder counter: a jump of more than half its range."""
    if dtype.kind not in "iu" or dtype.itemsize != 2 or np.abs(np.diff(values)).max() <= 2**15:
        return values
    return np.unwrap(values, period=2**16)


# ------------------------------------------------------------------------- versions 5 to 7


def _v5(raw: bytes) -> Iterator[_Variable]:
    if len(raw) < 128 or raw[126:128] not in (b"IM", b"MI"):
        raise _Broken
    order = "<" if raw[126:128] == b"IM" else ">"
    inflated = 0
    at = 128
    while at + 8 <= len(raw):
        kind, size = struct.unpack_from(order + "II", raw, at)
        content = raw[at + 8 : at + 8 + size]
        if len(content) < size:
            raise _Broken
        at += 8 + size
        if kind == _COMPRESSED:
            decompressor = zlib.decompressobj()
            content = decompressor.decompress(content, _MAX_INFLATED_BYTES - inflated + 1)
            inflated += len(content)
            if inflated > _MAX_INFLATED_BYTES:
                raise _Broken
            if len(content) < 8:
                raise _Broken
            kind, size = struct.unpack_from(order + "II", content)
            content = content[8 : 8 + size]
            if len(content) < size:
                raise _Broken
        if kind == _MATRIX and content:
            variable = _matrix(content, order)
            if variable.name:  # MATLAB keeps what its objects share without a name
                yield variable
    if at < len(raw) and raw[at:].strip(b"\0"):
        raise _Broken


def _element(content: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Return (type, bytes, where the next element starts) of the element at `at`."""
    (word,) = struct.unpack_from(order + "I", content, at)
    if word >> 16:  # the short form: type, size and up to four bytes in eight
        kind, size, start, after = word & 0xFFFF, word >> 16, at + 4, at + 8
        if size > 4:
            raise _Broken
    else:
        kind, size = struct.unpack_from(order + "II", content, at)
        start = at + 8
        after = start + (size + 7) // 8 * 8
    data = content[start : start + size]
    if len(data) < size:
        raise _Broken
    return kind, data, after


def _matrix(content: bytes, order: str) -> _Variable:
    _, flags, at = _element(content, 0, order)
    (flag,) = struct.unpack_from(order + "I", flags)
    code = flag & 0xFF
    shape: tuple[int, ...] = ()
    if code != _OPAQUE:
        _, dims, at = _element(content, at, order)
        if len(dims) > 4 * _MOST_DIMENSIONS:
            raise _Broken
        shape = tuple(int(d) for d in np.frombuffer(dims, dtype=order + "i4"))
    _, name, at = _element(content, at, order)
    label = name.decode("ascii")
    if not label.isprintable() or len(label) > _LONGEST_NAME:
        raise _Broken
    if code not in _CLASSES:
        kind = _OTHER_CLASSES.get(code, "unknown")
        return _Variable(label, None, kind, shape, len(content))
    if flag & 0x0800:
        return _Variable(label, None, "complex", shape, len(content))
    if len(shape) != 2 or min(shape) < 0:
        return _Variable(label, None, "array of more than two dimensions", shape, len(content))
    if 0 in shape:
        return _Variable(label, None, "empty", shape)
    kind, data, _ = _element(content, at, order)
    if kind not in _NUMBERS:
        raise _Broken
    numbers = np.frombuffer(data, dtype=order + _NUMBERS[kind])
    if numbers.size != shape[0] * shape[1]:
        raise _Broken
    stored = numbers.astype(_CLASSES[code])  # MATLAB stores whole doubles as short integers
    return _Variable(label, stored.reshape(shape, order="F"), str(stored.dtype))


# ----------------------------------------------------------------------------- version 4


def _is_v4(raw: bytes) -> bool:
    return _v4_header(raw, 0) is not None


def _v4_header(raw: bytes, at: int) -> tuple[str, str, int, int, int, bool] | None:
    """Return (order, type, rows, columns, length of the name, complex), or None."""
    if len(raw) < at + 20:
        return None
    for order in "<>":
        code, rows, columns, imaginary, length = struct.unpack_from(order + "5i", raw, at)
        machine, _, precision, kind = code // 1000, code // 100 % 10, code // 10 % 10, code % 10
        if (
            0 <= code < 5000
            and machine == (0 if order == "<" else 1)
            and code // 100 % 10 == 0
            and precision in _V4_TYPES
            and kind in (0, 1)
            and rows >= 0
            and columns >= 0
            and imaginary in (0, 1)
            and 1 < length <= 64
        ):
            return order, _V4_TYPES[precision], rows, columns, length, imaginary == 1 or kind == 1
    return None


def _v4(raw: bytes) -> Iterator[_Variable]:
    at = 0
    while at < len(raw):
        header = _v4_header(raw, at)
        if header is None:
            raise _Broken
        order, kind, rows, columns, length, unusable = header
        label = raw[at + 20 : at + 20 + length].rstrip(b"\0").decode("ascii")
        at += 20 + length
        size = rows * columns * np.dtype(kind).itemsize * (2 if unusable else 1)
        data = raw[at : at + rows * columns * np.dtype(kind).itemsize]
        at += size
        if at > len(raw) or not label.isprintable():
            raise _Broken
        if unusable or rows == 0 or columns == 0:
            yield _Variable(label, None, "no real matrix", (rows, columns), size)
            continue
        values = np.frombuffer(data, dtype=order + kind).reshape((rows, columns), order="F")
        yield _Variable(label, values.astype(kind), kind)
