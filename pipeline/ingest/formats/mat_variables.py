"""Read the variables of a `.mat` file: versions 4 to 7 here, version 7.3 with h5py.

A hostile file can demand gigabytes, an endless loop or another file on the disk. In scipy's reader,
a few changed bytes can crash the whole process. So only real matrices are read, and they are
decompressed only to the size that a recording can have. Layout: "MAT-File Format", The MathWorks,
R2023b.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import islice
from typing import Any

import numpy as np

from pipeline.errors import SubmissionError
from pipeline.ingest.formats.table import Variable

_MOST_BYTES = 200_000_000  # largest total size of all variables, decompressed
_MOST_VARIABLES, _LONGEST_NAME = 1000, 64  # no workspace has more
_MOST_DIMENSIONS = 32
_MOST_PACKED = 1_100  # largest ratio of decompressed to compressed size
_MOST_OBJECTS = 3_000  # names in the file and in its structs; the same object may have many
# Filters of HDF5 by number; a checksum of four bytes may be added before or after compression.
_DEFLATE, _CHECKSUM, _SIZE_OF_CHECKSUM = 1, 3, 4
_MOST_ABSENT = 1_000_000  # bytes of zeros that MATLAB may leave out
# Codes of version 5: types of elements, a flag, classes of variables, and storage types.
_MATRIX, _COMPRESSED, _OPAQUE, _COMPLEX = 14, 15, 17, 0x800
_STRUCT, _TEXT, _DEEPEST, _MOST_FIELDS = 2, 4, 4, 500
_CLASSES = {
    6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_OTHER_CLASSES = {
    1: "cell", 2: "struct", 3: "object", 4: "text", 5: "sparse", 16: "function", 17: "object",
}  # fmt: skip
_STORED = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_NUMBERS = frozenset(
    "double single logical int8 uint8 int16 uint16 int32 uint32 int64 uint64".split()
)


@dataclass(frozen=True, kw_only=True, eq=False)
class MatVariable:
    """A variable with its numbers (rows, columns), or with a description if `values` is None.

    `bytes` is the variable's size in the file if its numbers are not read. `elements` are those of
    a struct, each with its fields by name; `text` is that of a text.
    """

    name: str
    values: np.ndarray | None
    kind: str
    size: tuple[int, ...] = ()
    bytes: int = 0
    elements: tuple[dict[str, "MatVariable"], ...] = ()
    text: str = ""

    @property
    def numbers(self) -> np.ndarray:
        """The numbers; the variable must have some."""
        assert self.values is not None
        return self.values

    @property
    def samples(self) -> int:
        """The number of samples, if it is a signal or a matrix of signals."""
        return max(self.numbers.shape)

    @property
    def is_vector(self) -> bool:
        """Whether it is a single signal."""
        return self.numbers.size > 1 and min(self.numbers.shape) == 1

    def entry(self, *, read: bool, advice: str = "") -> Variable:
        """Return the variable's entry in an inspection."""
        return Variable(name=self.name, size=self.size, kind=self.kind, read=read, advice=advice)

    def __str__(self) -> str:
        return str(self.entry(read=False))


def is_mat(raw: bytes) -> bool:
    """Return whether the first bytes are those of a `.mat` file."""
    return raw.startswith(b"MATLAB") or _v4_heading(raw, 0) is not None


def read_variables(raw: bytes, *, source: str) -> list[MatVariable]:
    """Return the variables of a `.mat` file, in the order of the file.

    Raises
    ------
    SubmissionError : the file is broken, or has more variables than any bench's workspace.
    """
    if raw[:10] == b"MATLAB 7.3" or raw[512:516] == b"\x89HDF":
        read = _version_7_3
    else:
        read = _version_5 if raw.startswith(b"MATLAB") else _version_4
    try:
        variables = list(islice(read(raw), _MOST_VARIABLES + 1))
    # h5py raises many kinds of errors.
    except (ArithmeticError, LookupError, NotImplementedError, OSError, RuntimeError, TypeError,
            ValueError, struct.error, zlib.error):  # fmt: skip
        raise SubmissionError(f"{source}: the .mat file is damaged or truncated") from None
    if len(variables) > _MOST_VARIABLES:
        raise SubmissionError(
            f"{source}: holds more than {_MOST_VARIABLES:,} variables; keep those of the recording"
        )
    return variables


