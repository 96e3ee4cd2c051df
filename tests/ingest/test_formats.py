"""Every form of data file gives the same numbers: any dialect of text, any layout of `.mat`."""

import hashlib
import re
from io import BytesIO
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_array_equal

from pipeline.errors import SubmissionError
from pipeline.ingest.files import OF_STRANGERS, parse_table, parse_tables, read_table
from pipeline.ingest.table import FileTable

N = 50
TIME = np.round(0.00884 * np.arange(N), 3)
X1 = np.round(300 * np.sin(20 * TIME))
X2 = np.round(-200 * np.sin(15 * TIME))
U = np.round(0.5 * np.sign(np.sin(9 * TIME)), 4)
HEADING = " Sample   Time     Commanded Pos   Encoder 1 Pos   Encoder 2 Pos   Control Effort"
ROWS = [
    f"{i:5d} {t:8.3f} {0:15d} {a:15.0f} {b:15.0f} {u:15.4f}"
    for i, (t, a, b, u) in enumerate(zip(TIME, X1, X2, U, strict=True))
]


def table(content: str | bytes) -> FileTable:
    """Parse the content of a file."""
    return parse_table(content.encode() if isinstance(content, str) else content, source="f")


def column(of: FileTable, name: str) -> np.ndarray:
    """Return a column by its heading."""
    return of.values[of.index(name)]


ECP = {
    "as exported": HEADING + "\n\n[" + ";\n".join(ROWS) + "]\n",
    "carriage returns": (HEADING + "\n\n[" + ";\n".join(ROWS) + "]\n").replace("\n", "\r\n"),
    "mixed line ends": HEADING + "\r\n\n[" + ";\r\n".join(ROWS) + "]\r\n",
    "old Macintosh": (HEADING + "\n\n[" + ";\n".join(ROWS) + "]\n").replace("\n", "\r"),
    "a MATLAB script": "%" + HEADING + "\r\n\r\ndata =[" + ";\r\n".join(ROWS) + "];\r\n",
    "spaces before": "\n\n%" + HEADING + "\n   data = [ " + ";\n".join(ROWS) + "\n ] ;\n\n",
    "rows without semicolons": HEADING + "\n[\n" + "\n".join(ROWS) + "\n]",
    "rows in one line": HEADING + "\n[" + "; ".join(ROWS) + "]",
    "commas": HEADING + "\n[" + ";\n".join(",".join(row.split()) for row in ROWS) + "]",
    "comments": HEADING + "\n[" + "; % tick\n".join(ROWS) + "]",
    "single spaces": " ".join(HEADING.split()) + "\n[" + ";\n".join(ROWS) + "]",
    "byte-order mark": "\ufeff" + HEADING + "\n[" + ";\n".join(ROWS) + "]",
}


@pytest.mark.parametrize("content", ECP.values(), ids=ECP.keys())
def test_an_ecp_export_is_read_in_every_dialect(content):
    """Brackets, semicolons, line ends and a script's frame around them change no number."""
    got = table(content)

    assert got.format.positions == "count"
    assert list(got.names) == re.split(r"\s{2,}", HEADING.strip())
    assert_array_equal(column(got, "Time"), TIME)
    assert_array_equal(column(got, "Encoder 1 Pos"), X1)
    assert_array_equal(column(got, "Control Effort"), U)
    assert got.cut is None


@pytest.mark.parametrize("keep", [(0, 1, 3, 5), (1, 2, 3, 4), (0, 1, 2, 4, 5), (0, 1, 2, 3, 4, 5)])
def test_an_ecp_export_may_hold_any_of_its_columns(keep):
    """An ECP export is read with whatever columns the student ticked."""
    names = ("Sample", "Time", "Commanded Pos", "Encoder 1 Pos", "Encoder 2 Pos", "Control Effort")
    values = (np.arange(N), TIME, 0 * TIME, X1, X2, U)
    rows = [" ".join(f"{values[k][i]:.4f}" for k in keep) for i in range(N)]

    got = table("  ".join(names[k] for k in keep) + "\n[" + ";\n".join(rows) + "]\n")

    assert got.names == tuple(names[k] for k in keep)
    for row, k in enumerate(keep):
        assert_array_equal(got.values[row], values[k])


def test_lines_are_counted_as_an_editor_counts_them():
    """A row's number is its line in an editor; text behind the rows is mentioned with its line."""
    got = table(ECP["a MATLAB script"] + "plot(data)\n")
    assert (got.place(0), got.place(N - 1)) == ("line 3", f"line {N + 2}")
    assert f"line {N + 2}" in got.notes[0]


