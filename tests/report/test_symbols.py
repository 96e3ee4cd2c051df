"""A parameter is shown as its symbol, whatever its name in files."""

import re
from decimal import Decimal
from html import unescape

import pytest

from pipeline.grading.gradescope import results_text
from pipeline.grading.publish.feedback import feedback_page
from pipeline.grading.publish.view import new_view
from pipeline.report.html import render_html
from pipeline.report.lab_report import build_document
from pipeline.report.sections.summary import terminal_summary
from pipeline.report.solution.write import build_solution
from pipeline.words.text import breakable
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.grading_students import student

_HIDDEN = re.compile(r"<(script|style|code)\b.*?</\1>|<[^>]*>", re.DOTALL)
_AS_IN_FILES = re.compile(r"\b(?:omega|zeta)(?:_\w)?\b|overshoot_percent|settling_time|nrmse")


def raw(html: str) -> list[str]:
    """Return the parameter names on a page that are spelt as in files."""
    return _AS_IN_FILES.findall(unescape(_HIDDEN.sub(" ", html)))


@pytest.mark.parametrize(
    "carts", [1, 2, pytest.param(3, marks=[pytest.mark.slow, pytest.mark.sample])]
)
def test_reports_show_symbols(carts):
    """Report, solution and terminal show parameters as symbols, not by their names in files."""
    analysis = make_analysis(carts)
    assert raw(render_html(build_document(analysis))) == []
    assert raw(render_html(build_solution(analysis))) == []
    *told, questions = terminal_summary(analysis).splitlines()
    assert raw("\n".join(told)) == []
    assert "notes.md" in questions  # whose headings have the names


def test_grades_show_symbols():
    """Feedback shows parameters as symbols, both on its page and in its text for a platform."""
    one = student(2)
    off = {name: one.value("final", name) * 2 for name in ("zeta_b", "omega_1", "K_1")}
    feedback = one.reported.feedback
    assert feedback is not None
    claims = feedback.model_copy(update={"overshoot_percent": Decimal(30)})
    grade = one.reporting(final=off, initial={"zeta_1": -0.05}, feedback=claims).grade()
    assert len(grade.flags) > 1
    assert raw(feedback_page(new_view(grade, one.rubric), figures=(), name="team-07")) == []
    shown = results_text(new_view(grade, one.rubric))
    assert raw("".join(re.findall(r'"output": "(.*)"', shown))) == []
    assert "ζ_b" in shown


def test_a_name_breaks_only_at_its_joints():
    """A name in HTML may break after dots, underscores and hyphens, and before no number."""
    assert breakable("initial_final.zeta_1") == "initial_<wbr>final.<wbr>zeta_1"
    assert breakable("manual2_test1.csv") == "manual2_<wbr>test1.<wbr>csv"
    assert breakable("<a-b>") == "&lt;a-<wbr>b&gt;"
