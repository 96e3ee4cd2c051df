"""Two drafts are compared by the numbers that changed and by the checks that newly fail."""

import json
from dataclasses import replace

import pytest

from pipeline.errors import ConfigError
from pipeline.json_files import json_text
from pipeline.report.document import Table
from pipeline.report.lab_report.changes import (
    Draft,
    change_blocks,
    changes_line,
    compare_drafts,
    read_results,
)
from pipeline.report.sections.page import Page
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis, Estimate
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.commandline import cartlab_here
from tests.helpers.examples import analysed


def draft_of(analysis: Analysis) -> Draft:
    return json.loads(json_text(analysis))


def with_final(analysis: Analysis, name: str, factor: float) -> Analysis:
    """Return the analysis with one final estimate multiplied by a factor."""
    rows = tuple(
        replace(row, final=replace(row.final, value=row.final.value * factor))
        if row.name == name and row.final
        else row
        for row in analysis.rows
    )
    return replace(analysis, rows=rows)


def test_a_draft_compared_with_itself_has_no_changes():
    """An analysis compared with its own `results.json` shows no changes."""
    analysis = make_analysis(3)
    changes = compare_drafts(draft_of(analysis), analysis)
    assert not changes.numbers
    assert not changes.failed
    assert changes_line(changes) == "since the earlier draft: nothing changed"


def test_a_change_is_given_in_combined_standard_errors():
    """A change is given in combined standard errors of both drafts.

    A change of 2 %, with a standard error of 1 % in each draft, is 1.4 σ.
    """
    analysis = make_analysis(2)
    row = next(row for row in analysis.rows if row.name == "K_1")
    assert row.final is not None
    value = row.final.value
    before, after = (
        replace(
            analysis,
            rows=tuple(
                replace(r, final=Estimate(value=v, std=0.01 * value, source="bode_fit"))
                if r.name == "K_1"
                else r
                for r in analysis.rows
            ),
        )
        for v in (value, 1.02 * value)
    )
    (change,) = compare_drafts(draft_of(before), after).numbers
    assert (change.what, change.name) == ("final", "K_1")
    assert change.percent == pytest.approx(2.0, rel=1e-6)
    assert change.sigmas == pytest.approx(2 / 2**0.5, rel=1e-6)
    line = changes_line(compare_drafts(draft_of(before), after))
    assert line == "since the earlier draft: 1 final estimate moved, K_1 most (+2.0 %, 1.4 σ)"


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
    line = changes_line(compare_drafts(draft_of(was), now))
    assert line == "since the earlier draft: 1 check now failed"


def test_the_report_has_a_section_on_the_changes():
    """If an earlier draft is given, the report has a section with old and new numbers."""
    before, after = make_analysis(2), with_final(make_analysis(2), "omega_b", 1.1)
    changes = compare_drafts(draft_of(before), after)
    blocks = change_blocks(Page(after), changes)
    table = next(block for block in blocks if isinstance(block, Table))
    (row,) = table.rows
    assert plain(row[0].text) == "ω_b"
    assert "+10.0 %" in plain(row[-1].text)
    assert change_blocks(Page(after), None) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("not json", "not a results.json of cartlab"),
        ('{"schema": "cartlab-gap/1"}', "schema: expected 'cartlab-results/1', found"),
        ("[" * 10_000, "not a results.json of cartlab"),
        ("{}", "schema: Field required"),
    ],
)
def test_a_file_that_is_not_results_json_is_refused(tmp_path, text, expected):
    """A file that is not a `results.json` is refused by one line that gives the reason."""
    path = tmp_path / "results.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"results\.json: ") as error:
        read_results(path)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_refused(tmp_path):
    """If the earlier draft's file is missing, the error names its path."""
    with pytest.raises(ConfigError, match=r"none\.json: cannot be read"):
        read_results(tmp_path / "none.json")


def test_other_benches_are_not_compared():
    """Drafts for different numbers of carts cannot be compared."""
    with pytest.raises(ConfigError, match=r"2 carts in cm and V, this one has 3 in cm and V"):
        compare_drafts(draft_of(make_analysis(2)), make_analysis(3))


@pytest.mark.parametrize(
    ("key", "other"),
    [("carts", 3), ("units", {"position": "mm", "input": "V"})],
)
def test_other_units_or_carts_are_refused_before_the_analysis(tmp_path, monkeypatch, key, other):
    """If the units or carts of the drafts differ, the command stops before the analysis."""

    def analysed_after_all(*_, **__):
        pytest.fail("the analysis ran")

    monkeypatch.setattr("pipeline.report.lab_report.write.analyse", analysed_after_all)
    earlier = json.loads(json_text(analysed("one-cart")))
    earlier["submission"][key] = other
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(earlier), encoding="utf-8")
    out = tmp_path / "out"
    done = cartlab_here("report", EXAMPLES / "one-cart", "--out", out, "--compare", path)
    assert done.returncode == 2
    assert "they cannot be compared" in done.stderr
    assert not out.exists()


def test_compare_prints_a_change_in_one_line_on_stderr(tmp_path):
    """With `--compare` a changed gain is reported on the page and in one line on stderr."""
    earlier = json.loads(json_text(analysed("one-cart")))
    earlier["parameters"][0]["final"] *= 0.9
    path = tmp_path / "earlier.json"
    path.write_text(json.dumps(earlier), encoding="utf-8")
    arguments = ("--no-pdf", "--out", tmp_path / "out", "--compare", path)
    done = cartlab_here("report", EXAMPLES / "one-cart", *arguments)
    assert done.returncode == 0
    (line,) = [text for text in done.stderr.splitlines() if text.startswith("since the earlier")]
    assert "1 final estimate moved, K most (+11.1 %" in line
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
