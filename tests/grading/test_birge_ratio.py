"""A fit that contradicts other estimates of the same carts gets larger standard errors."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.grading.reference import recompute
from pipeline.results import Analysis
from tests.helpers.grading_students import student


def with_gain_off(analysis: Analysis, *, sigmas: float) -> Analysis:
    """Move the fitted K_1 this many combined standard errors away from the K_1 of the steps."""
    rows = []
    for row in analysis.rows:
        if row.name == "K_1":
            assert row.initial is not None
            assert row.final is not None
            std = float(np.hypot(row.initial.std or 0.0, row.final.std or 0.0))
            off = replace(row.final, value=row.initial.value + sigmas * std)
            row = replace(row, final=off)
        rows.append(row)
    return replace(analysis, rows=tuple(rows))


@pytest.mark.parametrize("sigmas", [0.0, 30.0])
def test_the_errors_grow_with_the_contradiction(sigmas):
    """All standard errors of fitted gains grow by the gains' Birge ratio, and no others."""
    analysis = with_gain_off(student(2).analysis, sigmas=sigmas)
    apart = [
        (row.initial.value - row.final.value) / np.hypot(row.initial.std or 0, row.final.std or 0)
        for row in analysis.rows
        if row.initial and row.final and row.initial.source == "step"
    ]
    ratio = max(1.0, float(np.sqrt(np.mean(np.square(apart)))))
    assert len(apart) == 2  # K_1 and K_2
    assert (ratio > 10) == (sigmas > 0)
    found = recompute(analysis).final
    fitted = next(row.final for row in analysis.rows if row.name == "K_2")
    assert fitted is not None
    assert fitted.std is not None
    assert found["K_2"].std == pytest.approx(ratio * fitted.std)
    before = recompute(student(2).analysis).final
    assert found["omega_a"].std == before["omega_a"].std


def test_a_wrong_recording_does_not_make_the_fit_doubtful():
    """If step gains are 1.5 times too large, a fit that explains the data keeps its errors."""
    analysis = student(2).analysis
    before = recompute(analysis).final
    rows = tuple(
        replace(row, initial=replace(row.initial, value=1.5 * row.initial.value))
        if row.initial and row.initial.source == "step"
        else row
        for row in analysis.rows
    )
    assert rows != analysis.rows
    found = recompute(replace(analysis, rows=rows)).final
    assert [found[name].std for name in ("K_1", "K_2")] == [
        before[name].std for name in ("K_1", "K_2")
    ]
