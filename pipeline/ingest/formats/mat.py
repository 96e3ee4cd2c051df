"""MATLAB `.mat` files (versions 4 to 7): their real matrices and nothing else.

A hostile file can ask scipy's reader for gigabytes or for objects to build; a log of a bench is
a handful of plain vectors. So only those are read here, every length checked first. Layout:
"MAT-File Format", The MathWorks, R2023b.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import Form, Table, refuse_unusable

_MAX_INFLATED_BYTES = 200_000_000
_MAX_COLUMNS = 64
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
_V4_TYPES = {0: "f8", 1: "f4", 2: "i4", 3: "i2", 4: "u2", 5: "u1"}
_BENCH = ({"enc1", "duty", "time"}, {"cart1pos", "duty_cycle", "t_received"})


class _Broken(Exception):
    """The bytes do not follow the format."""


@dataclass(frozen=True)
class _Variable:
    name: str
    values: np.ndarray | None  # None: not a real matrix
    kind: str


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
        variables = list(_v4(raw) if _is_v4(raw) else _v5(raw))
    except (_Broken, struct.error, zlib.error, ValueError, OverflowError, UnicodeDecodeError):
        raise SubmissionError(f"{source}: the .mat file is broken or cut short") from None
    return _table(variables, source=source)


# ----------------------------------------------------------------------- variables to columns


def _table(variables: list[_Variable], *, source: str) -> Table:
    usable = [v for v in variables if v.values is not None]
    vectors = [v for v in usable if v.values is not None and _is_vector(v.values)]
    matrices = [v for v in usable if v.values is not None and min(v.values.shape) > 1]
    if not vectors and not matrices:
        kinds = ", ".join(f"{v.name} ({v.kind})" for v in variables[:8]) or "nothing"
        raise SubmissionError(f"{source}: holds no vector or matrix of numbers, but {kinds}")
    notes: list[str] = []
    if vectors:
        names = [v.name for v in vectors]
        lengths = {v.values.size for v in vectors if v.values is not None}
        if len(lengths) > 1:
            sizes = ", ".join(f"{v.name} {v.values.size}" for v in vectors if v.values is not None)
            raise SubmissionError(f"{source}: the vectors differ in length: {sizes}")
        arrays = [v.values.ravel() for v in vectors if v.values is not None]
        used = set(names)
        form: Form = "bench_mat" if any(b <= used for b in _BENCH) else "variables"
    else:
        if len(matrices) > 1:
            listed = ", ".join(v.name for v in matrices[:8])
            raise SubmissionError(f"{source}: holds several matrices ({listed}); keep one")
        matrix = matrices[0].values
        assert matrix is not None
        if matrix.shape[0] < matrix.shape[1]:
            matrix = matrix.T
            notes.append(f"{matrices[0].name} lies on its side: its rows are taken as the columns")
        if matrix.shape[1] > _MAX_COLUMNS:
            raise SubmissionError(
                f"{source}: {matrices[0].name} has more than {_MAX_COLUMNS} columns"
            )
        arrays = list(matrix.T)
        names = [str(i) for i in range(1, len(arrays) + 1)]
        used = {matrices[0].name}
        form = "matrix"
    if len(names) > _MAX_COLUMNS:
        raise SubmissionError(f"{source}: holds more than {_MAX_COLUMNS} vectors")
    left_out = [f"{v.name} ({v.kind})" for v in variables if v.name not in used]
    if left_out:
        notes.append(f"not read: {', '.join(left_out[:8])}")
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
    )


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
            yield _matrix(content, order)
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
    _, dims, at = _element(content, at, order)
    _, name, at = _element(content, at, order)
    (flag,) = struct.unpack_from(order + "I", flags)
    label = name.decode("ascii")
    if not label.isprintable():
        raise _Broken
    if (flag & 0xFF) not in _CLASSES:
        return _Variable(label, None, _OTHER_CLASSES.get(flag & 0xFF, "unknown"))
    if flag & 0x0800:
        return _Variable(label, None, "complex")
    shape = tuple(int(d) for d in np.frombuffer(dims, dtype=order + "i4"))
    if len(shape) != 2 or min(shape) < 0:
        return _Variable(label, None, "array of more than two dimensions")
    if 0 in shape:
        return _Variable(label, None, "empty")
    kind, data, _ = _element(content, at, order)
    if kind not in _NUMBERS:
        raise _Broken
    numbers = np.frombuffer(data, dtype=order + _NUMBERS[kind])
    if numbers.size != shape[0] * shape[1]:
        raise _Broken
    stored = numbers.astype(_CLASSES[flag & 0xFF])  # MATLAB stores whole doubles as short integers
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
            yield _Variable(label, None, "no real matrix")
            continue
        values = np.frombuffer(data, dtype=order + kind).reshape((rows, columns), order="F")
        yield _Variable(label, values.astype(kind), kind)
