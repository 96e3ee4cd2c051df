"""The summary follows from the evidence, and gives an action for each failed check."""

import re
from dataclasses import replace
from itertools import product

import pytest

from pipeline.identify.groups import check_groups
from pipeline.report.builder import Page
from pipeline.report.document import Details, Table, flat, plain_lines
from pipeline.report.sections.housekeeping import check_blocks
from pipeline.report.sections.parameters import parameter_blocks, parameter_table
from pipeline.report.sections.questions import ask
from pipeline.report.sections.summary import terminal_summary
from pipeline.results import Analysis, Check, RecordingGroup
from pipeline.submission import load_submission
from pipeline.words.text import plain
from pipeline.workflow import analyse
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.examples import analysed, recorded
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
    """If there are only steps, both estimates use the same recordings; no decay is mentioned."""
    analysis = analyse(load_submission(write_one_cart_submission(tmp_path / "s", REAL_DATA)))
    text = terminal_summary(analysis)
    assert "5 steps" in text
    assert [row.independent for row in analysis.rows] == [False] * 3
    assert "decays of" not in text
    sources = [plain(line[3].text) for line in parameter_table(Page(analysis)).rows]
    assert sources == ["step", "ringing after a step", "ringing after a step"]
    assert every_failed_check_is_named(analysis)
    assert {skip.missing for skip in analysis.skipped if skip.missing}
    told = "\n".join(next_part(analysis))
    assert all(skip.missing in told for skip in analysis.skipped)


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
    assert [*re.findall(r"\d+ steps", text)][:2] == ["4 steps", "5 steps"]
    assert every_failed_check_is_named(analysis)
    assert next_part(analysis)[0].endswith("record.both-1")  # the worst one is first


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
    first, *_ = terminal_summary(analysis).splitlines()
    assert "23 sine" in first
    assert "sweep" not in first  # because no number depends on the sweep
    assert "ω_a, ω_b:" in plain_lines(flat(parameter_blocks(Page(analysis))))


@pytest.mark.parametrize("judged", [*product([True, False], repeat=2), (True,), (False,)])
def test_one_parameter_is_singular(judged):
    """The number of parameters that agree is true, and has the right singular or plural."""
    analysis = make_analysis(2)
    flags = [*judged, *[None] * (len(analysis.rows) - len(judged))]
    rows = tuple(
        replace(row, consistent=flag, independent=None, change_percent=20.0)
        for row, flag in zip(analysis.rows, flags, strict=True)
    )
    text = terminal_summary(replace(analysis, rows=rows))
    said = re.findall(r"[^.]*estimated in two ways[^.]*", text)
    assert len(said) == 1
    assert not re.findall(r"\b1 parameters|one parameters|[2-9] parameter ", said[0])
    assert bool(re.search(r"\bNo(ne)?\b", said[0])) == (not any(judged))
    assert ("other" in said[0]) == (judged.count(False) == 1)


def test_the_table_mentions_only_existing_sources():
    """The text on the table of parameters mentions decays only if there are some."""
    analysis = make_analysis(1)
    without = tuple(
        replace(row, initial=None) if row.initial and row.initial.source == "log_decrement" else row
        for row in analysis.rows
    )
    for rows in (analysis.rows, without):
        text = plain_lines(flat(parameter_blocks(Page(replace(analysis, rows=rows)))))
        assert ("free decays" in text) == (rows is analysis.rows)


def test_a_failed_check_of_unknown_kind_is_named():
    """A failed check of an unknown kind is named by id and message, before the fit's error."""
    odd = Check(
        kind="order", run="run-1", outcome="fail", value=1.0, limit=0.5, message="run-1: odd."
    )
    off = Check(
        kind="fit", part="explains_data", outcome="fail", value=9.0, limit=2.0, message="χ² is 9."
    )
    analysis = replace(make_analysis(1, repeats=1), checks=(off, odd), skipped=())
    first, second, *_ = next_part(analysis)
    assert odd.message in first
    assert [line.rpartition(" ")[2] for line in (first, second)] == [odd.id, off.id]


def test_groups_of_other_carts_get_one_advice():
    """Repeats of different carts differ, so they need no advice beside that on the groups."""
    groups = tuple(
        RecordingGroup(experiments=names, values={}, std={}, label=label)
        for names, label in ((("a", "b", "c"), ""), (("d", "e"), "7 Feb"))
    )
    (odd,) = check_groups(groups)
    repeats = Check(
        kind="repeats", parameter="K", outcome="fail", value=99.0, limit=4.0, message="They differ."
    )
    plain = replace(make_analysis(1, repeats=1), skipped=(), groups=groups)
    analysis = replace(plain, checks=(repeats, odd))
    assert len(next_part(analysis)) == len(next_part(replace(plain, checks=(odd,))))
    assert every_failed_check_is_named(analysis)
    assert repeats.message not in terminal_summary(analysis)
    found, _, _ = terminal_summary(analysis).partition("What to do next.")
    assert all(name in found for name in ("(1) a", "(2) 7 Feb"))


def test_after_wrong_springs_the_report_is_made_again_before_recording():
    """If no carts fit and the springs are in doubt, the second step is to make the report again."""
    springs = Check(
        kind="springs", parameter="k_2", outcome="fail", value=1.0, limit=0.5, message="Springs?"
    )
    fit = Check(kind="fit", part="converged", outcome="fail", value=1.0, limit=0.5, message="No.")
    plain = replace(make_analysis(1, repeats=1), skipped=())
    steps = [next_part(replace(plain, checks=checks)) for checks in ((springs,), (springs, fit))]
    assert [any(fit.id in line for line in lines[:2]) for lines in steps] == [False, False]
    assert fit.id in steps[1][2]
    assert len(steps[1]) == len(steps[0]) + 2


@pytest.mark.parametrize("drop", ["step", "step sine sweep"])
def test_without_runs_of_all_carts_the_summary_says_what_to_record(drop):
    """If no run has all carts, the summary says what to record, and names every failed check."""
    kinds = {"decay", "step", "sine", "sweep", "closed_loop"} - {*drop.split()}
    analysis = analyse(recorded("two-cart", *kinds))
    advice = "\n".join(next_part(analysis))
    missing = {skip.missing for skip in analysis.skipped if skip.missing}
    assert missing
    assert any(one in advice for one in missing)
    assert (analysis.fit is None) == ("sine" in drop)
    assert every_failed_check_is_named(analysis)


def test_a_column_that_no_file_has_comes_first():
    """What cannot be used in submission.toml comes before the failures that it may cause."""
    submission = recorded("one-cart", "step", "decay")
    system = submission.system.model_copy(update={"columns": {"input": "Motr"}})
    analysis = analyse(submission.model_copy(update={"system": system}))
    assert analysis.unread
    assert {*analysis.unread} <= {*analysis.warnings}
    off = Check(kind="order", outcome="fail", value=1.0, limit=0.5, message="Odd.")
    first, second, *_ = next_part(replace(analysis, checks=(off,)))
    assert "'Motr'" in first
    assert off.id in second


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
    said = []
    for independent in (True, False):
        rows = tuple(
            replace(row, consistent=False, change_percent=80.0, independent=independent)
            if row.name == "zeta"
            else row
            for row in analysis.rows
        )
        (question,) = (q for q in ask(replace(analysis, rows=rows)) if q.id == "zeta")
        said.append("same recordings" in question.text)
    assert said == [False, True]
