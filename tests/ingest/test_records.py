"""From tables to records: units, signs, windows, references, free carts, Bode tables."""

import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.errors import SubmissionError
from pipeline.identify.recording_checks import check_signs, check_units
from pipeline.ingest.bode_table import frequency_responses
from pipeline.ingest.read import DUTY_COUNT, Ingested, read_data
from pipeline.plant.chain import PRESETS
from pipeline.plant.simulate import simulate_linear
from pipeline.submission import load_submission
from tests.helpers.recordings import facts

N = 600
T = 0.0088542 * np.arange(N, dtype=np.float64)
U = np.where((T > 0.5) & (T < 3.0), 0.01, 0.0)
Y = 440 * simulate_linear(PRESETS["throne-2dof"], T, U)  # in counts of 1/440 cm
X1, X2 = np.round(Y)


def read(folder: Path, system: str, experiment: str, content: str | bytes) -> Ingested:
    """Read a submission of two carts with one experiment."""
    folder.mkdir(exist_ok=True)
    toml = f'version = 1\n[system]\ncarts = 2\n{system}\n[[experiments]]\nid = "a"\n{experiment}\n'
    (folder / "submission.toml").write_text(toml + 'file = "a.dat"\n', encoding="utf-8")
    raw = content.encode() if isinstance(content, str) else content
    (folder / "a.dat").write_bytes(raw)
    return read_data(load_submission(folder))


def csv(**columns: np.ndarray) -> str:
    """Write columns as CSV; the name `Time__us` gives the heading `Time [us]`."""
    heading = ",".join(name.replace("__", " [") + "]" if "__" in name else name for name in columns)
    rows = zip(*columns.values(), strict=True)
    return heading + "\n" + "".join(",".join(f"{v:.7g}" for v in row) + "\n" for row in rows)


def ecp(*, reference: np.ndarray, x1: np.ndarray, effort: np.ndarray) -> str:
    """Return an ECP export of one encoder."""
    rows = [
        f"{i} {t:.3f} {r:.0f} {a:.0f} {u:.4f}"
        for i, (t, r, a, u) in enumerate(zip(T, reference, x1, effort, strict=True))
    ]
    head = " Sample   Time   Commanded Pos   Encoder 1 Pos   Control Effort\n\n["
    return head + ";\n".join(rows) + "]\n"


STEP = 'kind = "step"'
LOOP = 'kind = "closed_loop"'
SINE = 'kind = "sine"'
CM = 'position = { unit = "cm", per_count = 0.00227 }'


ECP = ecp(reference=0 * X1, x1=X1, effort=U)
COUNTED = csv(time=T, input=U, x1=X1).replace("x1", "Encoder 1 Pos")
POSITIONS = {
    # name: what `[system]` states, content, position units per number in the file
    "a stated count of an export": (CM, ECP, 0.00227),
    "counts of an export": ("", ECP, 1.0),
    "whole numbers of a CSV": (CM, csv(time=T, input=U, x1=X1), 1.0),
    "a heading that says counts": (CM, COUNTED, 0.00227),
}


@pytest.mark.parametrize("name", POSITIONS)
def test_counts_become_position_units_once(name, tmp_path):
    """Encoder counts are multiplied by `per_count`; the columns x1 … of a CSV never are."""
    system, content, scale = POSITIONS[name]
    record = read(tmp_path, system, STEP, content).records[0]
    assert_allclose(record.position(1), scale * X1, rtol=1e-15)
    assert record.encoder_step(1) == record.position_scale == scale
    assert (record.carts, record.free) == ((1,), (1, 2))


