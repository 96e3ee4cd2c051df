"""What changed between two drafts: an earlier `results.json` beside the analysis of now."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from pathlib import Path

from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.report.document import Block, Span, bullet_list, paragraph, spans
from pipeline.report.numbers import count, percent, significant, unit_text, with_error
from pipeline.report.page import Page
from pipeline.report.tables import cell, make_table
from pipeline.report.words import clean, name_span, rich
from pipeline.results import Analysis
from pipeline.results_json import plain_json, results_dict
from pipeline.schemas.results import Hardware, Parameter, Results

_MOST_BYTES = 20_000_000  # of a results.json; real ones have a few ten thousand
_SAME = 1e-8  # relative: two processors agree to this on the ten digits of the file
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


# ----------------------------------------------------------------------- comparing


def read_results(path: Path) -> Results:
    """Read an earlier `results.json`.

    Raises
    ------
    ConfigError : it is no file, or none that cartlab wrote.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path}: too large for a results.json")
        return Results.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        what = f"{where}: {first['msg']}" if where else first["msg"]
        raise ConfigError(f"{path}: no results.json of cartlab ({what})") from None


def compare_drafts(before: Results, analysis: Analysis) -> DraftChanges:
    """Return what changed from an earlier draft to an analysis.

    Raises
    ------
    ConfigError : the earlier draft is of another number of carts or in other units.
    """
    after = Results.model_validate(plain_json(results_dict(analysis)))
    then, now = before.submission, after.submission
    if (then.carts, then.units) != (now.carts, now.units):
        raise ConfigError(
            f"the earlier draft is of {count(then.carts, 'cart')} in {then.units.position} and "
            f"{then.units.input}, this one of {now.carts} in {now.units.position} and "
            f"{now.units.input}: they cannot be compared"
        )
    warned, warns = before.warnings, after.warnings
    skipped = [skip.stage for skip in before.skipped]
    skips = [skip.stage for skip in after.skipped]
    return DraftChanges(
        numbers=tuple(change for change in _numbers(before, after) if _differs(change)),
        checks=tuple(_checks(before, after)),
        files=_files(before.provenance.files, after.provenance.files),
        new_warnings=_only(warns, warned),
        gone_warnings=_only(warned, warns),
        newly_skipped=_only(skips, skipped),
        no_longer_skipped=_only(skipped, skips),
        versions=(before.provenance.version, after.provenance.version),
    )


def _only(items: Sequence[str], others: Sequence[str]) -> tuple[str, ...]:
    return tuple(item for item in items if item not in others)


def _numbers(before: Results, after: Results) -> list[Change]:
    then = {row.name: row for row in before.parameters}
    now = {row.name: row for row in after.parameters}
    changes = [
        _estimate(which, name, then.get(name), now.get(name))
        for which in ("final", "initial")
        for name in dict.fromkeys([*now, *then])
    ]
    position, drive = after.submission.units.position, after.submission.units.input
    units = {
        "prefilter": f"{drive}/{position}",
        "overshoot_percent": "%",
        "settling_time": "s",
        "peak_input": drive,
    }
    for key, unit in units.items():
        values = (getattr(draft.feedback, key, None) for draft in (before, after))
        changes.append(_plain("feedback", key.removesuffix("_percent"), unit, *values))
    then_runs, now_runs = _runs(before), _runs(after)
    for run in dict.fromkeys([*now_runs, *then_runs]):
        shares = (
            100 * check.nrmse if check and check.nrmse is not None else None
            for check in (then_runs.get(run), now_runs.get(run))
        )
        changes.append(_plain("hardware", f"difference in {run}", "%", *shares))
    return changes


def _runs(draft: Results) -> dict[str, Hardware]:
    return {f"{check.experiment}, cart {check.cart}": check for check in draft.hardware}


def _plain(what: str, name: str, unit: str, before: float | None, after: float | None) -> Change:
    return Change(
        what=what,
        name=name.replace("_", " "),
        unit=unit,
        before=before,
        before_std=None,
        after=after,
        after_std=None,
    )


def _estimate(which: str, name: str, then: Parameter | None, now: Parameter | None) -> Change:
    row = now or then
    return Change(
        what=which,
        name=name,
        unit=row.unit if row else "",
        before=getattr(then, which, None),
        before_std=getattr(then, f"{which}_std", None),
        after=getattr(now, which, None),
        after_std=getattr(now, f"{which}_std", None),
    )


def _differs(change: Change) -> bool:
    if change.before is None or change.after is None:
        return change.before is not change.after
    return abs(change.after - change.before) > _SAME * max(abs(change.before), abs(change.after))


def _checks(before: Results, after: Results) -> list[CheckChange]:
    then = {check.id: check for check in before.checks}
    now = {check.id: check for check in after.checks}
    changes = []
    for id_ in dict.fromkeys([*now, *then]):
        old, new = then.get(id_), now.get(id_)
        outcomes = (old.outcome if old else "", new.outcome if new else "")
        if outcomes[0] == outcomes[1] or set(outcomes) == {"", "pass"}:
            continue  # a check that came or went with its run, and passes, is no news
        message = (new or old or after.checks[0]).message
        changes.append(CheckChange(id=id_, before=outcomes[0], after=outcomes[1], message=message))
    return changes


def _files(before: Mapping[str, str], after: Mapping[str, str]) -> dict[str, str]:
    changed = {}
    for name in sorted({*before, *after}):
        if name not in before:
            changed[name] = "new"
        elif name not in after:
            changed[name] = "gone"
        elif before[name] != after[name]:
            changed[name] = "changed"
    return changed


# ------------------------------------------------------------------------- telling


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
                ("Quantity", "", "Unit", "Earlier draft", "This draft", "Change"),
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