def _matrix(name: str, values: np.ndarray, *, bytes: int) -> MatVariable:
    """Return a MATLAB variable with its numbers, or with a description if it is not a matrix."""
    if np.iscomplexobj(values):  # possible in version 7.3
        return _nothing(name, "complex", size=values.shape, bytes=bytes)
    dtype = np.dtype("u1") if values.dtype == bool else values.dtype.newbyteorder("=")
    return MatVariable(name=name, values=values.astype(dtype), kind=str(dtype), size=values.shape)


def _nothing(name: str, kind: str, *, size: tuple[int, ...] = (), bytes: int) -> MatVariable:
    return MatVariable(name=name, values=None, kind=kind, size=size, bytes=bytes)


def _no_matrix(size: tuple[int, ...]) -> str:
    """Return why numbers of this size are not a matrix; "" if they are one."""
    if len(size) != 2 or min(size) < 0:
        return "array of more than two dimensions"
    return "empty" if 0 in size else ""


# ------------------------------------------------------------------------- versions 5 to 7


def _version_5(raw: bytes) -> Iterator[MatVariable]:
    order = {b"IM": "<", b"MI": ">"}[raw[126:128]]
    left, at = _MOST_BYTES, 128
    while at + 8 <= len(raw):
        kind, content = _content(raw, at, order)
        at += 8 + len(content)
        if kind == _COMPRESSED:
            inflated = zlib.decompressobj().decompress(content, left + 1)
            left -= len(inflated)
            if left < 0:
                raise ValueError(len(inflated))
            kind, content = _content(inflated, 0, order)
        if kind == _MATRIX and content:
            one = _read_matrix(content, order)
            if one.name:  # data that MATLAB's objects share have no name
                yield one
    if raw[at:].strip(b"\0"):
        raise ValueError(at)


def _content(raw: bytes, at: int, order: str) -> tuple[int, bytes]:
    """Return (type, bytes) of the element at `at`, whose tag has eight bytes.

    The element must be complete.
    """
    kind, size = struct.unpack_from(order + "II", raw, at)
    content = raw[at + 8 : at + 8 + size]
    if len(content) < size:
        raise ValueError(size)
    return kind, content


def _element(content: bytes, at: int, order: str) -> tuple[int, bytes, int]:
    """Return (type, bytes, start of the next element) of the element at `at`."""
    (word,) = struct.unpack_from(order + "I", content, at)
    if not word >> 16:
        kind, data = _content(content, at, order)
        return kind, data, at + 8 + (len(data) + 7) // 8 * 8
    # In the short form, eight bytes hold type, size and up to four bytes of data.
    size = word >> 16
    data = content[at + 4 : at + 4 + size]
    if size > 4 or len(data) < size:
        raise ValueError(size)
    return word & 0xFFFF, data, at + 8


def _read_struct(
    content: bytes, at: int, order: str, *, depth: int
) -> Iterator[dict[str, MatVariable]]:
    """Yield the fields of each element of a struct, from where their names begin."""
    _, width, at = _element(content, at, order)
    (length,) = struct.unpack_from(order + "i", width)
    _, names, at = _element(content, at, order)
    if not 0 < length <= _LONGEST_NAME or len(names) > _MOST_FIELDS * length:
        raise ValueError(length)
    fields = [
        _label(names[i : i + length].partition(b"\0")[0]) for i in range(0, len(names), length)
    ]
    left = _MOST_FIELDS
    while fields and at + 8 <= len(content):
        element = {}
        for name in fields:
            _, part = _content(content, at, order)
            at += 8 + len(part)
            left -= 1
            if left < 0:
                return
            if part:
                element[name] = _read_matrix(part, order, depth=depth + 1)
        yield element