@pytest.mark.parametrize(("unit", "factor"), [("mm", 0.1), ("m", 100.0), ("cm", 1.0)])
def test_a_unit_in_the_heading_is_converted(unit, factor, tmp_path):
    """A displacement in mm is converted to cm, and a note says of which column."""
    content = csv(**{"Time__us": np.round(1e6 * T), f"Displacement__{unit}": X1})
    record = read(tmp_path, CM, 'kind = "decay"\ncarts = [2]', content).records[0]
    assert record.carts == (2,)  # the only free cart
    assert_allclose(record.position(2), factor * X1, rtol=1e-12)
    assert_allclose(record.t, T, atol=0.5e-6)
    (headed,) = record.heading_units
    assert (headed.role, headed.unit, headed.converts) == ("position", unit, True)
    assert record.position_scale == pytest.approx(factor)
    notes = facts(record.notes)
    assert [note.about for note in notes.values() if note.code == "converted"] == (
        [f"Displacement [{unit}]"] if factor != 1.0 else []
    )


@pytest.mark.parametrize(
    "headings",
    [
        ("t", "u", "x1", "x2"),
        ("Time (s)", "Voltage [V]", "Cart 1 Position (cm)", "Cart 2 Position (cm)"),
        ("time_s", "u_V", "x1_cm", "x_2_cm"),
        ("TIME", "Control Effort", "pos1", "pos2"),
        ("timestamp", "motor voltage", "Cart 1", "Cart 2"),
        ("time_ms", "duty cycle", "x1_mm", "position 2 [m]"),
    ],
)
def test_the_usual_headings_are_understood(headings, tmp_path):
    """Headings that students commonly use for time, input and positions are understood."""
    record = read(
        tmp_path, CM, STEP, csv(a=T, b=U, c=X1, d=X2).replace("a,b,c,d", ",".join(headings))
    ).records[0]
    milli = headings[0] == "time_ms"
    assert_allclose(record.t, T * (1e-3 if milli else 1.0), atol=1e-6)
    assert record.u is not None
    assert_array_equal(record.u, U)
    assert_allclose(record.position(1), X1 * (0.1 if milli else 1.0), rtol=1e-12)
    assert_allclose(record.position(2), X2 * (100.0 if milli else 1.0), rtol=1e-12)


def test_a_copied_file_is_reported(tmp_path):
    """If two experiments have files with the same bytes, a warning says so."""
    toml = "version = 1\n[system]\ncarts = 2\n"
    for name in ("one", "two"):
        toml += f'[[experiments]]\nid = "{name}"\nkind = "step"\nfile = "{name}.csv"\n'
        (tmp_path / f"{name}.csv").write_text(csv(time=T, input=U, x1=X1))
    (tmp_path / "submission.toml").write_text(toml)
    assert facts(read_data(load_submission(tmp_path)).warnings)["copy"].about == "two.csv"


def test_one_displacement_of_several_free_carts_needs_a_name(tmp_path):
    """If several carts are free, a single displacement column without a number is an error."""
    content = csv(**{"Time__us": np.round(1e6 * T), "Displacement__mm": X1})
    with pytest.raises(SubmissionError, match=r"Displacement \[mm\]"):
        read(tmp_path, CM, 'kind = "decay"', content)
    named = 'kind = "decay"\ncolumns = { x1 = "Displacement [mm]" }'
    assert read(tmp_path, CM, named, content).records[0].carts == (1,)


@pytest.mark.parametrize(
    ("system", "code", "said"),
    [
        ("", "fractions", '"cm"'),
        ('position = { unit = "count" }', "fractions", '"cm"'),
        ('position = { unit = "cm" }', "", ""),
        ('position = { unit = "deg" }', "", ""),
        ('position = { unit = "furlong" }', "unknown_unit", "position"),
        ('position = { unit = "CM" }', "unknown_unit", "'cm'"),
        ('position = { unit = "µm" }', "", ""),
        ('position = { unit = "in" }\ninput = { unit = "N" }', "", ""),
        ('position = { unit = "turn" }\ninput = { unit = "duty" }', "", ""),
        ('position = { unit = "rad" }\ninput = { unit = "A" }', "", ""),
        ('position = { unit = "mm" }\ninput = { unit = "furlong" }', "unknown_unit", "input"),
    ],
)
def test_a_unit_that_benches_do_not_use_is_asked_about(system, code, said, tmp_path):
    """An unknown unit is questioned, and so are positions with decimals in counts."""
    folder = tmp_path / "s"
    data = read(folder, system, STEP, csv(time=T, input=U, x1=Y[0] / 440, x2=Y[1] / 440))
    checks = check_units(data.records, bench=load_submission(folder).system.bench)
    assert [check.code for check in checks] == [code] * bool(code)
    assert all(said in check.message for check in checks)


