"""The notebook: one import, results that show themselves, and the example runs to its end."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import pipeline
from pipeline.errors import ConfigError, SubmissionError
from pipeline.notebook import LabAnalysis, analyse
from pipeline.resources import EXAMPLES
from pipeline.results_json import results_text
from pipeline.submission import load_submission
from pipeline.workflow import analyse as run
from tests.test_report import Page

NOTEBOOK = Path(__file__).parents[1] / "docs" / "example.ipynb"


@pytest.fixture(scope="module")
def lab() -> LabAnalysis:
    return analyse(EXAMPLES / "two-cart")


def test_analyse_is_the_packages_own(lab):
    """`from pipeline import analyse` is this function, and gives the very results of a report."""
    assert pipeline.analyse is analyse
    assert results_text(lab) == results_text(run(load_submission(EXAMPLES / "two-cart")))


def test_nothing_heavy_is_loaded_until_it_is_asked_for():
    """Importing the package alone loads neither numpy nor matplotlib; another name is no name."""
    code = "import sys, pipeline; print({'numpy', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True
    )
    assert done.stdout.strip() == "set()"
    with pytest.raises(AttributeError, match="no attribute 'analyze'"):
        pipeline.analyze  # noqa: B018


def test_an_analysis_shows_its_summary_and_its_table(lab):
    """The HTML is one closed element with the summary and every parameter, and no script."""
    page = Page(lab._repr_html_())
    assert page.tags[0] == ("div", {"class": "cartlab"})
    assert "A chain of 2 carts was identified" in page.text
    assert "Initial and final estimates" in page.text
    assert {"script", "html", "link"}.isdisjoint(tag for tag, _ in page.tags)
    alts = page.values("alttext")
    assert {"K_1", "ω_a", "ζ_2"} <= set(alts)
    assert repr(lab).startswith("A chain of 2 carts was identified")


def test_each_section_shows_itself(lab):
    """All sections of the report can be shown alone, figures included; others are refused."""
    for section in lab.sections:
        page = Page(lab.show(section)._repr_html_())
        assert len(page.text) > 20, section
    assert "<svg" in lab.show("feedback")._repr_html_()
    assert repr(lab.show("feedback")) == "Shown('State feedback')"
    with pytest.raises(ConfigError, match="no section 'feedbak'; there are summary, "):
        lab.show("feedbak")


def test_a_folder_that_is_none_is_one_clear_error(tmp_path):
    """The reader of a notebook gets the message of the command line."""
    with pytest.raises(SubmissionError, match="no such folder"):
        analyse(tmp_path / "nowhere")


def test_the_style_sheet_stays_inside(lab):
    """Every rule is nested under the element's own class, so the notebook's look is its own."""
    html = lab._repr_html_()
    style = html[html.index("<style>") + 7 : html.index("</style>")].strip()
    assert style.startswith(".cartlab {")
    depth, closed_at = 0, []
    for at, letter in enumerate(style):
        depth += (letter == "{") - (letter == "}")
        if depth == 0 and letter == "}":
            closed_at.append(at)
    assert closed_at == [len(style) - 1]
    assert ":root" not in style


def test_the_example_notebook_runs(monkeypatch):
    """Every code cell runs, in order, and what ends a cell shows itself."""
    monkeypatch.chdir(EXAMPLES.parent)
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    names: dict[str, object] = {}
    shown = []
    for cell in notebook["cells"]:
        assert {"cell_type", "id", "metadata", "source"} <= set(cell)
        if cell["cell_type"] != "code":
            continue
        assert (cell["outputs"], cell["execution_count"]) == ([], None)  # shipped clean
        *body, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(body, []), "cell", "exec"), names)
        assert isinstance(last, ast.Expr)
        shown.append(eval(compile(ast.Expression(last.value), "cell", "eval"), names))
    assert [hasattr(value, "_repr_html_") for value in shown] == [
        True,
        True,
        False,
        False,
        False,
        True,
    ]
    assert "omega_a falls from 10.138 to" in str(shown[3])
