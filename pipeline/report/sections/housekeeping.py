"""Checks, warnings, what was skipped, and where the numbers come from."""

from collections.abc import Sequence
from dataclasses import replace

from pipeline.report.document import (
    Block,
    Details,
    Span,
    Table,
    Tone,
    bullet_list,
    cell,
    paragraph,
    spans,
)
from pipeline.report.numbers import count
from pipeline.report.phrases import phrases
from pipeline.report.sections.page import Page
from pipeline.report.words import clean, rich
from pipeline.results import Check

_WORDS = phrases("report")
OUTCOMES = {"fail": "failed", "pass": "passed", "skip": "not checked"}  # in the order of a table
TONES: dict[str, Tone] = {"fail": "bad", "pass": "good", "skip": "quiet"}


def check_blocks(page: Page) -> list[Block]:
    """Return what failed in sight, and the rest under a line that can be opened."""
    failed = page.analysis.failed_checks
    others = [check for check in page.analysis.checks if check not in failed]
    passed = sum(check.outcome == "pass" for check in others)
    blocks: list[Block] = []
    if failed:
        blocks.append(_check_table(page, failed, "Consistency checks that failed."))
    if others:
        title = f"{count(passed, 'check')} passed"
        if unchecked := len(others) - passed:
            title += f", {unchecked} could not be done"
        caption = "Consistency checks that passed or could not be done."
        blocks.append(Details(spans(title), (_check_table(page, others, caption),)))
    return blocks


def _check_table(page: Page, checks: Sequence[Check], caption: str) -> Table:
    order = list(OUTCOMES)
    return page.table(
        caption,
        ("Outcome", "Check", "What was found"),
        [
            [
                cell(OUTCOMES[check.outcome], TONES[check.outcome]),
                cell(Span(clean(check.id), "code")),
                cell(rich(clean(check.message))),
            ]
            for check in sorted(checks, key=lambda check: order.index(check.outcome))
        ],
        "lll",
    )


def skipped_blocks(page: Page) -> list[Block]:
    """Return which stages were skipped, and why."""
    told = [
        spans(Span(f"{clean(skip.stage)}: ", "strong"), rich(clean(skip.reason)))
        for skip in page.analysis.skipped
    ]
    return [bullet_list(told)] if told else []


def provenance_blocks(page: Page, made: str) -> list[Block]:
    """Return with what a report was made, and the SHA-256 of its files where one can open them."""
    blocks: list[Block] = [paragraph(made)]
    if files := page.analysis.files:
        blocks.append(Details(spans(count(len(files), "data file")), (file_table(page),)))
    return blocks


def file_table(page: Page) -> Table:
    """Return the data files with their SHA-256."""
    rows = [
        [cell(Span(clean(text), "code")) for text in entry]
        for entry in sorted(page.analysis.files.items())
    ]
    return replace(
        page.table(_WORDS.text("file_table"), ("File", "SHA-256"), rows, "ll"), small=True
    )
