"""Simulated students are honest until a test changes their report."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cache
from pathlib import Path
from types import MappingProxyType

from pipeline.grading.grade import Criterion, Grade
from pipeline.grading.judge.run import Graded, grade_analysis, under_rubric
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.results import Analysis
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import Students, write_submission
from pipeline.submission import (
    Reported,
    ReportedFeedback,
    ReportedStateSpace,
    Submission,
    load_submission,
)
from pipeline.workflow import analyse


@dataclass(frozen=True, kw_only=True, eq=False)
class Student:
    """A submission and the analysis of its recordings, under the rubric for its carts."""

    submission: Submission
    analysis: Analysis
    rubric: Rubric

    @property
    def reported(self) -> Reported:
        """The student's reported numbers."""
        assert self.submission.reported is not None
        return self.submission.reported

    def value(self, table: str, name: str) -> float:
        """Return a reported parameter."""
        return float(getattr(self.reported, table)[name])

    def reporting(
        self,
        *,
        initial: Mapping[str, float] | Mapping[str, Decimal] = MappingProxyType({}),
        final: Mapping[str, float] | Mapping[str, Decimal] = MappingProxyType({}),
        state_space: ReportedStateSpace | None = None,
        feedback: ReportedFeedback | None = None,
    ) -> "Student":
        """Return the student with other numbers in the tables, typed to three digits."""
        update: dict = {
            label: {**getattr(self.reported, label), **{k: typed(v) for k, v in numbers.items()}}
            for label, numbers in (("initial", initial), ("final", final))
        }
        update |= {"state_space": state_space} if state_space else {}
        update |= {"feedback": feedback} if feedback else {}
        reported = self.reported.model_copy(update=update)
        return replace(self, submission=self.submission.model_copy(update={"reported": reported}))

    def without(self, table: str, *names: str) -> "Student":
        """Return the student with parameters left out of a table."""
        left = {k: v for k, v in getattr(self.reported, table).items() if k not in names}
        reported = self.reported.model_copy(update={table: left})
        return replace(self, submission=self.submission.model_copy(update={"reported": reported}))

    def under(self, **changed: object) -> "Student":
        """Return the student under a rubric with changed keys."""
        plain = self.rubric.model_dump(mode="json") | changed
        return replace(self, rubric=Rubric.model_validate(plain))

    def grade(self, *, days_late: float = 0.0) -> Grade:
        """Grade the report against the recordings."""
        return self.graded(days_late=days_late).grade

    def graded(self, *, days_late: float = 0.0) -> Graded:
        """Grade the report and return the grade with the findings of the checks."""
        return grade_analysis(
            self.submission, self.analysis, rubric=self.rubric, name="team-07", days_late=days_late
        )


def criterion(grade: Grade, id_: str) -> Criterion:
    """Return a criterion of a grade."""
    (found,) = [c for c in grade.criteria if c.id == id_]
    return found


def typed(value: float | Decimal) -> Decimal:
    """Return a float rounded to three digits, or a `Decimal` unchanged."""
    if isinstance(value, Decimal):
        return value
    return Decimal(f"{value:#.3g}".removesuffix("."))


@cache
def student(carts: int, *, hide: tuple[str, ...] = ()) -> Student:
    """Return an honest student on a preset's bench with hidden effects."""
    preset = f"throne-{carts}dof"
    bench = prepare_bench(preset=preset, hide=hide)
    rubric = load_rubric(Path(preset))
    with tempfile.TemporaryDirectory() as folder:
        write_submission(Path(folder), bench, seed=3, compact=True, reported=True)
        submission, _ = under_rubric(load_submission(Path(folder)), rubric)
        return Student(submission=submission, analysis=analyse(submission), rubric=rubric)


def write_team(folder: Path, seed: int) -> Path:
    """Write an honest submission for one cart, whose author has the id "s" and the seed."""
    write_submission(
        folder, "throne-1dof", seed=seed, compact=True, reported=True,
        students=Students(authors=(f"s{seed}",)),
    )  # fmt: skip
    return folder


def copy_step(of: Path, to: Path) -> None:
    """Put the first step of one submission in place of the second step of another."""
    (to / "data" / "step-2.csv").write_bytes((of / "data" / "step-1.csv").read_bytes())
