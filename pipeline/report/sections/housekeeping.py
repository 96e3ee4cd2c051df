"""Sections on checks, warnings, skipped stages, and the origin of the numbers."""

from collections.abc import Sequence
from dataclasses import replace

from pipeline.report.builder import Page
from pipeline.report.document import Block, Details, Table, Tone, bullet_list, cell, paragraph
from pipeline.results import Assumption, Check
from pipeline.words.numbers import count, listing
from pipeline.words.phrases import phrases
from pipeline.words.text import Span, clean, rich, spans

_WORDS = phrases("report")
OUTCOMES: dict[str, tuple[str, Tone]] = {  # in the order of the table
    "fail": ("failed", "bad"),
    "pass": ("passed", "good"),
    "skip": ("not checked", "quiet"),
}


def check_blocks(page: Page) -> list[Block]:
    """Return the checks; those that did not fail are folded."""
    failed = page.analysis.failed_checks
    others = [check for check in page.analysis.checks if check not in failed]
    passed = sum(check.outcome == "pass" for check in others)
    blocks: list[Block] = []
    if failed:
        blocks.append(_check_table(page, failed, "failed_table"))
    if others:
        title = f"{count(passed, 'check')} passed"
        if unchecked := len(others) - passed:
            title += f", {unchecked} could not be done"
        blocks.append(Details(spans(title), (_check_table(page, others, "other_checks_table"),)))
    return blocks


def _check_table(page: Page, checks: Sequence[Check], key: str) -> Table:
    order = list(OUTCOMES)
    rows = [
        [
            cell(*OUTCOMES[check.outcome]),
            cell(Span(clean(check.id), "code")),
            cell(rich(clean(check.message))),
        ]
        for check in sorted(checks, key=lambda check: order.index(check.outcome))
    ]
    return page.table(_WORDS, key, rows, "lll")


def assumption_blocks(page: Page) -> list[Block]:
    """Return the assumptions of the analysis, their sources, and whether the data support them."""
    assumptions = page.analysis.assumptions
    if not assumptions:
        return []
    tones: dict[str, Tone] = {"supported": "good", "contradicted": "bad", "open": "quiet"}
    rows = [
        [
            cell(Span(clean(one.key), "code")),
            cell(clean(one.about)),
            cell(rich(clean(taken_text(one)))),
            cell(_WORDS.text(f"origin_{one.origin}"), "quiet"),
            cell(_WORDS.text(f"support_{one.support}"), tones[one.support]),
            cell(rich(clean(one.reason))),
        ]
        for one in assumptions
    ]
    return [page.table(_WORDS, "assumption_table", rows, "llllll")]


def taken_text(one: Assumption) -> str:
    """Return the value of an assumption as text."""
    if isinstance(one.value, bool):
        return "there" if one.value else "not there"
    if isinstance(one.value, tuple):
        carts = listing([str(cart) for cart in one.value])
        return f"cart{'s' if len(one.value) > 1 else ''} {carts} free"
    if isinstance(one.value, str):
        return one.value
    number = f"{one.value:+g}" if one.key == "system.input.sign" else f"{one.value:g}"
    return number.replace("-", "−")


def skipped_blocks(page: Page) -> list[Block]:
    """Return the skipped stages and the reasons."""
    items = [
        spans(Span(f"{clean(skip.name)}: ", "strong"), rich(clean(skip.reason)))
        for skip in page.analysis.skipped
    ]
    return [bullet_list(items)] if items else []


def provenance_blocks(page: Page, made: str) -> list[Block]:
    """Return the versions with which the report was made, and the SHA-256 of its files, folded.

    Parameters
    ----------
    made : a sentence that states the versions.
    """
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
    return replace(page.table(_WORDS, "file_table", rows, "ll"), small=True)