def delimited(delimiter: str, decimal: str = ".", quote: str = "", end: str = "\n") -> str:
    """Write the four signals as a table of text."""
    lines = [delimiter.join(quote + name + quote for name in ("time", "input", "x1", "x2"))]
    for row in zip(TIME, U, X1, X2, strict=True):
        lines.append(delimiter.join(f"{value:.4f}".replace(".", decimal) for value in row))
    return end.join(lines) + end


CSV = {
    "comma": delimited(","),
    "semicolon": delimited(";"),
    "tab": delimited("\t"),
    "spaces": delimited("  "),
    "comma and space": delimited(", "),
    "decimal commas, semicolon": delimited(";", decimal=","),
    "decimal commas, tab": delimited("\t", decimal=","),
    "quoted headings": delimited(",", quote='"'),
    "CR LF": delimited(",", end="\r\n"),
    "Excel's first line": "sep=;\n" + delimited(";", decimal=","),
    "comments before": "# bench 4\n% team 7\n" + delimited(","),
    "comment as heading": "# " + delimited(","),
    "delimiter at the line end": delimited(",").replace("\n", ",\n"),
    "UTF-16": delimited("\t").encode("utf-16"),
    "Windows letters": ("# 5 µm\n" + delimited(",")).encode("latin-1"),
    "byte-order mark": "\ufeff" + delimited(";"),
    "no last line end": delimited(",").rstrip("\n"),
    "empty rows of a spreadsheet": delimited(",") + ",,,\n,,,\n",
}


@pytest.mark.parametrize("content", CSV.values(), ids=CSV.keys())
def test_delimiter_and_decimal_mark_are_found(content):
    """Whatever delimiter and decimal mark a text table has, it gives the same numbers."""
    got = table(content)

    assert (got.format.positions, got.format.inputs) == ("heading", "heading")
    assert got.names == ("time", "input", "x1", "x2")
    for row, expected in zip(got.values, (TIME, U, X1, X2), strict=True):
        assert_array_equal(row, expected)


def test_commas_between_whole_numbers_are_not_decimal_marks():
    """In a table of whole numbers separated by commas, no comma is read as a decimal mark."""
    got = table("time,x1\n" + "".join(f"{i},{i % 3}\n" for i in range(20)))
    assert_array_equal(got.values, [np.arange(20), np.arange(20) % 3])


def test_columns_without_headings_are_numbered():
    """A table without headings has its columns numbered."""
    got = table("".join(f"{t} {x}\n" for t, x in zip(TIME, X1, strict=True)))
    assert got.names == ("1", "2")
    assert got.index(2) == 1
    with pytest.raises(SubmissionError, match="column 3"):
        got.index(3)


def test_one_column_alone_is_read():
    """A table with a single channel and no time column is read."""
    got = table("displacement\n" + "\n".join(f"{x:g}" for x in X1))
    assert got.names == ("displacement",)
    assert_array_equal(got.values[0], X1)


def test_a_bench_log_is_distinguished_from_an_ecp_export():
    """A bench log has the headings of an ECP export; tabs and missing brackets distinguish it."""
    lines = ["Sample\tTime\tEncoder 1 Pos\tEncoder 2 Pos\tControl Effort"]
    lines += [
        f"{i + 1}\t{t:g}\t{a:g}\t{b:g}\t410"
        for i, (t, a, b) in enumerate(zip(TIME, X1, X2, strict=True))
    ]
    got = table("\n".join(lines) + "\n")
    assert got.format.inputs == "count"
    assert_array_equal(column(got, "encoder 2 pos"), X2)
    assert got.whole == (True, False, True, True, True)


def mat(compress: bool = False, **variables: object) -> bytes:
    """Write a .mat file as MATLAB would."""
    stream = BytesIO()
    scipy.io.savemat(stream, variables, do_compression=compress)
    return stream.getvalue()


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
def test_mat_vectors_of_every_number_type_are_read(dtype, compress):
    """Integers and floats of every size in a .mat file are read as written."""
    values = np.arange(0, 100, 2).astype(dtype)
    raw = mat(compress=compress, time=TIME[None, :], enc1=values, duty=values[:, None])

    got = table(raw)

    assert got.format.inputs == "count"
    for name, written in (("time", TIME), ("enc1", values), ("duty", values)):
        assert_array_equal(column(got, name), written)


