"""Checks and files."""

from collections.abc import Sequence
from dataclasses import replace

from pipeline.report.document import Span, Table
from pipeline.report.phrases import phrases
from pipeline.report.tables.cells import cell, make_table
from pipeline.report.words import clean, rich
from pipeline.results import Analysis, Check

_WORDS = phrases("report")


_OUTCOMES = {"pass": "passed", "fail": "failed", "skip": "not checked"}
_TONES = {"pass": "good", "fail": "bad", "skip": "quiet"}


def check_table(checks: Sequence[Check], caption: str, *, number: int) -> Table:
    """Return consistency checks, failed ones first."""
    order = {"fail": 0, "pass": 1, "skip": 2}
    return make_table(
        number,
        caption,
        ("Outcome", "Check", "What was found"),
        [
            [
                cell(_OUTCOMES[check.outcome], _TONES[check.outcome]),
                cell(Span(clean(check.id), "code")),
                cell(rich(clean(check.message))),
            ]
            for check in sorted(checks, key=lambda check: order[check.outcome])
        ],
        "lll",
    )


def file_table(analysis: Analysis, *, number: int) -> Table:
    """Return the data files with their SHA-256."""
    table = make_table(
        number,
        _WORDS.text("file_table"),
        ("File", "SHA-256"),
        [
            [cell(Span(clean(name), "code")), cell(Span(clean(digest), "code"))]
            for name, digest in sorted(analysis.files.items())
        ],
        "ll",
    )
    return replace(table, small=True)
