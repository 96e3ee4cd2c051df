"""Files of real benches, in every form that is available, are read."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.ingest.files import read_table
from pipeline.ingest.inspect import inspect_file
from pipeline.ingest.read import Ingested, read_data
from pipeline.submission import Experiment, load_submission
from tests.helpers.recordings import facts

KINDS = {"DOF1_en1": "step", "DOF1_en2": "decay", "DOF2": "step", "test_3": "step"}


def read(folder: Path, toml: str, tmp_path: Path) -> Ingested:
    """Read recordings in place, with a submission written in another folder."""
    (tmp_path / "submission.toml").write_text(
        "version = 1\n[system]\ncarts = 2\nsprings = [true, true, false]\n"
    )
    submission = load_submission(tmp_path)
    experiments = tuple(
        Experiment.model_validate({"carts": (1, 2)} | table)
        for table in tomllib.loads(toml)["experiments"]
    )
    return read_data(submission.model_copy(update={"experiments": experiments, "folder": folder}))


def experiment(name: str, kind: str, more: str = "") -> str:
    """Return one table `[[experiments]]`."""
    return f'[[experiments]]\nid = "{name}"\nkind = "{kind}"\nfile = "{name}"\n{more}\n'


def test_every_text_export_is_recognised(real_data):
    """`inspect` finds the kind of each recording, which its file name states."""
    for path in sorted((real_data / "ecp210-ucsd").glob("*.csv")):
        got = inspect_file(path)
        expected = next((k for start, k in KINDS.items() if path.name.startswith(start)), None)
        assert got.kind == (expected or "closed_loop"), path.name
        assert got.samples == 677
        assert got.rate == pytest.approx(112.941, abs=1e-3)
        assert len(got.problems) == 1, got.problems  # the only problem is the rounded clock
        assert [*facts(got.problems)] == ["rounded"]


def test_the_servo_exports_are_recognised(real_data):
    """Two exports of a servo are recognised: a saturated closed loop and a sweep in open loop.

    The sweep logs its effort, in percent of a volt and slightly late, as "Commanded Pos".
    """
    script = inspect_file(real_data / "ecp220-servo" / "raw_data_cl_step1.m")
    assert (script.samples, script.kind) == (451, "closed_loop")
    assert "4.884" in facts(script.problems)["clipped"]
    plain = inspect_file(real_data / "ecp220-servo" / "raw_data_freq.txt")
    assert (plain.samples, plain.kind) == (1370, "sweep")


def test_the_signs_of_the_real_bench_are_found(real_data, tmp_path):
    """The input's sign is -1 in open loop and +1 in closed loop, as this bench logs it."""
    folder = real_data / "ecp210-ucsd"
    opened = [f"DOF1_en1_input1_test{i}.csv" for i in range(1, 6)]
    opened += [f"DOF2_en12_input1_test{i}.csv" for i in range(1, 6)]
    opened += [f"test_3_{i}.csv" for i in (7, 10, 13, 16)]
    closed = sorted(path.name for path in folder.glob("closed_loop*.csv"))
    toml = "".join(experiment(name, "step") for name in opened)
    toml += "".join(experiment(name, "closed_loop") for name in closed)

    data = read(folder, toml, tmp_path)

    scales = {record.id: record.input_scale for record in data.records}
    assert {scales[name] for name in opened} == {-1.0}
    assert {scales[name] for name in closed} == {1.0}
    assert len(data.warnings) == 1
    assert {data.signs.found[name] for name in opened} == {-1}
    assert all((r.reference is not None) == (r.kind == "closed_loop") for r in data.records)


def test_the_exported_matrix_is_the_export(real_data, tmp_path):
    """A run exported as text and as a matrix without headings gives the same record."""
    columns = "columns = { time = 2, x1 = 4, x2 = 5, input = 6 }"
    toml = experiment("DOF2_en12_input1_test1.csv", "step")
    toml += experiment("DOF2_en12_input1_test1.mat", "step", columns)
    text, matrix = read(real_data / "ecp210-ucsd", toml, tmp_path).records
    assert_array_equal(text.t, matrix.t)
    assert_array_equal(text.y, matrix.y)
    assert_array_equal(text.u, matrix.u)


def test_the_serial_bench_logs_are_read(real_data, tmp_path):
    """Serial logs of both layouts are read; an edited copy agrees with the end of its original."""
    toml = experiment("Jan281500.mat", "closed_loop")
    toml += experiment("Modified_Jan281500.mat", "closed_loop")
    whole, part = read(real_data / "teensy-torsional", toml, tmp_path).records
    n = part.t.size
    start = next(
        i for i in range(whole.t.size - n + 1) if np.array_equal(whole.y[:, i : i + n], part.y)
    )
    # Both clocks are within the rounding of their common stamps.
    shift = part.t - whole.t[start : start + n]
    assert np.ptp(shift) < 1.5e-3
    assert whole.u is not None
    assert whole.u.max() == pytest.approx(112 * 5 / 4096)
    problems = inspect_file(real_data / "teensy-torsional" / "Jan141428.mat").problems
    assert "unsigned" in facts(problems)


def test_the_silverbox_is_read(real_data, tmp_path):
    """The Silverbox files have no time column, and are read with a stated sample rate."""
    more = (
        f"sample_rate = {1e7 / 2**14}\ncarts = [1]\nhold = 'band_limited'\n"
        'columns = { input = "V1", x1 = "V2" }'
    )
    toml = "".join(experiment(f"{name}80mV.mat", "sweep", more) for name in ("SNLS", "Schroeder"))
    for record in read(real_data / "silverbox", toml, tmp_path).records:
        assert record.t.size == 131_072
        assert record.hold == "band_limited"
        assert_allclose(record.sample_time, 2**14 / 1e7, rtol=1e-12)
        assert record.input_scale == 1.0


def test_the_bench_mat_log_agrees_with_scipy(real_data):
    """Every variable of a bench's .mat log has the numbers of scipy's reader."""
    for path in sorted(real_data.rglob("*.mat")):
        table, _ = read_table(path.parent, path.name)
        oracle = scipy.io.loadmat(path)
        for name, values in zip(table.names, table.values, strict=True):
            expected = oracle[name].ravel() if name in oracle else oracle["data"][:, int(name) - 1]
            assert_array_equal(values, expected)
