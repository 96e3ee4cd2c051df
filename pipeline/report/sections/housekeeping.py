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
from pipeline.report.numbers import count, listing
from pipeline.report.phrases import phrases
from pipeline.report.sections.page import Page
from pipeline.report.words import clean, rich
from pipeline.results import Assumption, Check

_WORDS = phrases("report")
OUTCOMES = {"fail": "failed", "pass": "passed", "skip": "not checked"}  # in the order of a table
SUPPORT: dict[str, Tone] = {"supported": "good", "contradicted": "bad", "open": "quiet"}
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


def assumption_blocks(page: Page) -> list[Block]:
    """Return what all numbers rest on, where each was said, and how the data support it."""
    assumptions = page.analysis.assumptions
    if not assumptions:
        return []
    rows = [
        [
            cell(Span(clean(one.key), "code")),
            cell(clean(one.about)),
            cell(rich(clean(taken_text(one)))),
            cell(_WORDS.text(f"origin_{one.origin}"), "quiet"),
            cell(_WORDS.text(f"support_{one.support}"), SUPPORT[one.support]),
            cell(rich(clean(one.reason))),
        ]
        for one in assumptions
    ]
    head = ("Key", "Which", "Taken as", "From", "Do the data support it?", "Why")
    return [page.table(_WORDS.text("assumption_table"), head, rows, "llllll")]


def taken_text(one: Assumption) -> str:
    """Return the value of an assumption, as one says it."""
    if isinstance(one.value, bool):
        return "there" if one.value else "not there"
    if isinstance(one.value, tuple):
        carts = listing([str(cart) for cart in one.value])
        return f"cart{'s' if len(one.value) > 1 else ''} {carts} free"
    if isinstance(one.value, str):
        return one.value
    return f"{one.value:+g}" if one.key.endswith("sign") else f"{one.value:g}"


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
