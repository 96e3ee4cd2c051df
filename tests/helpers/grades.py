"""Grades and outcomes for tests of the gradebook and of the files written from it."""

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from pipeline.grading.batch.worker import grade_hand_in
from pipeline.grading.grade import Criterion, Flag, Grade, grade_text
from pipeline.grading.gradebook.database import FILE
from pipeline.grading.gradebook.events import Entry, Request
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Batch, Grading, HandIn, Setup
from pipeline.grading.publish.outputs import write_outputs
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.plant.chain import PRESETS
from pipeline.plant.identities import transfer_functions
from pipeline.report.figures.grading import reported_bode_figure
from pipeline.report.figures.style import drawing, to_svg
from pipeline.resources import RUBRICS
from pipeline.results import FrequencyResponse
from pipeline.setup import PAPER_UNITS


def two_cart_rubric() -> Rubric:
    """Return the shipped rubric for two carts, with 20 points and 10 % off per day late."""
    return load_rubric(RUBRICS / "throne-2dof.toml")


def in_this_process(tasks: Sequence[HandIn], setup: Setup) -> Iterator[Grading]:
    """Run tasks without a worker process, whose start takes longer than grading a small class."""
    how = {"rubric": setup.rubric, "scratch": setup.scratch, "figures": setup.figures}
    for task in tasks:
        yield grade_hand_in(task, **how)


def make_grade(name: str, *, share: float = 1.0, days_late: float = 0.0, **changes: Any) -> Grade:
    """Return a grade in which each criterion earned the given share of its points."""
    criteria = tuple(
        Criterion(
            id=asked.id,
            title=asked.title,
            outcome="pass" if share == 1 else "fail" if share == 0 else "partial",
            points=round(share * asked.points, 2),
            out_of=asked.points,
            message="As expected." if share == 1 else "omega_1 is off.",
            expected={"omega_1": 19.6},
            found={"omega_1": 3.12},
        )
        for asked in two_cart_rubric().criteria
    )
    fields: dict[str, Any] = {
        "submission": name,
        "authors": (f"s-{name}",),
        "status": "graded",
        "points": round(sum(c.points for c in criteria), 2),
        "out_of": 20.0,
        "days_late": days_late,
        "criteria": criteria,
    }
    return Grade(**{**fields, **changes})


def failed_grade(name: str, reason: str) -> Grade:
    """Return the grade of a submission that could not be graded."""
    return Grade(
        submission=name, authors=(), status="failed", points=0.0, out_of=20.0, reason=reason
    )


def hertz_flag() -> Flag:
    """Return the flag of a frequency in the wrong unit."""
    return Flag(
        code="hz_for_rad_s",
        parameters=("omega_1",),
        message="3.12 is 19.6/2π: this looks like Hz where rad/s is asked.",
        evidence={"reported": 3.12, "recomputed": 19.6, "ratio": 0.159},
    )


def shared_flag(other: str) -> Flag:
    """Return the flag of a recording that is also in another submission."""
    return Flag(
        code="shared_data",
        parameters=("step-1",),
        message=f"The recording of step-1 stands in {other} too.",
        evidence={
            "submissions": [other],
            "recordings": [
                {
                    "experiment": "step-1",
                    "submission": other,
                    "other_experiment": "step-1",
                    "sigmas": 9.5,
                }
            ],
        },
    )


def make_outcome(grade: Grade, *, key: str = "", **changes: Any) -> Grading:
    """Return the outcome of a grading with this grade."""
    fields: dict[str, Any] = {
        "submission": grade.submission,
        "authors": grade.authors,
        "key": key or f"key of {grade.submission}",
        "status": grade.status,
        "reason": grade.reason,
        "days_late": grade.days_late,
        "grade": grade_text(grade),
        "fingerprints": grade.submission.encode(),
    }
    return Grading(**{**fields, **changes})


def finish(
    book: Gradebook,
    *class_: Grade | Grading,
    rubric: Rubric | None = None,
    shared: Mapping[str, Flag] | None = None,
    moved: Mapping[str, str] | None = None,
    key: str = "key",
) -> list[str]:
    """Store what is new and make it the class list; return the changes that the gradebook tells."""
    outcomes = [
        one if isinstance(one, Grading) else make_outcome(one, key=f"{key} of {one.submission}")
        for one in class_
    ]
    for outcome in outcomes:
        if book.known(outcome.key) is None:
            book.put(outcome)
    keys = tuple(outcome.key for outcome in outcomes)
    batch = Batch(keys=keys, shared=shared or {}, moved=moved or {})
    return book.finish(batch, rubric=rubric or two_cart_rubric())


