"""The summary follows from the evidence, and gives an action for each failed check."""

import json
import shutil
from dataclasses import replace

import pytest

from pipeline.report.document import Details, Table
from pipeline.report.sections.housekeeping import check_blocks
from pipeline.report.sections.page import Page
from pipeline.report.sections.parameters import parameter_blocks, parameter_table
from pipeline.report.sections.questions import ask
from pipeline.report.sections.summary import terminal_summary
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis, Check
from pipeline.submission import load_submission
from pipeline.words.text import plain
from pipeline.workflow import analyse
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.examples import analysed
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import write_one_cart_submission, write_two_cart_submission

needs_real = pytest.mark.skipif(
    not (REAL_DATA / "ecp210-ucsd").is_dir(), reason="no real recordings here"
)


def next_part(analysis: Analysis) -> list[str]:
    """Return the lines that say what to do next."""
    _, _, advice = terminal_summary(analysis).partition("What to do next.")
    return [line.removeprefix("- ") for line in advice.splitlines() if line]


def every_failed_check_is_named(analysis: Analysis) -> bool:
    """Check that the advice names each failed check."""
    told = "\n".join(next_part(analysis))
    return all((check.about or check.id) in told for check in analysis.failed_checks)


@needs_real
def test_only_steps_are_called_the_same_recordings(tmp_path):
    """If there are only steps, the summary says that both estimates use the same recordings.

    It does not mention decays.
    """
    analysis = analyse(load_submission(write_one_cart_submission(tmp_path / "s", REAL_DATA)))
    text = terminal_summary(analysis)
    assert "identified from 5 steps" in text
    assert "The initial estimates come from the same recordings" in text
    assert [row.independent for row in analysis.rows] == [False] * 3
    assert (
        "all 3 parameters that were estimated in two ways. Both estimates use the same recordings"
        in text
    )
    assert "Dry friction shows in the ringing of cart 1" in text
    assert "decays of" not in text
    assert not any("the decay of cart" in check.message for check in analysis.checks)
    assert any(line.startswith("Record decays from two") for line in next_part(analysis))
    sources = [plain(line[3].text) for line in parameter_table(Page(analysis)).rows]
    assert sources == ["step", "ringing after a step", "ringing after a step"]
    assert every_failed_check_is_named(analysis)
    assert any("a [design] table" in line for line in next_part(analysis))


@needs_real
def test_the_steps_counted_are_those_of_the_fit(tmp_path):
    """The summary gives the number of steps that the fit used.

    In the test, one of ten steps is left out, and five are steps of one cart alone.
    """
    folder = write_two_cart_submission(tmp_path / "s", REAL_DATA, steps=(1, 2, 3, 4, 5))
    analysis = analyse(load_submission(folder))
    assert analysis.fit is not None
    assert analysis.fit.experiments == ("both-2", "both-3", "both-4", "both-5")
    text = terminal_summary(analysis)
    assert "identified from 4 steps, by a joint fit" in text
    assert "from the same recordings, and from 5 decays and 5 steps." in text
    assert "For K_1, K_2, ω_a and ω_b both estimates use the same recordings." in text
    assert every_failed_check_is_named(analysis)
    advice = next_part(analysis)
    assert advice[0].startswith("Fix the recordings that were left out")  # the worst one is first
    assert "Failed: record.both-1" in advice[0]


def test_independent_initial_estimates_are_named():
    """The summary says which initial estimates are independent of the fit to the dwells.

    Initial estimates from decays and steps are independent; peaks read off the dwells are not.
    """
    analysis = analysed("two-cart")
    said = {row.name: row.independent for row in analysis.rows if row.independent is not None}
    assert said == {
        "K_1": True, "K_2": True, "omega_a": False, "omega_b": False,
        "omega_1": True, "omega_2": True, "zeta_1": True, "zeta_2": True,
    }  # fmt: skip
    text = terminal_summary(analysis)
    assert "identified from 23 sine dwells, by" in text
    assert "sweep" not in text.splitlines()[0]  # because no number depends on the sweep
    notes = plain_of(parameter_blocks(Page(analysis)))
    assert "ω_a, ω_b: initial and final estimates use the same recordings" in notes


