"""A student's own table of amplitude ratios is compared with the student's dwells."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.grading.mistakes.reduced import diagnose_reduced
from pipeline.results import Analysis, FrequencyResponse
from tests.helpers.grading_students import student

TURN = 2 * np.pi


def reduced(analysis: Analysis) -> tuple[FrequencyResponse, ...]:
    """Return an honest table: half the swing of the last three cycles, with 1 % reading error."""
    runs = {record.id: record for record in analysis.records}
    rng = np.random.default_rng(5)
    tables = []
    for cart in range(1, analysis.bench.n + 1):
        points = sorted((p for p in analysis.sine_points if p.cart == cart), key=lambda p: p.omega)
        ratios = []
        for point in points:
            record = runs[point.experiment]
            assert record.u is not None
            last = record.t >= record.t[-1] - 3 * TURN / point.omega
            ratios.append(np.ptp(record.position(cart)[last]) / np.ptp(record.u[last]))
        magnitude = np.array(ratios) * (1 + 0.01 * rng.standard_normal(len(ratios)))
        table = FrequencyResponse(
            cart=cart, omega=np.array([p.omega for p in points]), magnitude=magnitude,
            magnitude_std=0.01 * magnitude, phase=None, phase_std=None, source="table",
        )  # fmt: skip
        tables.append(table)
    return tuple(tables)


def changed(analysis: Analysis, *, ratio=lambda x: x, stretch: float = 1.0) -> Analysis:
    tables = [
        replace(t, omega=t.omega * stretch, magnitude=ratio(t.magnitude)) for t in reduced(analysis)
    ]
    return replace(analysis, tables=tuple(tables))


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(("carts", "hide"), [(1, ()), (2, ()), (3, ()), (2, ("coulomb_friction",))])
def test_an_honest_table_gets_no_flag(carts, hide):
    """An honest table gets no flag, although half the swing differs slightly from a sine fit."""
    analysis = student(carts, hide=hide).analysis
    assert diagnose_reduced(changed(analysis)) == []


@pytest.mark.parametrize("carts", [1, 2, 3])
@pytest.mark.parametrize(
    ("code", "change"),
    [
        ("peak_to_peak", {"ratio": lambda x: 2 * x}),
        ("peak_to_peak", {"ratio": lambda x: x / 2}),
        ("counts_for_length", {"ratio": lambda x: x / 0.00227}),
        ("hz_for_rad_s", {"stretch": TURN}),
        ("hz_for_rad_s", {"stretch": 1 / TURN}),
        ("data_problem", {"ratio": lambda x: 1.7 * x}),
    ],
)
def test_a_slip_in_the_table_is_named(carts, code, change):
    """If all rows of a table differ from the dwells by the same mistake, a flag names it."""
    (flag,) = diagnose_reduced(changed(student(carts).analysis, **change))
    assert flag.code == code
    assert "reduced table" in flag.message
    assert flag.parameters == tuple(f"bode.x{cart}" for cart in range(1, carts + 1))


@pytest.mark.parametrize(("code", "factor"), [("peak_to_peak", 2.0), ("hz_for_rad_s", TURN)])
def test_without_dwells_a_table_is_judged_by_steps_and_decays(code, factor):
    """Without dwells, the fit to the table is compared with steps and decays.

    If they differ by the same factor for all carts, a flag names the mistake.
    """
    analysis = student(2).analysis
    symbol = "K" if code == "peak_to_peak" else "omega"
    rows = tuple(
        replace(r, final=replace(r.final, value=factor * r.final.value))
        if r.name.startswith(symbol) and r.final
        else r
        for r in analysis.rows
    )
    alone = replace(analysis, tables=reduced(analysis), sine_points=())
    assert diagnose_reduced(alone) == []
    (flag,) = diagnose_reduced(replace(alone, rows=rows))
    assert flag.code == code