def test_a_big_endian_mat_file_is_read():
    """A .mat file written on a processor with reversed byte order is read."""
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    values = np.arange(9.0).astype(">f8").tobytes()
    body = b"".join(
        np.array(words, dtype=">u4").tobytes() + data
        for words, data in (
            ([6, 8, 6, 0], b""),
            ([5, 8, 9, 1], b""),
            ([1, 2], b"x1".ljust(8, b"\0")),
            ([9, 72], values),
        )
    )
    raw = header + np.array([14, len(body)], dtype=">u4").tobytes() + body
    assert_array_equal(scipy.io.loadmat(BytesIO(raw))["x1"].ravel(), np.arange(9.0))
    assert_array_equal(column(table(raw), "x1"), np.arange(9.0))


def test_a_bare_matrix_has_numbered_columns():
    """The columns of a matrix are numbered; one saved in rows is transposed, with a note."""
    matrix = np.column_stack([np.arange(N), TIME, X1, U])
    upright, lying = table(mat(data=matrix)), table(mat(data=matrix.T))
    assert upright.format.inputs == "unknown"
    assert upright.names == ("1", "2", "3", "4")
    assert_array_equal(upright.values, matrix.T)
    assert_array_equal(lying.values, matrix.T)
    assert (len(upright.notes), len(lying.notes)) == (0, 1)
    assert upright.whole == (True, False, True, False)


def test_other_content_of_a_mat_file_is_named():
    """Structs, texts and single numbers in a .mat file are not read, and are named."""
    got = table(mat(time=TIME, x1=X1, run={"P": 1.0}, name="bench 4", rate=113.0))
    assert got.names == ("time", "x1")
    unread = [(v.name, v.size, v.kind) for v in got.variables if not v.read]
    assert unread == [
        ("run", (1, 1), "struct"), ("name", (1, 7), "text"), ("rate", (1, 1), "float64")
    ]  # fmt: skip
    assert all(name in got.notes[0] for name, *_ in unread)


def test_complex_numbers_are_not_read_as_real_ones():
    """A complex vector, alone or in a struct, is named and not read."""
    got = table(mat(time=TIME, x1=X1, h=X1 + 1j, s={"h": X1 + 1j}, n=np.arange(N) % 9.0))
    assert [(v.name, v.kind) for v in got.variables if not v.read] == [
        ("h", "complex"),
        ("s", "struct"),
    ]
    with pytest.raises(SubmissionError, match=r"struct\)"):
        table(mat(s={"t": TIME, "h": X1 + 1j}))


def test_a_counter_that_overflowed_is_made_continuous():
    """A 16-bit encoder count that overflows is made continuous, and a note says so."""
    true = 65_500 + 3 * np.arange(N)
    got = table(mat(time=TIME, enc1=(true % 65_536).astype("u2"), duty=np.zeros(N, "i2")))
    assert_array_equal(np.diff(column(got, "enc1")), np.full(N - 1, 3))
    assert any("overflowed" in note for note in got.notes)


def test_the_hash_is_of_the_bytes(tmp_path):
    """The hash is of exactly the bytes that were read."""
    (tmp_path / "a.csv").write_bytes(b"time,x1\n0,1\n1,2\n")
    digest = hashlib.sha256(b"time,x1\n0,1\n1,2\n").hexdigest()
    assert read_table(tmp_path, "a.csv")[1] == digest


def test_a_file_of_blanks_of_any_sort_is_empty():
    """A file with only blanks or line ends, of whatever sort, counts as empty."""
    for blanks in (b"\x85", b"", b"\r\n", b";;\n"):
        with pytest.raises(SubmissionError, match="empty"):
            table(blanks)


def test_the_matrix_of_a_mat_file_is_the_recording():
    """A matrix in a .mat file is the recording, even if the file also has settings and gains."""
    matrix = np.column_stack([TIME, X1, U])
    settings: dict[str, Any] = {f"p{i}": float(i) for i in range(12)}
    got = table(mat(**settings, gains=[1.0, 2.0, 3.0], log=matrix))
    assert (got.format.inputs, got.names) == ("unknown", ("1", "2", "3"))
    assert_array_equal(got.values, matrix.T)
    read = [variable for variable in got.variables if variable.read]
    assert [(one.name, one.size) for one in read] == [("log", matrix.shape)]
    assert len(got.variables) == 14