def _read_matrix(content: bytes, order: str, *, depth: int = 0) -> MatVariable:
    _, flags, at = _element(content, 0, order)
    (flag,) = struct.unpack_from(order + "I", flags)
    code = flag & 0xFF
    shape: tuple[int, ...] = ()
    if code != _OPAQUE:
        _, dims, at = _element(content, at, order)
        if len(dims) > 4 * _MOST_DIMENSIONS:
            raise ValueError(len(dims))
        shape = tuple(int(d) for d in np.frombuffer(dims, dtype=order + "i4"))
    _, name, at = _element(content, at, order)
    label = _label(name)
    if code == _STRUCT and depth < _DEEPEST:
        elements = tuple(_read_struct(content, at, order, depth=depth))
        return MatVariable(
            name=label,
            values=None,
            kind="struct",
            size=shape,
            bytes=len(content),
            elements=elements,
        )
    if code == _TEXT:
        _, data, _ = _element(content, at, order)
        text = data.decode("utf-16" if data[1:2] == b"\0" else "latin-1", errors="replace")
        text = text.replace("\0", "")[:_LONGEST_NAME]
        return replace(_nothing(label, "text", size=shape, bytes=len(content)), text=text)
    kind = "" if code in _CLASSES else _OTHER_CLASSES.get(code, "unknown")
    kind = kind or ("complex" if flag & _COMPLEX else _no_matrix(shape))
    if kind:
        return _nothing(label, kind, size=shape, bytes=0 if kind == "empty" else len(content))
    stored_as, data, _ = _element(content, at, order)
    values = np.frombuffer(data, dtype=order + _STORED[stored_as])
    # MATLAB stores doubles that are whole numbers as short integers.
    return _matrix(label, values.astype(_CLASSES[code]).reshape(shape, order="F"), bytes=0)


def _label(name: bytes) -> str:
    label = name.decode("ascii")
    if not label.isprintable() or len(label) > _LONGEST_NAME:
        raise ValueError(label)
    return label


# ------------------------------------------------------------------------------- version 4


def _version_4(raw: bytes) -> Iterator[MatVariable]:
    at = 0
    while at < len(raw):
        heading = _v4_heading(raw, at)
        if heading is None:
            raise ValueError(at)
        dtype, size, length, is_real = heading
        label = _label(raw[at + 20 : at + 20 + length].rstrip(b"\0"))
        taken = math.prod(size) * dtype.itemsize
        data = raw[at + 20 + length :][:taken]
        at += 20 + length + (taken if is_real else 2 * taken)
        if at > len(raw):
            raise ValueError(at)
        if is_real and 0 not in size:
            values = np.frombuffer(data, dtype=dtype).reshape(size, order="F")
            yield _matrix(label, values, bytes=taken)
        else:
            yield _nothing(label, "no real matrix", size=size, bytes=taken)