@pytest.mark.parametrize(
    ("judged", "said"),
    [
        ((True,), "Estimates agree for the one parameter that was estimated in two ways."),
        ((False,), "No other parameter was estimated in two ways."),
        ((False, True), "The other parameter that was estimated in two ways agrees."),
        ((False, False), "None of the 2 parameters that were estimated in two ways agrees."),
        ((False, True, True), "The other 2 parameters that were estimated in two ways agree."),
    ],
)
def test_one_parameter_is_singular(judged, said):
    """The number of parameters that agree is given with the right singular or plural."""
    analysis = make_analysis(2)
    flags = [*judged, *[None] * (len(analysis.rows) - len(judged))]
    rows = tuple(
        replace(row, consistent=flag, independent=None, change_percent=20.0)
        for row, flag in zip(analysis.rows, flags, strict=True)
    )
    assert said in terminal_summary(replace(analysis, rows=rows))


def plain_of(blocks) -> str:
    """Return the text of lists and paragraphs among blocks."""
    found = []
    for block in blocks:
        if block.kind == "paragraph":
            found.append(plain(block.text))
        elif block.kind == "items":
            found += [plain(inner.text) for item in block.items for inner in item]
    return "\n".join(found)


def test_the_table_mentions_only_existing_sources():
    """The text on the table of parameters mentions decays only if there are some."""
    analysis = make_analysis(1)
    without = tuple(
        replace(row, initial=None) if row.initial and row.initial.source == "log_decrement" else row
        for row in analysis.rows
    )
    assert "free decays of single" in plain_of(parameter_blocks(Page(analysis)))
    assert "free decays of single" not in plain_of(
        parameter_blocks(Page(replace(analysis, rows=without)))
    )


def test_a_failed_check_of_unknown_kind_is_named():
    """A failed check of an unknown kind is named by id and message, before the fit's error."""
    odd = Check(
        kind="order", run="run-1", outcome="fail", value=1.0, limit=0.5, message="run-1: odd."
    )
    off = Check(
        kind="fit",
        part="explains_data",
        outcome="fail",
        value=9.0,
        limit=2.0,
        message="χ² is 9.",
    )
    analysis = replace(make_analysis(1, repeats=1), checks=(off, odd), skipped=())
    first, second, *_ = next_part(analysis)
    assert first == "Look into this check. run-1: odd. Failed: order.run-1"
    assert second.endswith("Failed: fit.explains_data")


@pytest.mark.parametrize("drop", ["step", "step sine sweep"])
def test_without_runs_of_all_carts_the_summary_says_what_to_record(drop, tmp_path):
    """If no run has all carts, the summary says what to record.

    The advice does not repeat the reason, and every failed check is named.
    """
    shutil.copytree(EXAMPLES / "two-cart", tmp_path / "s")
    toml = tmp_path / "s" / "submission.toml"
    head, *tables = toml.read_text(encoding="utf-8").split("[[experiments]]")
    kept = [
        table
        for table in tables
        if not any(f"kind = {json.dumps(kind)}" in table for kind in drop.split())
    ]
    toml.write_text("[[experiments]]".join([head, *kept]), encoding="utf-8")
    analysis = analyse(load_submission(tmp_path / "s"))
    advice = "\n".join(next_part(analysis))
    assert "No carts were identified" not in advice
    if "sine" in drop:
        assert analysis.fit is None
        assert "Record sine dwells near the resonances, or a step or sweep with all" in advice
    else:
        assert "add a step with all carts free" in advice
    assert every_failed_check_is_named(analysis)


def test_no_failure_is_listed_if_no_check_failed():
    """If no check failed, neither the summary nor the section on checks lists a failure."""
    analysis = analysed("one-cart")
    assert not any("Failed:" in line for line in next_part(analysis))
    blocks = check_blocks(Page(analysis))
    assert [type(block) for block in blocks] == [Details]
    assert not any(isinstance(block, Table) for block in blocks)


def test_a_question_about_one_recording_does_not_mention_two():
    """If both estimates use the same recordings, the question says so."""
    analysis = make_analysis(1)
    rows = tuple(
        replace(row, consistent=False, change_percent=80.0, independent=False)
        if row.name == "zeta"
        else row
        for row in analysis.rows
    )
    (question,) = (q for q in ask(replace(analysis, rows=rows)) if q.id == "zeta")
    assert "use the same recordings" in question.text