def test_short_vectors_beside_a_recording_are_settings():
    """Gains neither join a recording's vectors nor hide a struct of signals."""
    run, gains = {"time": TIME, "x1": X1}, [1.0, 2.0, 3.0]
    law = {"K": gains, "L": gains}
    for variables in ({**run, "gains": gains}, {"run": run, "gains": gains, "law": law}):
        assert table(mat(**variables)).names == ("time", "x1")


def test_a_matrix_beside_vectors_of_its_length_gives_its_columns_too():
    """If a matrix is as long as the vectors beside it, its columns are numbered and also read."""
    got = table(mat(t=TIME, y=np.column_stack([X1, U])))
    assert [name[0] for name in sorted(got.names)] == ["t", "y", "y"]
    assert_array_equal(column(got, sorted(got.names)[2]), U)


def test_a_possible_second_recording_gets_advice():
    """A note says how to read a second matrix, or a struct as large as the recording."""
    further = mat(time=TIME, x1=X1, log=np.ones((90, 70)), raw={"t": TIME, "x": X1, "u": U})
    notes = {v.name: v.advice for v in table(further).variables if not v.read}
    assert "'-struct'" in notes["raw"]
    assert "'log'" in notes["log"]
    with pytest.raises(SubmissionError, match=r"\ba .*\bb "):
        table(mat(a=np.column_stack([TIME, X1]), b=np.column_stack([TIME, U])))


def test_the_fields_of_a_struct_are_columns():
    """The vectors of a struct are its columns; several structs are several runs."""
    got = table(mat(log={"t": TIME, "x1": X1}))
    assert got.names == ("t", "x1")
    assert_array_equal(got.values, [TIME, X1])
    runs = parse_tables(mat(a={"t": TIME, "x1": X1}, b={"t": TIME, "x1": U}), source="f")
    assert [one.run for one in runs] == ["a", "b"]
    assert_array_equal(runs[1].values, [TIME, U])


def test_a_file_that_crashes_its_reader_costs_only_itself(tmp_path):
    """A .mat file of a stranger that crashes scipy is refused, and the next one is read."""
    good = mat(time=TIME, x1=X1)
    begin = good.rindex(np.array([9, 8 * N], dtype="<u4").tobytes())  # numbers of type 9, double
    bad = good[:begin] + np.array([250, 8 * N], dtype="<u4").tobytes() + good[begin + 8 :]
    (tmp_path / "bad.mat").write_bytes(bad)
    (tmp_path / "good.mat").write_bytes(good)
    before = OF_STRANGERS.set(True)
    try:
        with pytest.raises(SubmissionError, match=r"bad\.mat: .*damaged"):
            read_table(tmp_path, "bad.mat")
        apart = read_table(tmp_path, "good.mat")[0]
    finally:
        OF_STRANGERS.reset(before)
    here = read_table(tmp_path, "good.mat")[0]
    assert_array_equal(apart.values, here.values)
    assert vars(apart) | {"values": 0} == vars(here) | {"values": 0}


def test_a_matlab_table_is_refused_with_advice():
    """A MATLAB `table` object cannot be read, and the error shows how to export it."""
    body = np.array([6, 8, 17, 0], dtype="<u4").tobytes()
    for text in (b"run7", b"MCOS", b"table"):
        body += np.array([1, len(text)], dtype="<u4").tobytes() + text.ljust(8, b"\0")
    body += scipy_element(np.zeros((1, 6), "u4"), name="")
    kept = scipy_element(np.zeros((1, 400), "u1"), name="")
    raw = mat(rate=113.0) + np.array([14, len(body)], dtype="<u4").tobytes() + body + kept
    with pytest.raises(SubmissionError, match=r"writetable\(run7"):
        table(raw)


def mat73(**variables: np.ndarray) -> bytes:
    """Write a version 7.3 file as MATLAB would: HDF5 after a block of text, arrays transposed."""
    stream = BytesIO()
    with h5py.File(stream, "w", userblock_size=512) as file:
        for name, values in variables.items():
            matrix = np.atleast_2d(values).T
            data = file.create_dataset(name, data=matrix, compression="gzip")
            word = {"f8": "double", "i2": "int16", "u2": "uint16"}[matrix.dtype.str[1:]]
            data.attrs["MATLAB_class"] = np.bytes_(word)
        file.create_group("#refs#")
    heading = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    return heading + stream.getvalue()[128:]