def test_a_heading_in_another_unit_is_asked_about(tmp_path):
    """If a heading states cm but the submission states counts, cartlab asks which is right."""
    folder = tmp_path / "s"
    data = read(folder, "", STEP, csv(time=T, input__N=U, x1__cm=Y[0] / 440, x2=X2))
    checks = check_units(data.records, bench=load_submission(folder).system.bench)
    assert [check.id for check in checks] == ["position_unit", "input_unit"]
    assert [(one.role, one.unit, one.converts) for one in data.records[0].heading_units] == [
        ("position", "cm", False), ("input", "N", False),
    ]  # fmt: skip
    assert ['"cm"' in checks[0].message, '"N"' in checks[1].message] == [True, True]
    whole = read(tmp_path / "t", "", STEP, csv(time=T, input__V=U, x1__mm=X1, x2__mm=X2))
    (check,) = check_units(whole.records, bench=load_submission(tmp_path / "t").system.bench)
    assert '"mm"' in check.message


def bench_log(effort: np.ndarray) -> str:
    """Write the bench's own tab-separated log."""
    lines = ["Sample\tTime\tEncoder 1 Pos\tEncoder 2 Pos\tControl Effort"]
    rows = zip(T, X1, X2, effort, strict=True)
    lines += [f"{i}\t{t:.3f}\t{a:g}\t{b:g}\t{u:g}" for i, (t, a, b, u) in enumerate(rows, start=1)]
    return "\n".join(lines) + "\n"


PER_COUNT = 'input = { unit = "V", sign = 1, per_count = 1e-4 }'
DUTY, LARGE = np.round(40_960 * U), np.round(51_200 * U)


def plain(u: np.ndarray) -> str:
    return csv(time=T, input=u, x1=X1)