@contextmanager
def book_of(
    place: str | Path,
    *class_: Grade | Grading,
    rubric: Rubric | None = None,
    shared: Mapping[str, Flag] | None = None,
) -> Iterator[Gradebook]:
    """Open a new gradebook of an assignment called `lab` with this class list."""
    with Gradebook(place, assignment="lab", create=True) as book:
        finish(book, *class_, rubric=rubric, shared=shared)
        yield book


def seen(queued: tuple[Entry, Request]) -> str:
    """Return the version of a request in the queue, which an answer must name."""
    entry, request = queued
    return entry.request_version(request.criterion)


def write_class(folder: Path, *, anonymous: bool = False) -> Path:
    """Write the pages of a varied class into a folder, with figures and hostile names."""
    for name, content in _class_files(anonymous=anonymous).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def write_class_of_two(folder: Path, *, anonymous: bool = False) -> None:
    """Grade a class called `lab` of two teams: a perfect one, and a late one with a wrong gain.

    The gradebook has the findings of the checks, as after a real grading.
    """
    from pipeline.grading.judge.award import findings_text
    from tests.helpers.grading_students import student  # simulates a bench and analyses it

    honest = student(1)
    rubric = honest.rubric.model_copy(update={"anonymous": anonymous})
    wrong = honest.reporting(final={"K": 1.1 * honest.value("final", "K")})
    folder.mkdir()
    outcomes = []
    for name, team, days_late in (("team-1", honest, 0.0), ("team-2", wrong, 1.3)):
        graded = team.graded(days_late=days_late)
        named = {"submission": name, "authors": (f"s {name}",)}
        grade = graded.grade.model_copy(update=named)
        outcomes.append(make_outcome(grade, findings=findings_text(graded.judgements)))
    with book_of(folder, *outcomes, rubric=rubric):
        pass


@cache
def _class_files(*, anonymous: bool) -> dict[str, bytes]:
    """Return the files of a varied class by name; they are made once per process."""
    with TemporaryDirectory() as place:
        folder = Path(place)
        fill_book(folder, anonymous=anonymous)
        with Gradebook(folder) as book:
            write_outputs(book, folder)
        files = (path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def fill_book(place: str | Path, *, anonymous: bool = False) -> None:
    """Make a gradebook with a varied class, with figures and hostile names."""
    rubric = two_cart_rubric().model_copy(update={"anonymous": anonymous})
    names = [f"team-{n:02d}" for n in range(1, 13)]
    names += ["Ünal 学生 & co", "a-name-without-end-" * 5, "=cmd'C'!A0"]
    outcomes = []
    for n, name in enumerate(names):
        flags = (hertz_flag(),) if n % 3 == 0 else ()
        authors = (f"s{n}", "<script>alert(1)</script>") if n == 4 else (f"s{n}",)
        grade = make_grade(
            name, share=round(1 - n / 20, 2), days_late=n % 2, flags=flags, authors=authors
        )
        outcomes.append(make_outcome(grade, figures=_figure(name) if n < 2 else ()))
    broken = failed_grade("broken", "submission.toml line 3: <b>cart</b> is no key")
    outcomes.append(make_outcome(broken))
    shared = {"team-02": shared_flag("team-03"), "team-03": shared_flag("team-02")}
    outcomes.sort(key=lambda outcome: outcome.submission)
    with book_of(place, *outcomes, rubric=rubric, shared=shared) as book:
        book.override("team-02", "laws", 1.0, why="right, <i>as told</i>", by="Ada")


def _figure(name: str) -> tuple[tuple[str, str], ...]:
    """Return a figure of a response with its fit and the curve of a wrong reported table."""
    chain = PRESETS["throne-2dof"]
    omega = np.geomspace(5.0, 60.0, 20)
    response = chain.frequency_response(omega)[0]
    measured = FrequencyResponse(
        cart=1, omega=omega, magnitude=np.abs(response), magnitude_std=0.01 * np.abs(response),
        phase=np.angle(response), phase_std=np.full(omega.size, 0.01), source="dwells",
    )  # fmt: skip
    values = {**chain.parameters(), "omega_a": chain.parameters()["omega_a"] / 2}
    with drawing():
        figure = reported_bode_figure(
            measured, chain=chain, reported=transfer_functions(values), units=PAPER_UNITS
        )
        svg = to_svg(figure, name="response-1", alt="Response of cart 1.")
    return (("response-1.svg", svg),)


def n_graded(out: Path) -> int:
    """Return the number of gradings in a gradebook, which may be in use or missing."""
    try:
        with closing(sqlite3.connect(f"file:{out / FILE}?mode=ro", uri=True)) as book:
            return book.execute("SELECT count(*) FROM gradings").fetchone()[0]
    except sqlite3.Error:
        return 0
