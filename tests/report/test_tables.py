"""A report's tables show the students' own numbers, the limits and the dwells."""

from dataclasses import replace
from decimal import Decimal

from pipeline.estimation.estimates import list_off
from pipeline.report.builder import Page
from pipeline.report.document import Table
from pipeline.report.sections.measurements import dwell_table
from pipeline.report.sections.parameters import parameter_blocks, parameter_table, reported_table
from pipeline.report.sections.summary import terminal_summary
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.pages import rows


def page(estimates, reported=None) -> Page:
    """Return a page of one cart with these estimates and reported numbers."""
    typed = reported or {}
    analysis = replace(make_analysis(1), rows=tuple(estimates), reported=typed)
    return Page(replace(analysis, reported_off=list_off(analysis.rows, typed)))


def test_a_wrong_reported_number_gets_a_hint():
    """If a reported number is off by a factor of 2π, a hint names the likely mistake.

    A number that is merely rounded gets no hint.
    """
    estimates = make_analysis(1).rows
    true = {row.name: row.final.value for row in estimates if row.final}
    mine = {"K": f"{true['K']:.3g}", "omega_n": f"{true['omega_n'] / 6.2832:.3g}"}
    shown = page(estimates, {"initial": {}, "final": {k: Decimal(v) for k, v in mine.items()}})
    more = set(terminal_summary(shown.analysis).splitlines())
    (hint,) = more - set(terminal_summary(page(estimates).analysis).splitlines())
    assert "ω_n" in hint
    assert "K" not in hint
    found = rows([reported_table(shown, beside=1)])
    assert (found["K"][4], found["K"][-1]) == (mine["K"], "")
    assert found["ω_n"][-2] == "−84.1 %"
    assert "Hz" in found["ω_n"][-1]


def test_a_number_is_not_compared_with_an_assumed_value():
    """A student's number is not compared with a value that the program assumed."""
    row = make_analysis(1).rows[0]
    assert row.initial
    assumed = replace(row, initial=replace(row.initial, source="assumed"))
    shown = page([assumed], {"initial": {row.name: Decimal("99999")}})
    table = reported_table(shown, beside=1)
    assert plain(table.rows[0][4].text) == "–"
    assert plain(table.rows[0][-1].text) == ""


def test_a_number_without_an_estimate_has_a_dash():
    """A reported number without an estimate has a dash next to it.

    A wrong mass gets no hint, since no known mistake explains it.
    """
    row = make_analysis(1).rows[0]
    mine = {row.name: Decimal("3.0")}
    table = reported_table(page([replace(row, final=None)], {"final": mine}), beside=1)
    assert [plain(cell.text) for cell in table.rows[0]][5:] == ["3.0", "–", "–", ""]
    mass = replace(row, name="mass", unit="V s^2/cm")
    table = reported_table(page([mass], {"final": {"mass": Decimal("99999")}}), beside=1)
    assert table.rows[0][-2].tone == "bad"
    assert plain(table.rows[0][-1].text) == ""


def test_a_verdict_is_shown_beside_its_limit():
    """Next to each verdict is its limit: 15 % for frequencies and 50 % for dampings."""
    judged = [row for row in make_analysis(1).rows if row.consistent is not None]
    limits = {name: row[5] for name, row in rows([parameter_table(page(judged))]).items()}
    assert (limits["ω_n"], limits["ζ"]) == ("15 %", "50 %")


def test_a_dwell_that_did_not_settle_is_marked():
    """The table lists every dwell and cart, and marks a dwell that did not settle."""
    analysis = make_analysis(2)
    settled = [replace(point, settled=True) for point in analysis.sine_points]
    points = (replace(settled[0], settled=False), *settled[1:])
    table = dwell_table(Page(replace(analysis, sine_points=points)))
    assert len(table.rows) == len(points)
    assert [cell.tone for row in table.rows for cell in row if cell.tone] == ["bad"]


def test_without_any_estimate_there_is_no_table():
    """If nothing was estimated and nothing reported, a sentence replaces the empty table."""
    full = make_analysis(1)
    empty = [replace(row, initial=None, final=None) for row in full.rows]
    nothing = replace(full, rows=tuple(empty), reported={"initial": {}, "final": {}}, fit=None)
    for analysis, has_table in ((nothing, False), (full, True)):
        blocks = parameter_blocks(Page(analysis))
        assert any(isinstance(block, Table) for block in blocks) == has_table
