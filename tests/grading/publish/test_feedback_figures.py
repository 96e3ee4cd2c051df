"""The figures in the feedback show measured points and the curve that the reported numbers give."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.grading.grade import Criterion
from pipeline.grading.publish.feedback_figures import draw_figures, draw_records, numbers_in
from pipeline.plant.chain import PRESETS
from pipeline.plant.identities import transfer_functions
from pipeline.report.figures.grading import reported_magnitude
from tests.helpers.grading_students import student


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_the_curve_of_a_table_is_the_chains_response(preset):
    """The curve drawn from a chain's parameters is the chain's own frequency response."""
    chain = PRESETS[preset]
    omega = np.geomspace(1.0, 100.0, 50)
    reported = transfer_functions(chain.parameters())
    for cart in range(1, chain.n + 1):
        expected = 20 * np.log10(np.abs(chain.frequency_response(omega)[cart - 1]))
        # Roots and products up to order six in double precision: the error is far below 1e-6 dB.
        got = reported_magnitude(omega, cart=cart, reported=reported)
        assert_allclose(got, expected, atol=1e-6)


def test_each_cart_has_a_figure_with_the_reported_curve():
    """Each cart has a figure with the reported curve, and drawing it again gives the same bytes."""
    two = student(2)
    figures = draw_figures(two.analysis, two.reported)

    assert [name for name, _ in figures] == ["response-1.svg", "response-2.svg"]
    assert all("your numbers" in svg and "<title>Measured" in svg for _, svg in figures)
    assert draw_figures(two.analysis, two.reported) == figures


@pytest.mark.parametrize(
    ("final", "left", "drawn"),
    [
        ({}, "K_1", False),
        ({}, "omega_a", False),
        ({}, "zeta_2", False),
        (dict.fromkeys(("zeta_a", "zeta_b", "zeta_1", "zeta_2"), 0.0), "", True),  # infinite peaks
        *(({"omega_a": value}, "", False) for value in (0.0, 1e300, 1e-300)),
    ],
)
def test_a_curve_is_drawn_if_the_table_gives_one(final, left, drawn):
    """An incomplete table, or a frequency of zero or infinity, leaves measurement and fit alone."""
    two = student(2).reporting(final=final).without("final", left)
    figures = draw_figures(two.analysis, two.reported)
    assert ["your numbers" in svg for _, svg in figures] == [drawn, drawn]


def test_a_number_that_lost_points_is_shown_on_its_record():
    """Each number that lost points is drawn on its recording, next to the recomputed one."""
    honest = student(2)
    wrong = {"K_1": 1.4 * honest.value("initial", "K_1"), "omega_2": 5.24}
    two = honest.reporting(initial=wrong)
    checks = {asked.id: asked.check for asked in two.rubric.criteria}
    grade = two.grade()
    criteria = [c for c in grade.criteria if checks[c.id] == "initial"]
    figures = dict(draw_records(two.analysis, criteria))

    shown = {name for file in figures for name in numbers_in(file)}
    assert set(wrong) <= shown
    of_gain = next(file for file in figures if numbers_in(file) == {"K_1"})
    known = next(c.expected["K_1"] for c in criteria if "K_1" in c.expected)
    reported = two.value("initial", "K_1")
    title = f"reported K₁ {reported:.4g}; recomputed {known:.4g}"
    assert title in figures[of_gain]
    steps = {record.id for record in two.analysis.records if record.kind == "step"}
    assert any(f"<title>{id_}: {title}" in figures[of_gain] for id_ in steps)
    assert "your number" in figures[of_gain]
    assert draw_records(honest.analysis, honest.grade().criteria[:0]) == ()


@pytest.mark.parametrize(("omega", "zeta"), [(-3.0, 0.1), (1e9, 0.1), (20.0, 1.5), (20.0, -1.0)])
def test_numbers_of_no_oscillation_are_written_but_not_drawn(omega, zeta):
    """Reported numbers that give no damped oscillation are written in the figure but not drawn."""
    two = student(2)
    criterion = Criterion(
        id="decays", title="", outcome="fail", points=0.0, out_of=1.0, message="",
        expected={"omega_1": 20.0, "zeta_1": 0.05}, found={"omega_1": omega, "zeta_1": zeta},
    )  # fmt: skip
    ((_, svg),) = draw_records(two.analysis, [criterion])
    assert f"reported ω₁ {omega:.4g}, ζ₁ {zeta:.4g}; recomputed 20, 0.05" in svg
    assert "your numbers" not in svg
