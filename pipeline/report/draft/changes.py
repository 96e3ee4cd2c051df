"""What changed between two drafts of a report, told as a section and as one line."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot

from pipeline.report.document import Block, Span, bullet_list, paragraph, spans
from pipeline.report.numbers import count, percent, significant, unit_text, with_error
from pipeline.report.sections.page import Page
from pipeline.report.tables.cells import cell, make_table
from pipeline.report.words import clean, name_span, rich

_WORTH_TELLING = 1.0  # standard errors; less is chance
_OUTCOMES = {"pass": "passed", "fail": "failed", "skip": "not checked", "": "not there"}


@dataclass(frozen=True, kw_only=True)
class Change:
    """A number before and now; `sigmas` is the change in combined standard errors."""

    what: str
    name: str
    unit: str
    before: float | None
    before_std: float | None
    after: float | None
    after_std: float | None

    @property
    def percent(self) -> float | None:
        """The change in percent of the value before."""
        if self.before is None or self.after is None or self.before == 0:
            return None
        return 100 * (self.after - self.before) / abs(self.before)

    @property
    def sigmas(self) -> float | None:
        """The change in combined standard errors."""
        if self.before is None or self.after is None:
            return None
        if self.before_std is None or self.after_std is None:
            return None
        combined = hypot(self.before_std, self.after_std)
        return (self.after - self.before) / combined if combined > 0 else None


@dataclass(frozen=True, kw_only=True)
class CheckChange:
    """A check whose outcome changed; "" where it is not there."""

    id: str
    before: str
    after: str
    message: str


@dataclass(frozen=True, kw_only=True)
class DraftChanges:
    """All that differs between two drafts of one report."""

    numbers: tuple[Change, ...]
    checks: tuple[CheckChange, ...]
    files: Mapping[str, str]  # name: "new", "gone" or "changed"
    new_warnings: tuple[str, ...]
    gone_warnings: tuple[str, ...]
    newly_skipped: tuple[str, ...]
    no_longer_skipped: tuple[str, ...]
    versions: tuple[str, str]


def changes_line(changes: DraftChanges) -> str:
    """Return what changed in one line, for the terminal."""
    parts = []
    for which in ("final", "initial"):
        moved = [c for c in changes.numbers if c.what == which and c.percent is not None]
        if moved:
            worst = max(moved, key=lambda change: abs(change.percent or 0.0))
            sigmas = "" if worst.sigmas is None else f", {_sigmas(worst.sigmas)}"
            parts.append(
                f"{count(len(moved), f'{which} estimate')} moved, {worst.name} most "
                f"({percent(worst.percent, signed=True)}{sigmas})"
            )
    fails = [c for c in changes.checks if c.after == "fail"]
    mended = [c for c in changes.checks if c.before == "fail"]
    parts += [f"{count(len(fails), 'check')} now failed"] if fails else []
    parts += [f"{count(len(mended), 'check')} no longer failed"] if mended else []
    parts += [f"{count(len(changes.files), 'file')} changed"] if changes.files else []
    if changes.new_warnings:
        parts.append(count(len(changes.new_warnings), "new warning"))
    if changes.gone_warnings:
        parts.append(f"{count(len(changes.gone_warnings), 'warning')} gone")
    return "since the earlier draft: " + ("; ".join(parts) or "nothing changed")


def change_blocks(page: Page, changes: DraftChanges | None) -> list[Block]:
    """Return what changed since the earlier draft, as tables and lists."""
    if changes is None:
        return []
    line = changes_line(changes)
    blocks: list[Block] = [paragraph(rich(line[:1].upper() + line[1:] + "."))]
    if changes.versions[0] != changes.versions[1]:
        blocks.append(
            paragraph(
                f"The earlier draft was made by cartlab {clean(changes.versions[0])}, this one by "
                f"{changes.versions[1]}: the program may account for some of it."
            )
        )
    if changes.numbers:
        blocks.append(
            make_table(
                page.table_number(),
                "Numbers that moved. The change in brackets is in combined standard errors (σ); "
                "below one it is chance.",
                ("Quantity", "Kind", "Unit", "Earlier draft", "This draft", "Change"),
                [_number_row(change) for change in changes.numbers],
                "lllrrr",
            )
        )
    if changes.checks:
        blocks.append(
            make_table(
                page.table_number(),
                "Checks that came out differently.",
                ("Check", "Earlier draft", "This draft", "What was found"),
                [
                    [
                        cell(Span(clean(check.id), "code")),
                        cell(_OUTCOMES[check.before], _tone(check.before)),
                        cell(_OUTCOMES[check.after], _tone(check.after)),
                        cell(rich(clean(check.message))),
                    ]
                    for check in changes.checks
                ],
                "llll",
            )
        )
    lists = (
        ("Data files", [f"{name}: {what}" for name, what in changes.files.items()]),
        ("New warnings", changes.new_warnings),
        ("Warnings that are gone", changes.gone_warnings),
        ("Skipped now", changes.newly_skipped),
        ("No longer skipped", changes.no_longer_skipped),
    )
    for title, items in lists:
        if items:
            blocks.append(paragraph(Span(f"{title}:", "strong")))
            blocks.append(bullet_list(rich(clean(item)) for item in items))
    return blocks


def _number_row(change: Change) -> list:
    moved = percent(change.percent, signed=True)
    sigmas = change.sigmas
    if sigmas is not None:
        moved += f" ({_sigmas(sigmas)})"
    is_told = sigmas is None or abs(sigmas) >= _WORTH_TELLING
    is_name = change.what in ("final", "initial")
    return [
        cell(name_span(change.name) if is_name else spans(rich(clean(change.name)))),
        cell(change.what, "quiet"),
        cell(unit_text(clean(change.unit)) or "1"),
        cell(_value(change.before, change.before_std)),
        cell(_value(change.after, change.after_std)),
        cell(moved, "" if is_told else "quiet"),
    ]


def _sigmas(sigmas: float) -> str:
    return f"{significant(abs(sigmas), digits=2)} σ"


def _value(value: float | None, std: float | None) -> str:
    return significant(None) if value is None else with_error(value, std)


def _tone(outcome: str) -> str:
    return {"pass": "good", "fail": "bad"}.get(outcome, "quiet")
