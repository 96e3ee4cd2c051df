"""What changed between two drafts: an earlier `results.json` and the analysis of now."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import hypot
from pathlib import Path

from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.report import limits
from pipeline.report.document import Block, Cell, Span, bullet_list, cell, paragraph
from pipeline.report.numbers import NOTHING, count, percent, significant, unit_text, with_error
from pipeline.report.sections.housekeeping import OUTCOMES, TONES
from pipeline.report.sections.page import Page
from pipeline.report.words import capital, clean, name_span, rich
from pipeline.results import Analysis
from pipeline.results_json import results_dict
from pipeline.schemas.base import plain_json
from pipeline.schemas.results import Check, Results
from pipeline.submission.complaints import refusal

_MOST_BYTES = 20_000_000  # of a results.json; real ones have a few ten thousand
_SAME = 1e-8  # relative: two processors agree to this on the ten digits of the file
_ESTIMATES = ("final", "initial")


@dataclass(frozen=True, kw_only=True)
class Change:
    """A number before and now, with its standard error where it has one."""

    what: str
    name: str
    unit: str
    before: float | None
    after: float | None
    before_std: float | None = None
    after_std: float | None = None

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

    @property
    def differs(self) -> bool:
        """Whether it is another number, or one of the two is not there."""
        if self.before is None or self.after is None:
            return self.before is not self.after
        return abs(self.after - self.before) > _SAME * max(abs(self.before), abs(self.after))


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


# ------------------------------------------------------------------------ comparing


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
        what = f"{where}: {refusal(first)}" if where else refusal(first)
        raise ConfigError(f"{path}: no results.json of cartlab ({what})") from None


def check_comparable(before: Results, *, carts: int, position_unit: str, input_unit: str) -> None:
    """Refuse what has no number in common with an earlier draft.

    Raises
    ------
    ConfigError : the earlier draft is of another number of carts or in other units.
    """
    then, units = before.submission, before.submission.units
    if (then.carts, units.position, units.input) != (carts, position_unit, input_unit):
        raise ConfigError(
            f"the earlier draft is of {count(then.carts, 'cart')} in {units.position} and "
            f"{units.input}, this one of {carts} in {position_unit} and {input_unit}: they cannot "
            "be compared"
        )


def compare_drafts(before: Results, analysis: Analysis) -> DraftChanges:
    """Return what changed from an earlier draft to an analysis.

    Raises
    ------
    ConfigError : see `check_comparable`.
    """
    check_comparable(
        before,
        carts=analysis.carts,
        position_unit=analysis.position_unit,
        input_unit=analysis.input_unit,
    )
    after = Results.model_validate(plain_json(results_dict(analysis)))
    warned, warns = before.warnings, after.warnings
    skipped, skips = ([skip.stage for skip in draft.skipped] for draft in (before, after))
    changes = (*_estimates(before, after), *_feedback(before, after), *_hardware(before, after))
    return DraftChanges(
        numbers=tuple(change for change in changes if change.differs),
        checks=tuple(_checks(before.checks, after.checks)),
        files=_files(before.provenance.files, after.provenance.files),
        new_warnings=_only(warns, warned),
        gone_warnings=_only(warned, warns),
        newly_skipped=_only(skips, skipped),
        no_longer_skipped=_only(skipped, skips),
        versions=(before.provenance.version, after.provenance.version),
    )


def _only(items: Iterable[str], others: Sequence[str]) -> tuple[str, ...]:
    return tuple(item for item in items if item not in others)


def _estimates(before: Results, after: Results) -> Iterator[Change]:
    then, now = ({row.name: row for row in draft.parameters} for draft in (before, after))
    for which in _ESTIMATES:
        for name, row in {**now, **then, **now}.items():
            old, new = then.get(name), now.get(name)
            yield Change(
                what=which,
                name=name,
                unit=row.unit,
                before=getattr(old, which, None),
                after=getattr(new, which, None),
                before_std=getattr(old, f"{which}_std", None),
                after_std=getattr(new, f"{which}_std", None),
            )


def _feedback(before: Results, after: Results) -> Iterator[Change]:
    position, drive = after.submission.units.position, after.submission.units.input
    units = {
        "prefilter": f"{drive}/{position}",
        "overshoot_percent": "%",
        "settling_time": "s",
        "peak_input": drive,
    }
    for key, unit in units.items():
        old, new = (getattr(draft.feedback, key, None) for draft in (before, after))
        name = key.removesuffix("_percent").replace("_", " ")
        yield Change(what="feedback", name=name, unit=unit, before=old, after=new)


def _hardware(before: Results, after: Results) -> Iterator[Change]:
    then, now = (
        {f"{h.experiment}, cart {h.cart}": h.nrmse and 100 * h.nrmse for h in draft.hardware}
        for draft in (before, after)
    )
    for run in {**now, **then}:
        name = f"difference in {run}".replace("_", " ")
        yield Change(what="hardware", name=name, unit="%", before=then.get(run), after=now.get(run))


def _checks(before: Iterable[Check], after: Iterable[Check]) -> Iterator[CheckChange]:
    then, now = ({check.id: check for check in checks} for checks in (before, after))
    for id_, check in {**now, **then, **now}.items():
        was, is_ = (checks[id_].outcome if id_ in checks else "" for checks in (then, now))
        # A check that came or went with its run, and passes, is no news.
        if was != is_ and {was, is_} != {"", "pass"}:
            yield CheckChange(id=id_, before=was, after=is_, message=check.message)


def _files(before: Mapping[str, str], after: Mapping[str, str]) -> dict[str, str]:
    return {
        name: "new" if name not in before else "gone" if name not in after else "changed"
        for name in sorted({*before, *after})
        if before.get(name) != after.get(name)
    }


# -------------------------------------------------------------------------- telling


def changes_line(changes: DraftChanges) -> str:
    """Return what changed in one line, for the terminal."""
    parts = []
    for which in _ESTIMATES:
        moved = [c for c in changes.numbers if c.what == which and c.percent is not None]
        if moved:
            worst = max(moved, key=lambda change: abs(change.percent or 0.0))
            sigmas = "" if worst.sigmas is None else f", {_sigmas(worst.sigmas)}"
            parts.append(
                f"{count(len(moved), f'{which} estimate')} moved, {worst.name} most "
                f"({percent(worst.percent, signed=True)}{sigmas})"
            )
    counted = (
        ("check", " now failed", [c for c in changes.checks if c.after == "fail"]),
        ("check", " no longer failed", [c for c in changes.checks if c.before == "fail"]),
        ("file", " changed", changes.files),
        ("new warning", "", changes.new_warnings),
        ("warning", " gone", changes.gone_warnings),
    )
    parts += [f"{count(len(found), noun)}{verb}" for noun, verb, found in counted if found]
    return "since the earlier draft: " + ("; ".join(parts) or "nothing changed")


def change_blocks(page: Page, changes: DraftChanges | None) -> list[Block]:
    """Return what changed since the earlier draft, as tables and lists."""
    if changes is None:
        return []
    line = changes_line(changes)
    blocks: list[Block] = [paragraph(rich(capital(line) + "."))]
    if changes.versions[0] != changes.versions[1]:
        blocks.append(
            paragraph(
                f"The earlier draft was made by cartlab {clean(changes.versions[0])}, this one by "
                f"{changes.versions[1]}: the program may account for some of it."
            )
        )
    if changes.numbers:
        caption = (
            "Numbers that moved. The change in brackets is in combined standard errors (σ); "
            "below one it is chance."
        )
        head = ("Quantity", "Kind", "Unit", "Earlier draft", "This draft", "Change")
        blocks.append(page.table(caption, head, map(_number_row, changes.numbers), "lllrrr"))
    if changes.checks:
        head = ("Check", "Earlier draft", "This draft", "What was found")
        rows = [
            [
                cell(Span(clean(check.id), "code")),
                *(
                    cell(OUTCOMES.get(outcome, "not there"), TONES.get(outcome, "quiet"))
                    for outcome in (check.before, check.after)
                ),
                cell(rich(clean(check.message))),
            ]
            for check in changes.checks
        ]
        blocks.append(page.table("Checks that came out differently.", head, rows, "llll"))
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


def _number_row(change: Change) -> list[Cell]:
    moved, sigmas = percent(change.percent, signed=True), change.sigmas
    if sigmas is not None:
        moved += f" ({_sigmas(sigmas)})"
    is_chance = sigmas is not None and abs(sigmas) < limits.CHANCE
    name = name_span(change.name) if change.what in _ESTIMATES else rich(clean(change.name))
    return [
        cell(name),
        cell(change.what, "quiet"),
        cell(unit_text(clean(change.unit)) or "1"),
        cell(_value(change.before, change.before_std)),
        cell(_value(change.after, change.after_std)),
        cell(moved, "quiet" if is_chance else ""),
    ]


def _sigmas(sigmas: float) -> str:
    return f"{significant(abs(sigmas), digits=2)} σ"


def _value(value: float | None, std: float | None) -> str:
    return NOTHING if value is None else with_error(value, std)