INPUTS = {
    # name: what `[system]` states, how the input is written, its numbers, input units per number
    "a bench log": ("", bench_log, DUTY, DUTY_COUNT),
    "a stated duty count": (PER_COUNT, bench_log, DUTY, 1e-4),
    "an effort with fractions": ("", bench_log, U, 1.0),
    "large whole numbers": (PER_COUNT, plain, LARGE, 1e-4),
    "the same with a point": (
        PER_COUNT, lambda u: plain(u).replace(",512,", ",512.0,"), LARGE, 1e-4,
    ),
    "a step of one volt": (PER_COUNT, plain, 100 * U, 1.0),
    "fractions": (PER_COUNT, plain, U, 1.0),
    "a heading in volts": (
        PER_COUNT, lambda u: csv(time=T, input__V=u, x1=X1), 3000 * U, 1.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", INPUTS)
def test_duty_counts_become_input_units(name, tmp_path):
    """Duty counts are scaled: 4096 to 5 V, or as stated; a scale without counts is reported."""
    system, write, numbers, scale = INPUTS[name]
    data = read(tmp_path, system, STEP, write(numbers))
    (record,) = data.records
    assert record.u is not None
    assert_allclose(record.u, scale * numbers, rtol=1e-15)
    assert_allclose(record.input_scale, scale, rtol=1e-15)
    unused = bool(system) and scale == 1.0
    assert [*facts(data.warnings)] == ["per_count_unused"] * unused
    assert len(data.warnings) == unused


@pytest.mark.parametrize(
    ("stated", "unused"),
    [
        ('{ input = "input", x1 = 3 }', None),
        ('{ input = "Input", x1 = "Weg", x2 = 9 }', "x1, x2"),
    ],
)
def test_columns_of_all_files_that_no_file_has_are_reported(stated, unused, tmp_path):
    """A warning names the key of `[system] columns` and the columns that exist."""
    system = f"columns = {stated}"
    data = read(tmp_path, system, STEP, csv(time=T, input=U, x1=X1))
    found = [(note.code, note.about) for note in facts([data.misnamed]).values()]
    assert found == ([("no_column", unused)] if unused else [])
    assert ("time, input, x1" in data.misnamed) == bool(unused)


def test_a_wrong_column_of_all_files_is_named_if_nothing_can_be_read(tmp_path):
    """If no file can be read, the error names the wrong key of `[system] columns` first."""
    with pytest.raises(SubmissionError, match=r"columns: x1 .*'Wge'.*'Weg'"):
        read(tmp_path, 'columns = { x1 = "Wge" }', STEP, csv(time=T, input=U, Weg=X1))


def test_the_bench_mat_layouts_agree_with_its_log(tmp_path):
    """Both .mat layouts and the text log of a run give the same record."""
    duty, reference = np.round(40_960 * U), np.where(T > 0.5, 300.0, 0.0)
    stamps = np.round(T, 3)
    stream, other = BytesIO(), BytesIO()
    scipy.io.savemat(
        stream,
        {"enc1": X1.astype("i2"), "enc2": X2.astype("i2"), "target_v": reference.astype("u2"),
         "duty": duty.astype("i2"), "time": stamps},
    )  # fmt: skip
    scipy.io.savemat(
        other,
        {"cart1pos": X1.astype("i4"), "cart2pos": X2.astype("i4"), "target_value": reference,
         "duty_cycle": duty.astype("i2"), "t_received": stamps},
    )  # fmt: skip
    log = read(tmp_path, CM, STEP, bench_log(duty)).records[0]
    for raw in (stream.getvalue(), other.getvalue()):
        record = read(tmp_path, CM, LOOP, raw).records[0]
        assert_array_equal(record.t, log.t)
        assert_array_equal(record.y, log.y)
        assert_array_equal(record.u, log.u)
        assert record.reference is not None
        assert_allclose(record.reference, 0.00227 * reference, rtol=1e-15)


def test_a_bare_matrix_is_read_by_column_numbers(tmp_path):
    """`columns` names the columns of a matrix by number; whole positions are counts."""
    stream = BytesIO()
    scipy.io.savemat(stream, {"data": np.column_stack([np.arange(N), T, X1, X2, U])})
    columns = STEP + "\ncolumns = { time = 2, x1 = 3, x2 = 4, input = 5 }"
    record = read(tmp_path, CM, columns, stream.getvalue()).records[0]
    assert_allclose(record.y, 0.00227 * np.array([X1, X2]), rtol=1e-15)
    assert facts(record.notes)["unused"].about == "1"


def test_the_system_names_the_columns_of_all_its_recordings(tmp_path):
    """`columns` of `[system]` holds for all files, unless an experiment states its own."""
    named = CM + '\ncolumns = { x1 = "first", x2 = "second", reference = "goal" }'
    content = csv(time=T, input=U, first=X1, second=X2)
    record = read(tmp_path, named, STEP, content).records[0]
    assert_allclose(record.y, np.array([X1, X2]), rtol=1e-6)
    own = STEP + '\ncolumns = { x1 = "second" }'
    record = read(tmp_path, named, own, content).records[0]
    assert record.carts == (1,)
    assert_allclose(record.position(1), X2, rtol=1e-6)


def test_a_sample_rate_stands_in_for_a_time_column(tmp_path):
    """Without a time column the samples are spaced by the stated sample rate."""
    record = read(tmp_path, "", STEP + "\nsample_rate = 113.0", csv(u=U, x1=X1)).records[0]
    assert_allclose(record.t, np.arange(N) / 113.0, rtol=1e-15)


def test_a_sample_rate_against_the_time_column_is_mentioned(tmp_path):
    """If a file has a time column, a stated sample rate is not used, and a note says so."""
    record = read(tmp_path, "", STEP + "\nsample_rate = 200.0", csv(t=T, u=U, x1=X1)).records[0]
    assert_allclose(record.t, T, atol=1e-6)
    assert "rate_unused" in facts(record.notes)
    near = read(tmp_path, "", STEP + "\nsample_rate = 112.5", csv(t=T, u=U, x1=X1)).records[0]
    assert "rate_unused" not in facts(near.notes)  # within 1 % of the true 112.94 Hz


def test_a_window_keeps_its_part_of_the_times(tmp_path):
    """A window keeps the samples between its ends, with their times from the file."""
    record = read(tmp_path, "", STEP + "\nwindow = [1.0, 2.0]", csv(time=T, u=U, x1=X1)).records[0]
    inside = (T >= 1.0) & (T <= 2.0)
    assert_allclose(record.t, T[inside], atol=1e-6)
    assert_array_equal(record.position(1), X1[inside])
    end = STEP + f"\nwindow = [1.0, {T[-1] + 0.04:.3f}]"
    assert read(tmp_path, "", end, csv(time=T, u=U, x1=X1)).records[0].t[-1] == pytest.approx(T[-1])
    ends = STEP + f"\nwindow = [{T[10]:.7f}, {T[20]:.7f}]"
    both = read(tmp_path, "", ends, csv(time=T, u=U, x1=X1)).records[0]
    assert_allclose(both.t, T[10:21], atol=1e-6)  # the samples at both ends belong to it


STUCK = np.round(440 * 5 * np.sin(6 * T))
STUCK[200:240] = STUCK[199]
SWEEP = csv(time=T, input=np.sin((3 + 2 * T) * T), x1=STUCK)
COPY = np.round(0.5 * X1 + 0.5 * np.r_[0.0, X1[:-1]])
SIX = csv(time=T, input=U, x1=X1, x3=X2, temperature=0 * T)
NOTES = {
    # name: experiment, content, code of the note, its column, its samples
    "whole seconds": (STEP, csv(time=np.arange(N), input=U, x1=X1), "slow", "time", ()),
    "too many columns": (STEP, SIX, "unused", "temperature, x3", ()),
    "a stuck encoder": ('kind = "sweep"', SWEEP, "stuck", "x1", (199, 239)),
    "a commanded position that copies encoder 1": (
        LOOP, ecp(reference=COPY, x1=X1, effort=U), "copied", "Commanded Pos", (),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NOTES)
def test_what_is_odd_in_a_file_is_noted(name, tmp_path):
    """A note names the column and the samples; nothing is dropped, and no copy is a reference."""
    experiment, content, code, about, at = NOTES[name]
    record = read(tmp_path, CM, experiment, content).records[0]
    note = facts(record.notes)[code]
    assert (note.about, note.at) == (about, at)
    assert (record.t.size, record.reference) == (N, None)


# ---------------------------------------------------------------- references and signs


def test_a_commanded_position_is_the_reference_under_feedback_only(tmp_path):
    """An ECP's commanded position is the reference in a closed loop, and ignored in open loop."""
    content = ecp(reference=np.where(T > 0.5, 1000.0, 0.0), x1=X1, effort=U)
    closed = read(tmp_path, CM, LOOP, content).records[0]
    assert closed.reference is not None
    assert (closed.reference.min(), closed.reference.max()) == (0.0, 2.27)
    assert read(tmp_path, CM, STEP, content).records[0].reference is None


def test_a_stated_reference_replaces_that_of_the_file(tmp_path):
    """A stated `reference` is a constant in position units, and replaces the file's reference."""
    content = csv(time=T, input=U, x1=X1, reference=0 * T)
    record = read(tmp_path, CM, LOOP + "\nreference = 1.5", content).records[0]
    assert record.reference is not None
    assert_array_equal(record.reference, 1.5)
    assert read(tmp_path, CM, LOOP, csv(time=T, x1=X1)).records[0].reference is None


@pytest.mark.parametrize("sign", [1, -1])
def test_an_unstated_sign_is_found(sign, tmp_path):
    """If no sign is stated, the data decide it, so that positive input pushes to positive x.

    This is an assumption and no warning.
    """
    data = read(tmp_path, "", STEP, csv(time=T, input=sign * U, x1=X1))
    assert_array_equal(data.records[0].u, U)
    assert data.records[0].input_scale == sign
    assert (data.signs.stated, data.signs.found) == ({}, {"a": sign})
    assert data.warnings == ()


def test_a_stated_sign_is_used_and_a_doubtful_one_reported(tmp_path):
    """A stated sign is used even if the data contradict it, and a check reports that."""
    content = csv(time=T, input=U, x1=X1)
    data = read(tmp_path, 'input = { unit = "V", sign = -1 }', STEP, content)
    assert_array_equal(data.records[0].u, -U)
    (check,) = check_signs(data.signs, without=())
    assert (check.id, check.outcome, check.value) == ("input.sign", "fail", 1.0)
    assert "sign = 1" in check.message
    own = STEP + "\ninput = { sign = 1, per_count = 2.0 }"
    data = read(tmp_path, 'input = { unit = "V", sign = -1 }', own, content)
    assert_array_equal(data.records[0].u, 2 * U)
    assert data.warnings == ()


def test_a_wrong_sign_of_a_session_is_one_sentence(tmp_path):
    """A single check names all records that contradict the stated sign, and the remedy."""
    toml = 'version = 1\n[system]\ncarts = 2\ninput = { unit = "V", sign = 1 }\n'
    for name, scale in {"one": -1, "two": -2, "right": 1}.items():
        toml += f'[[experiments]]\nid = "{name}"\nkind = "step"\nfile = "{name}.csv"\n'
        (tmp_path / f"{name}.csv").write_text(csv(time=T, input=scale * U, x1=abs(scale) * X1))
    (tmp_path / "submission.toml").write_text(toml)
    signs = read_data(load_submission(tmp_path)).signs
    (check,) = check_signs(signs, without=())
    assert check.value == 2.0
    assert signs.found == {"one": -1, "two": -1, "right": 1}
    assert re.search(r"one, two\b.*sign = -1\b", check.message)


def test_signs_may_differ_between_experiments(tmp_path):
    """Each record gets the sign that it shows, or else the sign of other records of its kind."""
    toml = "version = 1\n[system]\ncarts = 2\n"
    runs = {
        "step": ("step", csv(time=T, input=-U, x1=X1)),
        "loop": ("closed_loop", csv(time=T, input=U, x1=X1)),
        "blind": ("closed_loop", csv(time=T, input=U, x2=X2)),
        "free": ("decay", csv(time=T, input=0 * U, x1=X1)),
    }
    for name, (kind, content) in runs.items():
        toml += f'[[experiments]]\nid = "{name}"\nkind = "{kind}"\nfile = "{name}.csv"\n'
        (tmp_path / f"{name}.csv").write_text(content)
    (tmp_path / "submission.toml").write_text(toml)

    data = read_data(load_submission(tmp_path))

    assert [record.input_scale for record in data.records[:3]] == [-1.0, 1.0, 1.0]
    assert {name: sign for name, sign in data.signs.found.items() if sign} == {
        "step": -1, "loop": 1,
    }  # fmt: skip
    (said,) = data.warnings
    assert re.findall(r"[+-]1\b|\bstep\b|\bblind\b", said) == ["-1", "step", "+1"]
    assert list(data.files) == sorted(f"{name}.csv" for name in runs)


def test_a_sign_that_the_data_do_not_show_is_assumed(tmp_path):
    """If cart 1 is not measured, the input's sign is taken as +1: an assumption, no warning."""
    data = read(tmp_path, "", STEP, csv(time=T, input=U, x2=X2))
    assert_array_equal(data.records[0].u, U)
    assert not any(data.signs.found.values())
    assert data.records[0].input_scale == 1.0
    assert data.warnings == ()


def test_a_dwell_carries_its_frequency(tmp_path):
    """A dwell's stated frequency in Hz becomes rad/s; if it is missing, the fit finds it."""
    content = csv(time=T, input=np.sin(10 * T), x1=X1)
    with_f = read(tmp_path, "", SINE + "\nfrequency = 4.0", content).records[0]
    assert with_f.omega == pytest.approx(8 * np.pi)
    without = read(tmp_path, "", SINE, content).records[0]
    assert without.omega is None


# ------------------------------------------------------------------------- Bode tables


def test_a_bode_table_gives_one_response_per_cart(tmp_path):
    """A Bode table in Hz becomes one response per cart, sorted, with 1 % assumed as error."""
    f = np.array([4.0, 1.0, 2.0])
    data = read(tmp_path, "", 'kind = "bode"', csv(frequency=f, x1=f + 1, x2=f + 2))
    first, second = data.tables
    assert (first.cart, second.cart, first.source) == (1, 2, "table")
    assert_allclose(first.omega, 2 * np.pi * np.array([1.0, 2.0, 4.0]), rtol=1e-9)
    assert_allclose(first.magnitude, [2.0, 3.0, 5.0], rtol=1e-15)
    assert_allclose(second.magnitude_std, 0.01 * second.magnitude, rtol=1e-15)
    assert first.phase is None
    assert "1%" in data.warnings[0]


def test_repeats_in_a_bode_table_give_its_standard_errors(tmp_path):
    """Repeats in a Bode table are averaged, and their spread gives the error of every point."""
    rng = np.random.default_rng(11)
    f = np.repeat(np.geomspace(0.5, 8.0, 100), 4)
    x = (1 + f) * np.exp(0.03 * rng.standard_normal(f.size))
    (response,) = read(tmp_path, "", 'kind = "bode"', csv(frequency=f, x1=x)).tables
    assert response.omega.size == 100
    # With 300 degrees of freedom a standard deviation is accurate to 1/sqrt(600) = 4 %. The limit
    # is three times that.
    assert_allclose(response.magnitude_std / response.magnitude, 0.03 / 2, rtol=0.12)


@pytest.mark.parametrize("repeats", [4, 9])
def test_the_error_of_a_ratio_falls_with_the_root_of_its_repeats(repeats):
    """The `frequency_responses` of a table have the spread of one ratio over √(repeats)."""
    ratios = [2.0 * np.exp(0.03 * (-1) ** i) for i in range(repeats)]
    points = {1: [(5.0, ratio) for ratio in ratios] + [(9.0, 1.0)]}
    ((response,), _) = frequency_responses(points)
    spread = np.std(np.log(ratios), ddof=1)
    relative = response.magnitude_std / response.magnitude
    assert_allclose(relative, [spread / np.sqrt(repeats), spread])


def test_a_bode_table_may_be_in_rad_per_s_and_db(tmp_path):
    """Headings of a Bode table may state rad/s and dB."""
    content = csv(**{"omega__rad/s": np.array([10.0, 20.0]), "x1__dB": np.array([20.0, 0.0])})
    (response,) = read(tmp_path, "", 'kind = "bode"', content).tables
    assert_allclose(response.omega, [10.0, 20.0], rtol=1e-9)
    assert_allclose(response.magnitude, [10.0, 1.0], rtol=1e-12)


def test_a_bode_table_with_held_carts_is_left_out(tmp_path):
    """A Bode table with some carts held belongs to another plant, and is left out with a note."""
    content = csv(frequency=np.array([1.0, 2.0]), x1=np.array([1.0, 2.0]))
    data = read(tmp_path, "", 'kind = "bode"\ncarts = [1]', content)
    assert data.tables == ()
    assert facts(data.warnings)["held"].about == "a"
