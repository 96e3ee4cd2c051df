"""Tables of a report: the students' own numbers, the limits, the dwells."""

from dataclasses import replace
from decimal import Decimal

from pipeline.report.document import plain
from pipeline.report.tables.parameters import parameter_table, reported_table
from pipeline.report.tables.records import dwell_table
from tests.helpers.analysis_factory import make_analysis


def test_a_number_of_ones_own_that_is_off_says_what_to_look_at():
    """Off by a factor of 2 pi: the frequency says so; what is only rounded says nothing."""
    rows = make_analysis(1).rows
    true = {row.name: row.final.value for row in rows if row.final}
    mine = {"K": f"{true['K']:.3g}", "omega_n": f"{true['omega_n'] / 6.2832:.3g}"}
    table = reported_table(
        rows, {"initial": {}, "final": {k: Decimal(v) for k, v in mine.items()}}, number=1
    )
    gain, frequency = ([plain(cell.text) for cell in row] for row in table.rows)
    assert gain[2] == mine["K"]
    assert gain[-1] == ""
    assert frequency[-2] == "−84.1 %"
    assert "Hz" in frequency[-1]


def test_what_was_assumed_says_nothing_of_a_number():
    """A guess is no measurement to hold a student's number against."""
    row = make_analysis(1).rows[0]
    assert row.initial
    assumed = replace(row, initial=replace(row.initial, source="assumed"))
    table = reported_table([assumed], {"initial": {row.name: Decimal("99999")}}, number=1)
    assert [plain(cell.text) for cell in table.rows[0]][-2:] == ["–", ""]


def test_nothing_found_and_no_known_slip_say_nothing():
    """A number without an estimate stands beside a dash; a wrong mass gets no hint of another."""
    row = make_analysis(1).rows[0]
    mine = {row.name: Decimal("3.0")}
    table = reported_table([replace(row, final=None)], {"final": mine}, number=1)
    assert [plain(cell.text) for cell in table.rows[0]][3:] == ["–", row.unit, "–", ""]
    mass = replace(row, name="mass", unit="V s^2/cm")
    table = reported_table([mass], {"final": {"mass": Decimal("99999")}}, number=1)
    assert table.rows[0][-2].tone == "bad"
    assert plain(table.rows[0][-1].text) == ""


def test_agree_stands_beside_its_limit():
    """A gain within 15 %, a damping ratio within 50 %."""
    rows = [row for row in make_analysis(1).rows if row.consistent is not None]
    table = parameter_table(rows, number=1, carts=1)
    limits = {plain(row[0].text): plain(row[6].text) for row in table.rows}
    assert limits["ω_n"] == "15 %"
    assert limits["ζ"] == "50 %"


def test_a_dwell_that_did_not_settle_is_said():
    """The table has every dwell and cart."""
    settled = [replace(point, settled=True) for point in make_analysis(2).sine_points]
    points = [replace(settled[0], settled=False), *settled[1:]]
    table = dwell_table(points, number=1, units=("cm", "V"))
    assert len(table.rows) == len(points)
    assert [cell.tone for row in table.rows for cell in row if cell.tone] == ["bad"]
