"""Sections on checks, assumptions and skipped stages."""

from collections.abc import Sequence

from pipeline.report.builder import Page
from pipeline.report.document import (
    Block,
    Details,
    Table,
    Tone,
    bullet_list,
    cell,
    make_table,
    paragraph,
)
from pipeline.results import Assumption, Check
from pipeline.words.numbers import count, join_names, listing
from pipeline.words.phrases import phrases
from pipeline.words.text import Span, clean, rich, spans

_WORDS = phrases("report")
OUTCOMES: dict[str, tuple[str, Tone]] = {  # in the order of the table
    "fail": ("failed", "bad"),
    "pass": ("passed", "good"),
    "skip": ("not checked", "quiet"),
}


def check_blocks(page: Page) -> list[Block]:
    """Return the checks; those that did not fail are folded, and one line a kind in print."""
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
        folded = _check_table(page, others, "other_checks_table", is_numbered=False)
        blocks.append(Details(spans(title), (folded,), in_print=(_kind_table(others),)))
    return blocks


def _kind_table(checks: Sequence[Check]) -> Table:
    """Return each kind of check: its question, and how many passed or could not be done."""
    kinds: dict[str, list[Check]] = {}
    for check in checks:
        kinds.setdefault(check.kind, []).append(check)
    rows = []
    for kind, found in kinds.items():
        passed = sum(check.outcome == "pass" for check in found)
        outcomes = [f"{passed} passed"] if passed else []
        outcomes += [f"{len(found) - passed} not done"] if passed < len(found) else []
        rows.append(
            [
                cell(", ".join(outcomes), "good" if passed else "quiet"),
                cell(Span(clean(kind), "code")),
                cell(_WORDS.spans(f"kind_{kind}")),
            ]
        )
    return make_table(0, "", _WORDS.cells("kind_table_head"), rows, "lll")


def _check_table(
    page: Page, checks: Sequence[Check], key: str, *, is_numbered: bool = True
) -> Table:
    order = list(OUTCOMES)
    rows = [
        [
            cell(*OUTCOMES[check.outcome]),
            cell(Span(clean(check.id), "code")),
            cell(rich(clean(check.message))),
        ]
        for check in sorted(checks, key=lambda check: order.index(check.outcome))
    ]
    return page.table(_WORDS, key, rows, "lll", is_numbered)


def assumption_blocks(page: Page) -> list[Block]:
    """Return the assumptions of the analysis, their sources, and whether the data support them.

    Those that the data support are folded, and one line in print.
    """
    assumptions = page.analysis.assumptions
    supported = [one for one in assumptions if one.support == "supported"]
    others = [one for one in assumptions if one.support != "supported"]
    blocks: list[Block] = []
    if others:
        blocks.append(_assumption_table(page, others))
    if supported:
        named = dict.fromkeys(f"{one.key} {one.about}".strip() for one in supported)
        title = _WORDS.spans("supported", n=count(len(supported), "assumption"))
        folded = _assumption_table(page, supported, is_numbered=False)
        in_print = (paragraph(title, ": ", clean(join_names(list(named), most=12)), "."),)
        blocks.append(Details(title, (folded,), in_print=in_print))
    return blocks


def _assumption_table(
    page: Page, assumptions: Sequence[Assumption], *, is_numbered: bool = True
) -> Table:
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
    return page.table(_WORDS, "assumption_table", rows, "llllll", is_numbered)


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
