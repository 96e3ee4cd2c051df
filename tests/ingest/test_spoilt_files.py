"""A damaged file gives a record or a clear error, and never a crash or an endless wait."""

from collections.abc import Iterator
from io import BytesIO
from random import Random

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.ingest.files import OF_STRANGERS, parse_table
from pipeline.ingest.inspect import format_inspection, inspect_file
from pipeline.ingest.read import read_data
from pipeline.submission import Submission, load_submission
from tests.helpers.poison import damaged, few_lines_at_most
from tests.helpers.recordings import lvm, tdms_of, xlsx

N = 60
T = np.round(0.00884 * np.arange(N), 3)
X = np.round(300 * np.sin(20 * T))
U = np.round(0.5 * np.sign(np.sin(9 * T)), 4)


def _text(*columns: np.ndarray, head: str, sep: str, end: str = "\n") -> bytes:
    rows = [sep.join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True)]
    return (head + end.join(rows)).encode()


def _mat(*, compress: bool = False, **variables: object) -> bytes:
    stream = BytesIO()
    scipy.io.savemat(stream, variables, do_compression=compress)
    return stream.getvalue()


def _mat73() -> bytes:
    stream = BytesIO()
    with h5py.File(stream, "w", userblock_size=512) as file:
        for name, values in (("time", T), ("duty", U), ("enc1", X)):
            file[name] = values[None, :]
    return b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + stream.getvalue()[128:]


INDEX = np.arange(1.0, N + 1)
ECP = "Sample   Time   Commanded Pos   Encoder 1 Pos   Control Effort\r\n\ndata =["
LOG = {"time": T, "enc1": X.astype("i2"), "duty": (400 * U).astype("i2"), "run": {"P": 1.0}}
SIGNALS = {"time": T, "input": U, "x1": X}
FILES = {
    "ecp": _text(INDEX, T, 0 * T, X, U, head=ECP, sep=" ", end=";\r\n") + b"];\n",
    "csv": _text(T, U, X, head="time,input,x1\n", sep=","),
    "decimal commas": _text(T, U, X, head="time;input;x1\n", sep=";").replace(b".", b","),
    "bench log": _text(
        INDEX, T, X, 400 * U, head="Sample\tTime\tEncoder 1 Pos\tControl Effort\n", sep="\t"
    ),
    "usb logger": _text(8840 * INDEX, INDEX % 7, head="Time [us],Displacement [mm]\n", sep=","),
    "bode": _text(0.5 * INDEX, 1 / INDEX, head="frequency,x1\n", sep=","),
    "mat": _mat(**LOG),
    "mat, compressed": _mat(compress=True, **LOG),
    "mat, matrix": _mat(data=np.column_stack([T, U, X])),
    "mat, version 7.3": _mat73(),
    "workbook": xlsx(SIGNALS),
    "LabVIEW": lvm(SIGNALS),
    "tdms": tdms_of(SIGNALS),
}

# Bytes that mean something in one of the formats.
JUNK = (b"1e999", b"[", b"]", b";", b"\n\n", b",", b"\xff\xfe", b"%", b"\r", b"time,x1\n", b".",
        b"\xe2\x88\x92", b"0x1F")  # fmt: skip
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(autouse=True)
def by_strangers() -> Iterator[None]:
    """Read the files as those of strangers, because they may crash their reader."""
    before = OF_STRANGERS.set(True)
    yield
    OF_STRANGERS.reset(before)


@pytest.fixture(scope="module")
def submission(tmp_path_factory) -> Submission:
    """Return a submission in which each kind of experiment uses the same file."""
    folder = tmp_path_factory.mktemp("fuzz")
    kinds = ('kind = "step"', 'kind = "closed_loop"', 'kind = "bode"', 'kind = "decay"')
    matrix = "columns = { time = 1, input = 2, x1 = 3 }\n"
    toml = 'version = 1\n[system]\ncarts = 1\nposition = { unit = "cm", per_count = 0.00227 }\n'
    for i, kind in enumerate((*kinds, kinds[0] + "\n" + matrix)):
        toml += f'[[experiments]]\nid = "e{i}"\nfile = "a.dat"\n{kind}\n'
    (folder / "submission.toml").write_text(toml)
    (folder / "a.dat").write_bytes(b"time,x1\n")
    return load_submission(folder)


def try_everything(submission: Submission, raw: bytes) -> None:
    """Read the bytes as every kind of experiment, and inspect them."""
    path = submission.folder / "a.dat"
    path.write_bytes(raw)
    for experiment in submission.experiments:
        with few_lines_at_most():
            data = read_data(submission.model_copy(update={"experiments": (experiment,)}))
            for record in data.records:
                assert np.isfinite(record.y).all()
                assert (np.diff(record.t) > 0).all()
    with few_lines_at_most():
        format_inspection(inspect_file(path))


@pytest.mark.parametrize("name", FILES)
def test_the_undamaged_file_is_read(name, submission):
    """The file that the tests damage is read without an error while it is whole."""
    assert parse_table(FILES[name], source="a.dat").values.shape[1] >= N - 1


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=30)
@given(seed=seeds)
def test_a_damaged_file_is_an_error_or_a_record(name, seed, submission):
    """A file with cuts, changes or junk gives one line of error, or finite data, in time."""
    try_everything(submission, damaged(FILES[name], Random(seed), hits=4, more=JUNK))


@settings(max_examples=60)
@given(
    raw=st.one_of(
        st.binary(max_size=400),
        st.text(max_size=300).map(str.encode),
        st.text(alphabet="0123456789.,;\t -+eE[]%\nxt", max_size=300).map(str.encode),
        st.binary(max_size=300).map(
            lambda b: b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b
        ),
    )
)
def test_junk_is_an_error_or_a_record(raw, submission):
    """Random bytes give one line of error or finite data in time."""
    try_everything(submission, raw)
