"""Two drafts are compared by the numbers that changed and by the checks that newly fail."""

import json
from dataclasses import replace

import pytest

from pipeline.errors import ConfigError
from pipeline.json_files import json_text
from pipeline.report.builder import Page
from pipeline.report.changes import (
    Draft,
    change_blocks,
    changes_line,
    compare_drafts,
    read_results,
)
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.examples import analysed
from tests.helpers.pages import rows


def draft_of(analysis: Analysis) -> Draft:
    return json.loads(json_text(analysis))


def with_final(analysis: Analysis, name: str, **changes: float | str) -> Analysis:
    """Return the analysis with another final estimate."""
    rows = tuple(
        replace(row, final=replace(row.final, **changes)) if row.name == name and row.final else row
        for row in analysis.rows
    )
    return replace(analysis, rows=rows)


def final_of(analysis: Analysis, name: str) -> float:
    return next(row.final.value for row in analysis.rows if row.name == name and row.final)


def test_a_draft_compared_with_itself_has_no_changes():
    """An analysis compared with its own `results.json` shows no changes."""
    analysis = make_analysis(3)
    changes = compare_drafts(draft_of(analysis), analysis)
    assert (changes.numbers, changes.failed) == ((), {})
    assert "nothing changed" in changes_line(changes)


def test_a_change_is_given_in_combined_standard_errors():
    """A change is given in combined standard errors of both drafts.

    A change of 2 %, with a standard error of 1 % in each draft, is 1.4 σ.
    """
    analysis = make_analysis(2)
    value = final_of(analysis, "K_1")
    before, after = (
        with_final(analysis, "K_1", value=v, std=0.01 * value) for v in (value, 1.02 * value)
    )
    changes = compare_drafts(draft_of(before), after)
    (change,) = changes.numbers
    assert (change.what, change.name) == ("final", "K_1")
    assert change.percent == pytest.approx(2.0, rel=1e-6)
    assert change.sigmas == pytest.approx(2 / 2**0.5, rel=1e-6)
    assert "(+2.0 %, 1.4 σ)" in changes_line(changes)


def test_checks_that_fail_now_are_named():
    """The only checks listed are those that fail now and did not fail before."""
    analysis = make_analysis(2)
    passing = tuple(replace(check, outcome="pass") for check in analysis.checks)
    first, *others = passing
    failing = (replace(first, outcome="fail"), *others)
    was, now = replace(analysis, checks=passing), replace(analysis, checks=failing)
    assert compare_drafts(draft_of(was), now).failed == {first.id: first.message}
    assert compare_drafts(draft_of(now), now).failed == {}
    assert compare_drafts(draft_of(now), was).failed == {}
    assert "1 check" in changes_line(compare_drafts(draft_of(was), now))


def test_a_change_of_the_status_alone_is_named(tmp_path):
    """If no number changed, the line says which status came in place of which."""
    fine = replace(analysed("one-cart"), checks=(), reported_off=())
    off = replace(fine, reported_off=("K", "zeta"))
    assert (fine.status.state, off.status.state) == ("ok", "numbers_disagree")
    changes = compare_drafts(draft_of(off), fine)
    assert (changes.numbers, changes.failed) == ((), {})
    assert changes.status == (off.status.words, fine.status.words)
    line = changes_line(changes)
    assert all(words in line for words in changes.status)
    assert "nothing changed" not in line
    old = {key: value for key, value in draft_of(off).items() if key != "status"}
    assert compare_drafts(old, fine).status == ()
    (tmp_path / "results.json").write_text(json_text(off), encoding="utf-8")
    assert compare_drafts(read_results(tmp_path / "results.json"), fine) == changes


def test_the_report_has_a_section_on_the_changes():
    """If an earlier draft is given, the report has a section with old and new numbers."""
    before = make_analysis(2)
    after = with_final(before, "omega_b", value=1.1 * final_of(before, "omega_b"))
    changes = compare_drafts(draft_of(before), after)
    ((name, row),) = rows(change_blocks(Page(after), changes)).items()
    assert name == "ω_b"
    assert "+10.0 %" in row[-1]
    assert change_blocks(Page(after), None) == []


@pytest.mark.parametrize(
    "text", ["not json", '{"schema": "cartlab-gap/1"}', "[" * 10_000, "{}", None]
)
def test_a_file_that_is_not_results_json_is_refused(tmp_path, text):
    """A file that is missing or not a `results.json` is refused by one line with its name."""
    path = tmp_path / "results.json"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"results\.json: ") as error:
        read_results(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("key", "other"),
    [("carts", 3), ("units", {"position": "mm", "input": "V"})],
)
def test_other_units_or_carts_are_refused_before_the_analysis(tmp_path, monkeypatch, key, other):
    """If the units or carts of the drafts differ, the command stops before the analysis."""

    def analysed_after_all(*_, **__):
        pytest.fail("the analysis ran")

    monkeypatch.setattr("pipeline.workflow.analyse", analysed_after_all)
    earlier = json.loads(json_text(analysed("one-cart")))
    earlier["submission"][key] = other
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(earlier), encoding="utf-8")
    out = tmp_path / "out"
    done = cartlab_here("report", EXAMPLES / "one-cart", "--out", out, "--compare", path)
    assert done.returncode == 2
    assert "cannot be compared" in done.stderr
    assert not out.exists()


@pytest.mark.slow
@pytest.mark.sample
def test_compare_prints_a_change_in_one_line_on_stderr(tmp_path):
    """With `--compare` a changed gain is reported on the page and in one line on stderr."""
    earlier = json.loads(json_text(analysed("one-cart")))
    earlier["parameters"][0]["final"] *= 0.9
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(earlier), encoding="utf-8")
    arguments = ("--no-pdf", "--out", tmp_path / "out", "--compare", path)
    done = cartlab_here("report", EXAMPLES / "one-cart", *arguments)
    assert done.returncode == 0
    (line,) = [text for text in done.stderr.splitlines() if text.startswith("since")]
    assert "K most (+11.1 %" in line
    assert 'id="changes"' in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_draft_of_an_earlier_version_has_no_law_of_a_decay(tmp_path):
    """A decay without the law that it follows, as version 0.2.0 wrote it, can be compared."""
    analysis = analysed("one-cart")
    earlier = json.loads(json_text(analysis))
    for decay in earlier["log_decrements"]:
        del decay["law"]
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(earlier), encoding="utf-8")
    assert not compare_drafts(read_results(path), analysis).numbers
