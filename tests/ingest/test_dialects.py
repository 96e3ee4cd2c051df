"""One step in the dialects of many programs gives the same time, input and position."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.errors import SubmissionError
from pipeline.ingest.clock import unroll
from pipeline.ingest.columns import (
    FACTORS,
    assign_columns,
    conversion,
    parse_heading,
    refuse_unknown_unit,
)
from pipeline.ingest.files import parse_table, parse_tables
from pipeline.ingest.table import FileTable
from pipeline.ingest.text import Layout
from tests.helpers.recordings import facts

N = 200
T = 0.005 * np.arange(N)
U = np.where(T > 0.1, 1.0, 0.0)
X = 2 * U * (1 - np.exp(-2 * (T - 0.1)) * np.cos(20 * (T - 0.1)))


def rows(*columns: np.ndarray, sep: str = ",", form: str = "{:.6f}") -> str:
    """Return lines of numbers."""
    return "".join(sep.join(map(form.format, row)) + "\n" for row in zip(*columns, strict=True))


def signals(table: FileTable) -> dict[str, np.ndarray]:
    """Return time in s from its start, input in V and position in cm."""
    columns, _ = assign_columns(table, explicit=None, free=(1,))
    wanted = {"time": "s", "input": "V", "x1": "cm"}
    found = {
        role: table.values[columns[role].index] * (conversion(columns[role].unit, unit) or np.nan)
        for role, unit in wanted.items()
    }
    stamps = unroll(found["time"])
    return {**found, "time": stamps - stamps[0]}


def stamped(form: str) -> str:
    """Return rows whose first cell is a time of day that passes midnight after 0.5 s."""
    lines = ""
    for t, u, x in zip(T, U, X, strict=True):
        day, clock = (
            ("14", f"23:59:{59.5 + t:06.3f}") if t < 0.4999 else ("15", f"00:00:{t - 0.5:06.3f}")
        )
        lines += f"{form.format(day=day, clock=clock)};{u};{x:.6f}\n"
    return lines


PLAIN = rows(T, U, X)
GERMAN = rows(1e3 * T, U, 10 * X, sep=";").replace(".", ",")
DIALECTS = {
    "slash": "t/s,u/V,x1/mm\n" + rows(T, U, 10 * X),
    "slash with spaces": "t / s,u / V,x1 / mm\n" + rows(T, U, 10 * X),
    "comma": "t, s;u, V;x1, mm\n" + rows(T, U, 10 * X, sep=";"),
    "in": "time in s;input in V;x1 in mm\n" + rows(T, U, 10 * X, sep=";"),
    "words": "time [msec],voltage [volts],displacement [inches]\n" + rows(1e3 * T, U, X / 2.54),
    "minutes": "time (minutes),input (V),x1 (cm)\n" + rows(T / 60, U, X, form="{:.9f}"),
    "German": "Zeit in ms;Spannung in V;Weg in mm\n" + GERMAN,
    "row of units in brackets": "time;voltage;x1\n[ms];[mV];[mm]\n"
    + rows(1e3 * T, 1e3 * U, 10 * X, sep=";"),
    "row of units in brackets, the first a sign": "load;time;voltage;x1\n[%];[ms];[mV];[mm]\n"
    + rows(50 * U, 1e3 * T, 1e3 * U, 10 * X, sep=";"),
    "remarks in brackets": "[2024-05-01 12:00] start\n[note: cart 2 is held]\nt,u,x1\n" + PLAIN,
    "matrix below a short one": "% time (s)  u (V)  x1 (cm)\ncarts = [1 2];\ndata = [\n"
    + PLAIN + "];\n",
    "row of units": "Time\tVoltage\tPosition\n(ms)\t(mV)\t(mm)\n\n"
    + rows(1e3 * T, 1e3 * U, 10 * X, sep="\t"),
    "three rows": "Run #1,Run #1,Run #1\nTime,Voltage,Position\ns,V,mm\n" + rows(T, U, 10 * X),
    "Capstone": '"Time (s) Run #1","Voltage (V) Run #1","Position (mm) Run #1"\n'
    + rows(T, U, 10 * X),
    "Logger Pro": "Latest: Time (s)\tLatest: Potential (V)\tLatest: Position (m)\n"
    + rows(T, U, X / 100, sep="\t"),
    "settings above": "Operator,A\nRate,200\n\ntime [s],input [V],x1 [cm]\n" + PLAIN,
    "twenty lines above": "\n".join(f"Setting {i}: {i}" for i in range(20))
    + "\ntime [s],input [V],x1 [cm]\n" + PLAIN,
    "rule": "| time [s] | input [V] | x1 [cm] |\n|---|---|---|\n"
    + "".join(f"| {line.replace(',', ' | ')} |\n" for line in PLAIN.splitlines()),
    "aligned": "Time (s)   input (V)   x1 (cm)\n" + rows(T, U, X, sep="   "),
    "comments": "# time [s]\tinput [V]\tx1 [cm]\n#\n" + rows(T, U, X, sep="\t"),
    "Fortran": "time,input,x1\n" + rows(T, U, X, sep="  ", form="{:.9E}").replace("E", "D"),
    "quoted commas": '"time","input","x1"\n'
    + "".join(
        ",".join(f'"{cell}"' for cell in line.replace(".", ",").split("|")) + "\n"
        for line in rows(T, U, X, sep="|").splitlines()
    ),
    "thousands": "time [us],input [V],x1 [um]\n"
    + "".join(f'"{1e6 * t:,.0f}",{u},"{1e4 * x:,.2f}"\n' for t, u, x in zip(T, U, X, strict=True)),
    "midnight": "time;input [V];x1 [cm]\n" + stamped("{clock}"),
    "dates": "timestamp;input [V];x1 [cm]\n" + stamped("2026-02-{day}T{clock}"),
    "German dates": "Zeit;input [V];x1 [cm]\n" + stamped("{day}.02.2026 {clock}"),
    "rollover": "time [us],input [V],x1 [cm]\n" + rows((1e6 * T + 2**32 - 4e5) % 2**32, U, X),
    "state": "time [s],state,input [V],x1 [cm]\n"
    + "".join(f"{line.replace(',', ',OK,', 1)}\n" for line in PLAIN.splitlines()),
    "first row cut": "time [s],input [V],x1 [cm]\n05,0.1\n" + PLAIN,
    "line below": "time [s],input [V],x1 [cm]\n" + PLAIN + "End of data\n",
    "comment between the first rows": "time [s],input [V],x1 [cm]\n"
    + PLAIN.replace("\n", "\n# motor on\n", 1),
    "line after the first row": "time [s],input [V],x1 [cm]\n"
    + PLAIN.replace("\n", "\nmotor on\n", 1),
    "numbered rows": "#,time [s],input [V],x1 [cm]\n" + rows(np.arange(N), T, U, X),
    "F and omega": "t,F [V],x [cm],omega\n" + rows(T, U, X, X),
}  # fmt: skip


@pytest.mark.parametrize("content", DIALECTS.values(), ids=DIALECTS.keys())
def test_every_dialect_gives_the_same_signals(content):
    """Headings, units, cells and stamps of other programs change no signal."""
    got = signals(parse_table(content.encode(), source="f"))
    # The files hold six decimals, in the coarsest case of m or inches.
    assert_allclose(got["time"], T, rtol=0, atol=2e-6)
    assert_allclose(got["input"], U, rtol=0, atol=2e-6)
    assert_allclose(got["x1"], X, rtol=0, atol=6e-5)


@pytest.mark.parametrize("name", ["msec", "ms", "millis"])
def test_a_stated_time_column_that_is_named_by_its_unit_has_this_unit(name):
    """A heading that is only a unit of time gives the unit, and no factor of a thousand is lost."""
    table = parse_table(f"{name},input [V],x1 [cm]\n{rows(1e3 * T, U, X)}".encode(), source="f")
    columns, _ = assign_columns(table, explicit={"time": name}, free=(1,))
    assert conversion(columns["time"].unit, "s") == 1e-3


HEADING = "time [s],input [V],x1 [cm]\n"
SHORT = rows(T[:150], U[:150], 2 * X[:150]).splitlines()
RUNS = {
    "stacked": HEADING + PLAIN + "\n" + HEADING + "\n".join(SHORT),
    "stacked, begun during the first": HEADING
    + PLAIN
    + "\n"
    + HEADING
    + rows(T[:150] + 0.2, U[:150], 2 * X[:150]),
    "side by side": '"Time (s) Run #1","Voltage (V) Run #1","Position (cm) Run #1",'
    '"Time (s) Run #2","Voltage (V) Run #2","Position (cm) Run #2"\n'
    + "\n".join(
        f"{line},{SHORT[i] if i < 150 else ',,'}" for i, line in enumerate(PLAIN.splitlines())
    ),
}


@pytest.mark.parametrize("content", RUNS.values(), ids=RUNS.keys())
def test_the_runs_of_a_file_are_told_apart(content):
    """Runs below or beside each other are recordings of their own, of their own length."""
    first, second = parse_tables(content.encode(), source="f")
    assert (first.run, second.run) == ("1", "2")
    assert_allclose(signals(first)["x1"], X, atol=1e-6)
    assert_allclose(signals(second)["x1"], 2 * X[:150], atol=1e-6)


def test_rows_that_do_not_fit_are_skipped_and_shown():
    """A bad row in a hundred is skipped, and its line is named; more are refused."""
    lines = PLAIN.splitlines()
    lines[100] = "sensor off"
    got = parse_table((HEADING + "\n".join(lines)).encode(), source="f")
    assert got.values.shape == (3, N - 1)
    assert facts(got.notes)["skipped"].at == (102,)
    lines[99] = "sensor off"
    got = parse_table((HEADING + "\n".join(lines)).encode(), source="f")
    assert facts(got.notes)["skipped"].at == (101, 102)  # two of two hundred rows still may
    lines[50] = lines[51] = "0.1,nan,"
    with pytest.raises(SubmissionError, match="line 52"):
        parse_table((HEADING + "\n".join(lines)).encode(), source="f")


@pytest.mark.parametrize("broken", ["0,oops,1", "05,0.1"])
@pytest.mark.parametrize("last", [False, True])
def test_a_broken_row_at_either_end_is_skipped_and_shown(broken, last):
    """A first or last row that is cut off or garbled is skipped, and a note names its line."""
    lines = [*PLAIN.splitlines(), broken] if last else [broken, *PLAIN.splitlines()]
    got = parse_table((HEADING + "\n".join(lines)).encode(), source="f")
    assert got.names == tuple(HEADING.strip().split(","))
    assert got.values.shape == (3, N)
    assert got.cut is None
    ((code, note),) = facts(got.notes).items()
    assert (code, note.at) in [(c, (N + 2 if last else 2,)) for c in ("skipped", "cut_row")]
    assert len(got.notes) == 1


def test_a_column_with_many_bad_cells_is_refused_if_it_is_asked_for():
    """A column with bad cells in one row of eight is left out, and is refused by its name."""
    lines = [f"{row},{'' if i % 8 == 3 else i}" for i, row in enumerate(PLAIN.splitlines())]
    got = parse_table((HEADING.strip() + ",note\n" + "\n".join(lines)).encode(), source="f")
    assert got.names == tuple(HEADING.strip().split(","))
    assert [*got.partial] == ["note"]
    with pytest.raises(SubmissionError, match=r"'note'.*\b5,"):
        got.index("note")


@pytest.mark.parametrize("name", ["x1 [furlong]", "x1/furlong", "x1 (furlong)", "x1 in furlongs"])
def test_a_unit_that_is_not_known_is_asked_about(name):
    """A unit that is not known stops the reading; it is never ignored."""
    got = parse_table(f"time,input,{name}\n{PLAIN}".encode(), source="f")
    columns, _ = assign_columns(got, explicit={"x1": 3}, free=(1,))
    with pytest.raises(SubmissionError, match="furlong"):
        refuse_unknown_unit(got, columns["x1"])


@pytest.mark.parametrize("unit", ["kg", "N", "Hz", "s", "Nm"])
def test_a_position_in_the_unit_of_another_quantity_is_asked_about(unit):
    """A position in kg stops the reading, unless the submission states this unit."""
    got = parse_table(f"time,input [N],x1 [{unit}]\n{PLAIN}".encode(), source="f")
    columns, _ = assign_columns(got, explicit={"x1": 3, "input": 2}, free=(1,))
    refuse_unknown_unit(got, columns["input"])
    refuse_unknown_unit(got, columns["x1"], stated=unit)
    with pytest.raises(SubmissionError, match=f"'{unit}'"):
        refuse_unknown_unit(got, columns["x1"])


@pytest.mark.parametrize("ratio", ["m/s", "rad/s", "m/s^2", "V/s", "rev/min"])
@pytest.mark.parametrize("form", ["v [{}]", "v ({})", "v/({})", "v / ({})", "v/{}", "v / {}"])
def test_a_ratio_of_units_is_read_in_every_form(ratio, form):
    """A ratio of known units is the unit of a heading, with and without its own symbol."""
    got = parse_heading(form.format(ratio))
    assert (got.name, (got.unit or "").replace("^", "")) == ("v", ratio.replace("^", ""))


@pytest.mark.parametrize("name", ["x1 (left)", "u_in", "Encoder 1 Pos", "Position (cart 1)"])
def test_labels_are_no_units(name):
    """A label in a heading is a part of the name."""
    assert parse_heading(name).unit is None


# The sizes of all units, in the first unit of their quantity, from their definitions.
SIZES = {
    "s": {"ms": 1 / 1000, "us": 1 / 1e6, "ns": 1 / 1e9, "min": 60, "h": 3600},
    "m": {"dm": 1 / 10, "cm": 1 / 100, "mm": 1 / 1000, "um": 1 / 1e6, "in": 25.4 / 1000,
          "ft": 12 * 25.4 / 1000},
    "V": {"mV": 1 / 1000, "kV": 1000, "uV": 1 / 1e6},
    "N": {"mN": 1 / 1000, "kN": 1000},
    "A": {"mA": 1 / 1000},
    "Nm": {"mNm": 1 / 1000},
    "rad": {"mrad": 1 / 1000, "deg": np.pi / 180, "rev": 2 * np.pi},
    "Hz": {"kHz": 1000, "rad/s": 1 / (2 * np.pi)},
}  # fmt: skip


def test_every_unit_has_its_size():
    """Each known unit is converted by its definition, and no unit is left out here."""
    assert [{*units} for units in FACTORS.values()] == [{of, *sizes} for of, sizes in SIZES.items()]
    for of, sizes in SIZES.items():
        for unit, size in sizes.items():
            assert conversion(unit, of) == pytest.approx(size, rel=1e-14)
            assert conversion(of, unit) == pytest.approx(1 / size, rel=1e-14)


@pytest.mark.parametrize(
    ("typed", "comma", "number"),
    [
        ("1,5", True, 1.5),
        ("-1.234,5", True, -1234.5),
        ("1 234,5", True, 1234.5),
        ("1.234.567", True, 1_234_567.0),
        ("\u22120,5", True, -0.5),
        ("1,5D+03", True, 1500.0),
        (" '0,5' ", True, 0.5),
        ("1,234.5", False, 1234.5),
        ("1'234'567.5", False, 1_234_567.5),
        ("1.5d-3", False, 0.0015),
        ("\u22120.5", False, -0.5),
        ("12:30:15", False, 45_015.0),
        ("0:00:01.25 PM", False, 43_201.25),
        ("12:30:00 pm", False, 45_000.0),
        ("12:30:00 AM", False, 1_800.0),
        ("1:00:00 pm", False, 46_800.0),
    ],
)
def test_a_cell_is_read_as_typed(typed, comma, number):
    """Decimal commas, thousands, D exponents, long minus signs and times of day are read."""
    assert Layout(";", comma=comma).value(typed) == pytest.approx(number, rel=1e-15)