def _v4_heading(raw: bytes, at: int) -> tuple[np.dtype, tuple[int, int], int, bool] | None:
    """Return (type, size, length of the name, whether real); None if no variable begins here."""
    for order in "<>" if len(raw) >= at + 20 else "":
        code, rows, columns, imaginary, length = struct.unpack_from(order + "5i", raw, at)
        machine, zero, precision, kind = (code // 10**power % 10 for power in (3, 2, 1, 0))
        known = machine == "<>".index(order) and zero == 0 and precision < 6 and kind < 2
        sensible = min(code, rows, columns) >= 0 and imaginary in (0, 1) and 1 < length <= 64
        if code < 5000 and known and sensible:
            dtype = np.dtype(order + ("f8", "f4", "i4", "i2", "u2", "u1")[precision])
            return dtype, (rows, columns), length, not (imaginary or kind)
    return None


# ----------------------------------------------------------------------------- version 7.3


def _version_7_3(raw: bytes) -> Iterator[MatVariable]:
    import h5py

    left, objects = _MOST_BYTES, _MOST_OBJECTS
    with h5py.File(BytesIO(raw), "r") as file:
        for name in map(str, file):
            objects -= 1
            if objects < 0:
                raise ValueError(name)
            if name.startswith("#"):  # parts of MATLAB's cells and objects
                continue
            is_link = not isinstance(file.get(name, getlink=True), h5py.HardLink)
            if is_link or not name.isprintable() or len(name) > _LONGEST_NAME:
                raise ValueError(name)
            item: Any = file[name]
            if isinstance(item, h5py.Datatype):  # a named type has no numbers
                continue
            if isinstance(item, h5py.Group):
                kind = "sparse" if "MATLAB_sparse" in item.attrs else "struct"
                own = [
                    key
                    for key in islice(item, _MOST_VARIABLES)
                    if isinstance(item.get(key, getlink=True), h5py.HardLink)
                ]
                objects -= len(own)
                parts = [item[key] for key in own] if objects >= 0 else []
                taken = sum(part.nbytes for part in parts if isinstance(part, h5py.Dataset))
                elements = (_fields_of(item, left=left),) if kind == "struct" else ()
                left -= taken
                yield MatVariable(
                    name=name, values=None, kind=kind, size=(1, 1), bytes=taken, elements=elements
                )
                continue
            size = tuple(reversed(item.shape)) if len(item.shape) > 1 else (item.size, 1)
            kind = _class_of(item)
            if kind in _NUMBERS:  # according to its attribute
                kind = _no_matrix(size) if _holds_numbers(item.dtype) else "unknown"
            left -= _bytes_to_read(item) if not kind else 0
            if left < 0 or item.is_virtual or item.external:  # the numbers are in another file
                raise ValueError(name)
            if not kind:
                _check_chunks(item)
            if kind:
                yield _nothing(name, kind, size=size, bytes=item.nbytes)
            else:
                values = np.atleast_1d(item[()])
                if values.dtype.names == ("real", "imag"):
                    values = values["real"] + 1j * values["imag"]
                yield _matrix(name, values.T.reshape(size), bytes=item.nbytes)


def _fields_of(group: Any, *, left: int, depth: int = 0) -> dict[str, MatVariable]:
    """Return the fields of a struct in a version 7.3 file: vectors, matrices and structs."""
    import h5py

    fields: dict[str, MatVariable] = {}
    for key in islice(group, _MOST_FIELDS):
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            continue
        item = group[key]
        if isinstance(item, h5py.Group) and depth < _DEEPEST:
            inner = _fields_of(item, left=left, depth=depth + 1)
            fields[key] = MatVariable(name=key, values=None, kind="struct", elements=(inner,))
        elif isinstance(item, h5py.Dataset) and _class_of(item) in _NUMBERS:
            left -= _bytes_to_read(item)
            if left < 0 or item.is_virtual or item.external:
                raise ValueError(key)
            _check_chunks(item)
            if len(item.shape) == 2 and _holds_numbers(item.dtype):
                fields[key] = _matrix(key, item[()].T, bytes=item.nbytes)
    return fields


def _bytes_to_read(item: Any) -> int:
    """Return the memory in bytes that reading a data set takes.

    A compressed chunk is decompressed as a whole, however little of it belongs to the data set.

    Raises
    ------
    ValueError : the data set claims more numbers than its bytes in the file can hold.
    """
    part = math.prod(item.chunks or ()) * item.dtype.itemsize
    if item.nbytes > max(_MOST_PACKED * item.id.get_storage_size(), _MOST_ABSENT):
        raise ValueError(item.nbytes)
    return max(item.nbytes, part)


def _check_chunks(item: Any) -> None:
    """Refuse a data set with a chunk that is larger than stated.

    The HDF5 library decompresses a chunk whole, whatever its stated size: 12 MB can become 12 GB.

    Raises
    ------
    ValueError : a chunk is too large, or is compressed twice.
    """
    made, stored = item.id.get_create_plist(), item.id
    filters = [made.get_filter(i)[0] for i in range(made.get_nfilters())]
    if _DEFLATE not in filters or not item.chunks:
        return
    at = filters.index(_DEFLATE)
    if not set(filters[at + 1 :]) <= {_CHECKSUM}:
        raise ValueError(filters)
    most = math.prod(item.chunks) * item.dtype.itemsize + _SIZE_OF_CHECKSUM
    for i in range(stored.get_num_chunks()):
        skipped, packed = stored.read_direct_chunk(stored.get_chunk_info(i).chunk_offset)
        if skipped & 1 << at:  # this chunk is not compressed
            continue
        if len(zlib.decompressobj().decompress(packed, most + 1)) > most:
            raise ValueError(most)


def _holds_numbers(dtype: np.dtype) -> bool:
    """Return whether a type is a number or a complex pair, not a text or reference."""
    if dtype.names == ("real", "imag"):
        return all(dtype[name].kind in "iuf" for name in ("real", "imag"))
    return dtype.kind in "biuf" and dtype.shape == ()


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
