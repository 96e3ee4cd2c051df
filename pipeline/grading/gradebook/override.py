"""Points given by hand to one or many submissions, and their effect on the grade."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import floor
from pathlib import Path

from pipeline.errors import ConfigError
from pipeline.grading.csv_table import read_table
from pipeline.grading.grade import Adjustment, Criterion, Grade, GradeOverride
from pipeline.grading.gradebook.events import Event
from pipeline.grading.rubric import Rubric
from pipeline.grading.tolerance import exact, with_total

_HEADS = ("submission", "criterion", "points", "why")  # columns of a table of requested changes


def read_points(text: str) -> float | None:
    """Return the points that a person typed, or None for "auto".

    Raises
    ------
    ConfigError : the text is neither points nor "auto".
    """
    if text.strip().casefold() == "auto":
        return None
    try:
        return float(text.replace(",", "."))
    except ValueError:
        raise ConfigError(f"{text}: expected a number of points, or auto") from None


def check_step(points: float, *, out_of: float, step: float) -> None:
    """Refuse points that are not a multiple of the rubric's step; all points are always allowed.

    Raises
    ------
    ConfigError : the message names the nearest points that are allowed.
    """
    steps = exact(points) / exact(step)
    if steps.denominator == 1 or points == out_of:
        return
    below = floor(steps) * exact(step)
    above = min(below + exact(step), exact(out_of))
    raise ConfigError(
        f"{points:g} points are not a multiple of the rubric's step, {step:g}: "
        f"give {float(below):g} or {float(above):g}"
    )


@dataclass(frozen=True, kw_only=True)
class WantedPoints:
    """A change that a person requests: points or a comment for one criterion of a submission.

    Attributes
    ----------
    points : requested points; None for the automatic points.
    comment : whether `why` is only a comment for the team.
    line : line number in the table that requests the change; 0 without a table.
    version : version of the points that the person saw, from `Entry.version`; "" to change any.
    """

    submission: str
    criterion: str
    points: float | None
    why: str
    comment: bool = False
    line: int = 0
    version: str = ""


def read_wishes(path: Path, *, why: str = "") -> list[WantedPoints]:
    """Read requested changes from a CSV file of one of two forms.

    Either each row is a change, with the columns submission, criterion, points and why; or each row
    is a submission, with a column for each criterion, in which an empty cell changes nothing. The
    column why is optional if `why` is given. The word "auto" stands for the automatic points.

    Parameters
    ----------
    why : the reason for changes without a reason of their own.

    Raises
    ------
    ConfigError : the table is not valid; the message names the line.
    """
    table = read_table(path, exact=True)
    by_row = {"criterion", "points"} <= set(table.columns)
    needed = [name for name in (_HEADS if by_row else ("submission", "why"))
              if name != "why" or not why]  # fmt: skip
    missing = [name for name in needed if name not in table.columns]
    if missing or not table.columns.is_unique:
        form = _HEADS if by_row else ("submission", "why", "one for each criterion")
        raise ConfigError(
            f"{path.name}: needs the columns {', '.join(form)}, each once"
            + (f"; it lacks {', '.join(missing)}" if missing else "")
        )
    criteria = [name for name in table.columns if name and name not in _HEADS]
    wishes: list[WantedPoints] = []
    seen: dict[tuple[str, str], int] = {}
    for line, row in table.iterrows():
        cells = {str(name): str(cell).strip() for name, cell in row.items()}
        asked = {name: cells[name] for name in criteria if cells[name]}
        if by_row:
            asked = {cells["criterion"]: cells["points"]}
        for criterion, points in asked.items():
            try:
                given = read_points(points)
            except ConfigError as error:
                at = "" if by_row else f", column {criterion}"
                raise ConfigError(f"{path.name} line {line}{at}: {error}") from None
            first = seen.setdefault((cells["submission"], criterion), int(str(line)))
            if first != int(str(line)):
                who = f"{cells['submission']}, {criterion}"
                raise ConfigError(f"{path.name} line {line}: {who} is already in line {first}")
            wishes.append(
                WantedPoints(
                    submission=cells["submission"],
                    criterion=criterion,
                    points=given,
                    why=cells.get("why") or why,
                    line=int(str(line)),
                )
            )
    return wishes


def with_comments(grade: Grade, comments: Mapping[str, Event]) -> Grade:
    """Return the grade with each comment added at the end of its criterion's message."""
    criteria = (
        _with_comment(own, comments[own.id].text) if own.id in comments else own
        for own in grade.criteria
    )
    return grade.model_copy(update={"criteria": tuple(criteria)})


def with_overrides(
    grade: Grade,
    overrides: Mapping[str, Event],
    *,
    rubric: Rubric,
    adjustments: Iterable[Event] = (),
) -> Grade:
    """Return the grade with points given by hand, adjustments and the deduction for lateness.

    If the submission could not be graded, it has no criteria; the criteria with points given
    by hand are added.
    """
    given = {key: o.points for key, o in overrides.items() if o.points is not None}
    added = tuple(Adjustment(points=a.points or 0.0, why=a.text) for a in adjustments)
    if not given and not added:
        return grade
    judged = {criterion.id: criterion for criterion in grade.criteria}
    criteria = []
    for asked in rubric.criteria:
        own = judged.get(asked.id)
        if asked.id in given:
            own = own or _unjudged(asked.id, asked.title, asked.points)
            why, manual = overrides[asked.id].text, asked.check == "manual"
            own = _by_hand(own, given[asked.id], why=why, manual=manual)
        if own is not None:
            criteria.append(own)
    changed = {
        "adjustments": added,
        "overrides": tuple(
            GradeOverride(criterion=key, points=points, why=overrides[key].text)
            for key, points in sorted(given.items())
        ),
    }
    return with_total(grade.model_copy(update=changed), criteria, rubric=rubric)


def _unjudged(id_: str, title: str, out_of: float) -> Criterion:
    return Criterion(
        id=id_, title=title, outcome="skip", points=0.0, out_of=out_of,
        message="Not graded automatically.", expected={}, found={},
    )  # fmt: skip


def _with_comment(criterion: Criterion, why: str) -> Criterion:
    return criterion.model_copy(update={"message": f"{criterion.message} {why}"})


def _by_hand(criterion: Criterion, points: float, *, why: str, manual: bool) -> Criterion:
    points = min(points, criterion.out_of)  # an earlier rubric may have given more points
    if points == criterion.points and not manual:
        return _with_comment(criterion, why)
    changed = {
        "points": points,
        "outcome": "pass" if points >= criterion.out_of else "partial" if points > 0 else "fail",
        "message": why
        if manual
        else f"{criterion.message} Set by hand from {criterion.points:g} to {points:g} "
        f"of {criterion.out_of:g}: {why}",
    }
    return criterion.model_copy(update=changed)
