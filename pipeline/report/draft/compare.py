"""Compare two drafts: an earlier `results.json` with the analysis of now."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import ValidationError

from pipeline.errors import ConfigError
from pipeline.report.draft.changes import Change, CheckChange, DraftChanges
from pipeline.report.numbers import count
from pipeline.results import Analysis
from pipeline.results_json import results_dict
from pipeline.schemas.base import plain_json
from pipeline.schemas.results import Hardware, Parameter, Results

_MOST_BYTES = 20_000_000  # of a results.json; real ones have a few ten thousand
_SAME = 1e-8  # relative: two processors agree to this on the ten digits of the file


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
