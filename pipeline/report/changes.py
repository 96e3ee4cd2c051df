"""Compare an earlier `results.json` with the current analysis.

The section lists only numbers that changed, checks that fail now but did not before, and the status
if it changed.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import hypot
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.json_files import file_model, plain
from pipeline.report.builder import Page
from pipeline.report.document import Block, Cell, bullet_list, cell, paragraph
from pipeline.results import Analysis, ReportStatus
from pipeline.setup import Setup, Units
from pipeline.submission.toml import first_refusal
from pipeline.words.numbers import NOTHING, count, percent, significant, unit_text, with_error
from pipeline.words.phrases import phrases
from pipeline.words.text import capital, clean, name_span, rich

_WORDS = phrases("report")
_MOST_BYTES = 20_000_000  # limit for results.json; a real file has about ten thousand bytes
Draft = Mapping[str, Any]  # the content of a results.json


@dataclass(frozen=True, kw_only=True)
class DraftNumber:
    """A number of one draft, with its standard error if it has one."""

    value: float
    std: float | None = None
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Change:
    """A number of the earlier and of the current draft.

    Attributes
    ----------
    what : the part of the draft: "final", "initial", "feedback" or "hardware".
    before, after : the number in the earlier and in the current draft; None if the draft lacks it.
    """

    what: str
    name: str
    before: DraftNumber | None
    after: DraftNumber | None

    @property
    def percent(self) -> float | None:
        """The change as a percentage of the earlier value."""
        if self.before is None or self.after is None or self.before.value == 0:
            return None
        return 100 * (self.after.value - self.before.value) / abs(self.before.value)

    @property
    def sigmas(self) -> float | None:
        """The change divided by the combined standard error."""
        old, new = self.before, self.after
        if old is None or new is None or old.std is None or new.std is None:
            return None
        combined = hypot(old.std, new.std)
        return (new.value - old.value) / combined if combined > 0 else None

    @property
    def differs(self) -> bool:
        """Whether the numbers differ, or one draft lacks the number."""
        if self.before is None or self.after is None:
            return self.before is not self.after
        old, new = self.before.value, self.after.value
        # The file has ten digits. Two computers may give numbers that differ by this fraction.
        return abs(new - old) > 1e-8 * max(abs(old), abs(new))


@dataclass(frozen=True, kw_only=True)
class DraftChanges:
    """The differences between two drafts.

    Attributes
    ----------
    numbers : the numbers that changed.
    failed : message of each check that fails now but did not before, by the check's id.
    passed : ids of the checks that failed before but do not fail now.
    status : the status before and now, in words; () if it is the same, or was not known.
    """

    numbers: tuple[Change, ...]
    failed: dict[str, str]
    passed: tuple[str, ...] = ()
    status: tuple[str, ...] = ()


# ------------------------------------------------------------------------ comparing


def read_results(path: Path) -> Draft:
    """Return the content of an earlier `results.json`.

    Raises
    ------
    ConfigError : the file cannot be read, or is not a `results.json` of cartlab.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ConfigError(f"{path}: too large for a results.json")
        read = file_model(Analysis).model_validate_json(path.read_bytes())
        return read.model_dump(by_alias=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except ValidationError as error:
        what = first_refusal(error)
        raise ConfigError(f"{path}: not a results.json of cartlab ({what})") from None


def check_comparable(before: Draft, *, bench: Setup) -> None:
    """Refuse an earlier draft that cannot be compared with this bench.

    Raises
    ------
    ConfigError : the numbers of carts or the units of the two drafts differ.
    """
    then, units = before["submission"], Units(**before["submission"]["units"])
    if (then["carts"], units) != (bench.n, bench.units):
        raise ConfigError(
            f"the earlier draft has {count(then['carts'], 'cart')} in {units.position} and "
            f"{units.input}, this one has {bench.n} in {bench.units.position} and "
            f"{bench.units.input}: they cannot be compared"
        )


def compare_drafts(before: Draft, analysis: Analysis) -> DraftChanges:
    """Return what changed between an earlier draft and an analysis.

    Raises
    ------
    ConfigError : see `check_comparable`.
    """
    check_comparable(before, bench=analysis.bench)
    after = plain(analysis)
    then, now = ({(what, name): n for what, name, n in _numbers(r)} for r in (before, after))
    changes = (
        Change(what=what, name=name, before=then.get((what, name)), after=now.get((what, name)))
        for what, name in {**now, **then}
    )
    failed_then, failed_now = (
        {check["id"]: check["message"] for check in draft["checks"] if check["outcome"] == "fail"}
        for draft in (before, after)
    )
    status = _status(before), analysis.status.words
    return DraftChanges(
        numbers=tuple(change for change in changes if change.differs),
        failed={id_: text for id_, text in failed_now.items() if id_ not in failed_then},
        passed=tuple(id_ for id_ in failed_then if id_ not in failed_now),
        status=status if status[0] and status[0] != status[1] else (),
    )


def _status(draft: Draft) -> str:
    """Return the status of a draft in words; "" if an earlier version of cartlab wrote none."""
    state = draft.get("status")
    if not state:
        return ""
    if state == "numbers_disagree":
        n = sum(one["code"] == "number_off" for one in draft.get("findings", ()))
    else:
        n = sum(check["outcome"] == "fail" for check in draft["checks"])
    return ReportStatus(state=state, count=n).words


def _numbers(draft: Draft) -> Iterator[tuple[str, str, DraftNumber]]:
    """Yield every number of a draft, with the part of the draft and the number's name."""
    for which in ("final", "initial"):
        for row in draft["parameters"]:
            value, std = row.get(which), row.get(f"{which}_std")
            if value is not None:
                yield which, row["name"], DraftNumber(value=value, std=std, unit=row["unit"])
    units = Units(**draft["submission"]["units"])
    quantities = {
        "prefilter": units.stiffness,
        "overshoot_percent": "%",
        "settling_time": "s",
        "peak_input": units.input,
    }
    for key, unit in quantities.items():
        value = (draft["feedback"] or {}).get(key)
        if value is not None:
            name = key.removesuffix("_percent").replace("_", " ")
            yield "feedback", name, DraftNumber(value=value, unit=unit)
    for one in draft["hardware"]:
        if one["nrmse"] is not None:
            name = f"difference in {one['experiment']}, cart {one['cart']}".replace("_", " ")
            yield "hardware", name, DraftNumber(value=100 * one["nrmse"], unit="%")


# -------------------------------------------------------------------------- telling


def changes_line(changes: DraftChanges) -> str:
    """Return the changes in one line for the terminal."""
    parts = []
    for which in ("final", "initial"):
        moved = [c for c in changes.numbers if c.what == which and c.percent is not None]
        if moved:
            worst = max(moved, key=lambda change: abs(change.percent or 0.0))
            estimates = count(len(moved), f"{which} estimate")
            parts.append(f"{estimates} moved, {worst.name} most ({_moved(worst, between=', ')})")
    if changes.failed:
        parts.append(f"{count(len(changes.failed), 'check')} now failed")
    if changes.passed:
        parts.append(f"{count(len(changes.passed), 'check')} no longer failed")
    if changes.numbers and not parts:
        parts.append(f"{count(len(changes.numbers), 'number')} moved")
    if changes.status:
        parts.append("status: " + " → ".join(changes.status))
    return "since the earlier draft: " + ("; ".join(parts) or "nothing changed")


def change_blocks(page: Page, changes: DraftChanges | None) -> list[Block]:
    """Return the section on changes since the earlier draft."""
    if changes is None:
        return []
    blocks: list[Block] = [paragraph(rich(capital(changes_line(changes)) + "."))]
    if changes.numbers:
        rows = map(_number_row, changes.numbers)
        blocks.append(page.table(_WORDS, "moved_table", rows, "lllrrr"))
    if changes.failed:
        messages = bullet_list(rich(clean(message)) for message in changes.failed.values())
        blocks += [paragraph(_WORDS.spans("newly_failed")), messages]
    return blocks


def _number_row(change: Change) -> list[Cell]:
    sigmas, known = change.sigmas, change.after or change.before
    drafts = (change.before, change.after)
    is_estimate = change.what in ("final", "initial")
    return [
        cell(name_span(change.name) if is_estimate else rich(clean(change.name))),
        cell(change.what, "quiet"),
        cell(unit_text(clean(known.unit if known else ""))),
        *(cell(with_error(n.value, n.std) if n else NOTHING) for n in drafts),
        # A change of less than one standard error is shown in a quiet colour.
        cell(_moved(change), "quiet" if sigmas is not None and abs(sigmas) < 1.0 else ""),
    ]


def _moved(change: Change, *, between: str = " (") -> str:
    """Return a change as text, such as "+2.0 % (1.4 σ)".

    If `between` is given, it separates the two numbers instead of the brackets.
    """
    text = percent(change.percent, signed=True)
    if change.sigmas is None:
        return text
    end = ")" if between == " (" else ""
    return f"{text}{between}{significant(abs(change.sigmas), digits=2)} σ{end}"
