"""Preview the points of a graded class under another rubric."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.events import Entry, with_overrides
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.judge.award import needs_recordings, read_findings, recompute_points
from pipeline.grading.judge.context import Judgement
from pipeline.grading.rubric import Rubric
from pipeline.words.progress import Progress, silent

_BARS = 10  # bars of a distribution; each is a tenth of the total points


@dataclass(frozen=True, kw_only=True)
class CriterionChange:
    """The points of a team for one criterion, if the other rubric changes them.

    Attributes
    ----------
    before, after : points under each rubric; None if the rubric lacks the criterion.
    """

    id: str
    before: float | None
    after: float | None


@dataclass(frozen=True, kw_only=True)
class TeamChange:
    """The points of a team under the current and the other rubric.

    Attributes
    ----------
    late_before, late_after : points deducted for lateness.
    by_hand : criteria with points given by hand, which stay.
    """

    submission: str
    before: float
    after: float
    criteria: tuple[CriterionChange, ...] = ()
    late_before: float = 0.0
    late_after: float = 0.0
    by_hand: tuple[str, ...] = ()

    @property
    def gain(self) -> float:
        """The change in points; negative for a loss."""
        return self.after - self.before


@dataclass(frozen=True, kw_only=True)
class RubricPreview:
    """The points of a graded class under another rubric.

    Attributes
    ----------
    assignment : name of the class's rubric file, without `.toml`.
    teams : teams whose points are known under both rubrics, the largest change first.
    bars_before, bars_after : number of teams in each tenth of the total points.
    unknown : submissions without stored results of the checks.
    needs : changed keys of the rubric that take effect only if recordings are graded again.
    """

    assignment: str
    out_of_before: float
    out_of_after: float
    teams: tuple[TeamChange, ...]
    bars_before: tuple[int, ...]
    bars_after: tuple[int, ...]
    unknown: tuple[str, ...] = ()
    failed: int = 0
    needs: tuple[str, ...] = ()


def preview_rubric(
    book: Gradebook, rubric: Rubric, *, progress: Progress = silent
) -> RubricPreview:
    """Compute the points of a class under another rubric; points given by hand stay.

    Raises
    ------
    ConfigError : the gradebook holds no class.
    """
    before = book.rubric
    elsewhere = set(book.by_other_rubrics())
    teams, unknown, failed = [], [], 0
    for entry in book.entries():
        if entry.grade.status == "failed" and not (entry.overrides or entry.adjustments):
            failed += 1
            continue
        found = _usable(book.findings(entry), before, rubric)
        if entry.grade.status == "graded" and (not found or entry.submission in elsewhere):
            unknown.append(entry.submission)
            continue
        teams.append(_compared(entry, found, rubric))
        progress(f"{len(teams)} submissions")
    teams.sort(key=lambda team: (-abs(team.gain), team.submission))
    return RubricPreview(
        assignment=book.assignment,
        out_of_before=before.out_of,
        out_of_after=rubric.out_of,
        teams=tuple(teams),
        bars_before=_bars([team.before for team in teams], out_of=before.out_of),
        bars_after=_bars([team.after for team in teams], out_of=rubric.out_of),
        unknown=tuple(unknown),
        failed=failed,
        needs=tuple(needs_recordings(before, rubric)),
    )


def _bars(points: list[float], *, out_of: float) -> tuple[int, ...]:
    counts, _ = np.histogram(np.clip(points, 0.0, out_of), bins=_BARS, range=(0.0, out_of))
    return tuple(map(int, counts))


def _usable(text: str, before: Rubric, now: Rubric) -> Mapping[str, Judgement]:
    """Return the stored results of those criteria whose check is the same in both rubrics."""
    was = {criterion.id: criterion.check for criterion in before.criteria}
    same = {c.id for c in now.criteria if was.get(c.id) == c.check}
    return {id_: found for id_, found in read_findings(text or "{}").items() if id_ in same}


def _compared(entry: Entry, found: Mapping[str, Judgement], rubric: Rubric) -> TeamChange:
    automatic = recompute_points(entry.grade, found, rubric=rubric)
    after = with_overrides(automatic, entry.overrides, rubric=rubric, adjustments=entry.adjustments)
    had, has = _points(entry.grade), _points(after)
    return TeamChange(
        submission=entry.submission,
        before=entry.grade.points,
        after=after.points,
        criteria=tuple(
            CriterionChange(id=id_, before=had.get(id_), after=has.get(id_))
            for id_ in {**had, **has}
            if had.get(id_) != has.get(id_)
        ),
        late_before=entry.grade.deducted,
        late_after=after.deducted,
        by_hand=tuple(sorted(entry.overrides)),
    )


def _points(grade: Grade) -> dict[str, float]:
    return {criterion.id: criterion.points for criterion in grade.criteria}