def test_a_matlab_7_3_log_is_read_like_any_other():
    """Versions 5 and 7.3 of a MATLAB file with the same variables give the same table."""
    log = {
        "time": TIME,
        "enc1": (65_500 + 3 * np.arange(N)).astype("u2"),
        "duty": np.zeros(N, "i2"),
    }
    old, new = table(mat(**log)), table(mat73(**log))
    assert (new.format, sorted(new.names)) == (old.format, sorted(old.names))
    for name in log:
        assert_array_equal(column(new, name), column(old, name))
    matrix = np.column_stack([TIME, X1, U])
    assert_array_equal(table(mat73(data=matrix)).values, matrix.T)


def test_other_content_of_a_matlab_7_3_file_is_named():
    """A struct, a text and an empty array in a version 7.3 file are not read, and are named."""
    stream = BytesIO(mat73(time=TIME, x1=X1))
    with h5py.File(stream, "r+") as file:
        file.create_group("run")["P"] = 1.0
        file["name"] = np.zeros((7, 1), "u2")
        file["name"].attrs["MATLAB_class"] = np.bytes_("char")
        file["none"] = np.zeros(2, "u8")
        file["none"].attrs["MATLAB_empty"] = 1
    got = table(stream.getvalue())
    assert got.names == ("time", "x1")
    unread = {v.name: v.kind for v in got.variables if not v.read}
    assert unread == {"run": "struct", "name": "text", "none": "empty"}


@pytest.mark.parametrize("spoil", ["huge", "elsewhere", "link", "cut"])
def test_a_hostile_matlab_7_3_file_is_refused(spoil, tmp_path):
    """A 7.3 file that is cut, declares terabytes or links elsewhere gives one short error."""
    stream = BytesIO(mat73(time=TIME, x1=X1))
    (tmp_path / "secret").write_bytes(bytes(8 * N))
    with h5py.File(stream, "r+") as file:
        if spoil == "huge":
            file.create_dataset("x2", shape=(10**12, 1), chunks=(1000, 1), dtype="f8")
        if spoil == "elsewhere":
            outside = [(str(tmp_path / "secret"), 0, 8 * N)]
            file.create_dataset("x2", shape=(N, 1), dtype="f8", external=outside)
        if spoil == "link":
            file["x2"] = h5py.ExternalLink(str(tmp_path / "secret"), "/x")
    raw = stream.getvalue()
    (tmp_path / "a.mat").write_bytes(raw[: len(raw) // 2] if spoil == "cut" else raw)
    with pytest.raises(SubmissionError, match=r"damaged|memory"):
        read_table(tmp_path, "a.mat")


def scipy_element(values: np.ndarray, *, name: str) -> bytes:
    """Return the bytes of a variable in a .mat file; the variable may have an empty name."""
    stream = BytesIO()
    scipy.io.savemat(stream, {name or "x": values})
    raw = stream.getvalue()[128:]
    if name:
        return raw
    named = np.array([1 | 1 << 16], dtype="<u4").tobytes() + b"x"
    return raw.replace(named, np.array([1], dtype="<u4").tobytes() + b"\0")


def test_a_mat_file_with_an_endless_name_is_refused():
    """A .mat file with a name of a megabyte gives one short error."""
    raw = bytearray(mat(x1=X1))
    long = b"a" * 1_000_000
    element = np.array([1, len(long)], dtype="<u4").tobytes() + long
    flags = np.array([6, 8, 1, 0, 5, 8, 0, 0], dtype="<u4").tobytes()
    body = flags + element
    raw += np.array([14, len(body)], dtype="<u4").tobytes() + body
    with pytest.raises(SubmissionError) as caught:
        table(bytes(raw))
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("odd", "stated"),
    [
        (np.bytes_(b"xyz"), np.bytes_("double")),
        (np.array([("a", 1.0)], dtype=[("name", "S1"), ("value", "f8")]), np.bytes_("double")),
        (np.array([b"text", b"more"], dtype="S4"), np.bytes_("double")),
        (np.arange(5.0), np.arange(60.0).reshape(6, 10)),
    ],
    ids=["text", "record", "texts", "a class that is an array"],
)
def test_a_matlab_7_3_variable_that_lies_about_its_class_is_not_read(odd, stated):
    """If a 7.3 variable's data are not of the stated class, it is named as not read."""
    stream = BytesIO(mat73(time=TIME, x1=X1))
    with h5py.File(stream, "r+") as file:
        file["odd"] = odd
        file["odd"].attrs["MATLAB_class"] = stated
    got = table(stream.getvalue())
    assert got.names == ("time", "x1")
    assert [(v.name, v.kind) for v in got.variables if not v.read] == [("odd", "unknown")]
