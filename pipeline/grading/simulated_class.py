"""Grade simulated students who have a reference's recordings: honest ones, and each known mistake.

It shows what a rubric does before a class is graded. All students share the recordings of the
reference, which are analysed once; so this also works for a lab that nobody has simulated.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

import numpy as np

from pipeline.errors import DataError, SubmissionError
from pipeline.estimation.state_feedback import design_feedback
from pipeline.grading.grade import CODES, Code, Grade
from pipeline.grading.judge.run import Analysed, analyse_under, grade_analysis, prepare_work
from pipeline.grading.mistakes.catalogue import Mistake, known_mistakes, transient_fits
from pipeline.grading.reference import References, readings, trusted_chain
from pipeline.grading.rubric import Rubric, matching
from pipeline.grading.words import WORDS, points_text
from pipeline.names import read_name
from pipeline.plant.chain import Chain
from pipeline.simulated.submission import (
    believed_chain,
    feedback,
    final_estimates,
    initial_estimates,
    state_space,
)
from pipeline.submission import Reported, Submission
from pipeline.words.numbers import count
from pipeline.words.progress import Progress, silent

HONEST = 20
# Of a class with the same recordings, nobody can lack those that would decide between two tables,
# and nobody is the one who copied.
NOT_ALONE: tuple[Code, ...] = ("initial_final_disagree", "shared_data")
MISTAKES: tuple[Code, ...] = tuple(code for code in CODES if code not in NOT_ALONE)
_OFF = 1.35  # factor of an error that no known mistake explains
_PREFILTER = Decimal("1.3")  # factor of a wrong prefilter


@dataclass(frozen=True, kw_only=True)
class SimulatedClass:
    """The grades of simulated students.

    Attributes
    ----------
    honest : the grades of students without a mistake.
    mistakes : for each mistake, the grade of the student who makes it.
    impossible : the mistakes that nobody can make with these recordings and this rubric.
    """

    honest: tuple[Grade, ...]
    mistakes: Mapping[Code, Grade]
    impossible: tuple[Code, ...]


def simulate_class(
    submission: Submission, *, rubric: Rubric, honest: int = HONEST, progress: Progress = silent
) -> SimulatedClass:
    """Grade simulated students who have the recordings of a reference submission.

    Raises
    ------
    SubmissionError : no recording can be read, or the number of carts differs from the rubric's.
    """
    bench = analyse_under(submission, rubric=rubric, progress=progress)
    students = _Students(bench, rubric)
    total = honest + len(MISTAKES)
    grades: list[Grade] = []
    mistakes: dict[Code, Grade] = {}
    for number in range(honest):
        progress(f"grading simulated students: {number + 1} of {total}")
        grades.append(students.grade(students.honest(seed=number)))
    own = students.honest(seed=0)
    for number, code in enumerate(MISTAKES, start=honest + 1):
        progress(f"grading simulated students: {number} of {total}")
        if (found := students.with_mistake(own, code, progress=progress)) is not None:
            mistakes[code] = found
    impossible: tuple[Code, ...] = tuple(code for code in MISTAKES if code not in mistakes)
    return SimulatedClass(honest=tuple(grades), mistakes=mistakes, impossible=impossible)


class _Students:
    """Students with the same recordings, whose reports differ."""

    def __init__(self, bench: Analysed, rubric: Rubric) -> None:
        self._bench, self._rubric = bench, rubric
        self._chain = trusted_chain(bench.analysis)
        work, _, _ = prepare_work(bench.submission, bench.analysis, rubric=rubric)
        self._references: References = work.references
        self._changes: Mapping[Code, Callable[[Reported], Reported]] = {
            "no_fit_done": lambda own: _changed(own, "final", {**own.final, **own.initial}),
            "initial_off": lambda own: self._off(own, "initial"),
            "final_off": lambda own: self._off(own, "final"),
            "physically_impossible": _negative,
            "wrong_state_space": _wrong_sign,
            "wrong_gains": lambda own: _feedback(
                own, "gains", lambda x: tuple(-gain for gain in x)
            ),
            "wrong_prefilter": lambda own: _feedback(own, "prefilter", lambda x: _PREFILTER * x),
            "missing": _incomplete,
        }

    def grade(self, own: Reported, bench: Analysed | None = None) -> Grade:
        """Return the grade of a report, by default with the recordings of the reference."""
        bench = bench or self._bench
        submission = bench.submission.model_copy(update={"reported": own, "unread": ()})
        given = {"rubric": self._rubric, "name": "simulated"}
        return grade_analysis(submission, bench.analysis, **given).grade

    # ------------------------------------------------------------------------------ honest

    def honest(self, *, seed: int) -> Reported:
        """Return the report of a student with typical errors.

        A number of the first table is that of one of the repeats, chosen at random.
        """
        rng, analysis = np.random.default_rng(seed), self._bench.analysis
        asked, names = self._rubric.required, self._rubric.names
        of = {table: matching(getattr(asked, table), names) for table in ("initial", "final")}
        first: dict[str, Any] = {}
        last: dict[str, Any] = {}
        more: dict[str, Any] = {}
        for name, one in self._references.initial.items():
            read = [one.value, *readings(name, analysis)]
            first[name] = _three_digits(float(rng.choice(read)) * (1 + 0.002 * _error(rng)))
        for name, one in self._references.final.items():
            spread = 0.04 if read_name(name).is_damping else 0.005
            last[name] = _three_digits(one.value * (1 + spread * _error(rng)))
        if self._chain is not None:
            dwells = sorted({r.omega / (2 * np.pi) for r in analysis.records if r.omega})
            own = believed_chain(self._chain, rng)
            guessed = initial_estimates(self._chain, dwells_hz=dwells, rng=rng)
            by_eye = {name for name in guessed if read_name(name).is_by_eye}
            first = {**guessed, **{x: v for x, v in first.items() if x not in by_eye}}
            last = {**last, **final_estimates(own)}
            more = self._model(own)
        tables = {"initial": first, "final": last}
        kept = {t: {x: one[x] for x in of[t] if x in one} for t, one in tables.items()}
        return Reported.model_validate({**kept, **more})

    def _model(self, own: Chain) -> dict[str, Any]:
        """Return the state model and the controller, as far as the rubric asks for them."""
        asked = self._rubric.required
        found: dict[str, Any] = {}
        if asked.state_space:
            found["state_space"] = state_space(own)
        task = self._bench.submission.design
        if asked.feedback and task is not None:
            try:
                designed = feedback(design_feedback(own, task))
            except DataError:  # then no student reaches the goal
                return found
            found["feedback"] = {
                name: designed[name] for name in asked.feedback if name in designed
            }
        return found

    # ---------------------------------------------------------------------------- mistakes

    def with_mistake(self, own: Reported, code: Code, *, progress: Progress) -> Grade | None:
        """Return the grade of a report with one mistake; None if nobody can make it."""
        if code == "data_problem":
            bench = self._with_a_copy(progress)
            return self.grade(own, bench) if bench else None
        change = self._changes.get(code, lambda own: self._catalogued(own, code))
        wrong = change(own)
        return self.grade(wrong) if wrong != own else None

    def _catalogued(self, own: Reported, code: Code) -> Reported:
        """Return a report with the first mistake of this kind in the grader's catalogue.

        A mistake in reading a decay or a step is made in the first table, others in both.
        """
        for table in ("initial", "final"):
            numbers = getattr(own, table)
            found = (m for m in self._mistakes(own, table) if m.codes == (code,))
            for mistake in found:
                predicted = {x: one.value for x, one in mistake.predicted.items() if x in numbers}
                if predicted:
                    wrong = {x: _three_digits(value) for x, value in predicted.items()}
                    own = _changed(own, table, {**numbers, **wrong})
                    break
        return own

    def _mistakes(self, own: Reported, table: str) -> Iterator[Mistake]:
        known, analysis = getattr(self._references, table), self._bench.analysis
        in_final = table == "final"
        for mistake in known_mistakes(known, analysis, own):
            if not (in_final and mistake.from_time_records):
                yield mistake
        if in_final:
            yield from transient_fits(analysis, own.final, known)

    def _off(self, own: Reported, table: str) -> Reported:
        """Return a report with one wrong frequency or gain in a table, for no known reason."""
        numbers = getattr(own, table)
        names = [x for x in numbers if not read_name(x).is_damping and not read_name(x).is_by_eye]
        judged = [x for x in names if x in getattr(self._references, table)]
        if not judged:
            return own
        wrong = Decimal(str(_OFF)) * numbers[judged[-1]]
        return _changed(own, table, {**numbers, judged[-1]: _three_digits(float(wrong))})

    def _with_a_copy(self, progress: Progress) -> Analysed | None:
        """Return the recordings with one that is a copy of another; None without two of a kind."""
        runs = self._bench.submission.experiments
        for run in self._rubric.required.experiments:
            alike = [one for one in runs if one.kind == run.kind and one.run is None]
            if len(alike) > 1 and run.kind != "closed_loop":
                first, second = alike[:2]
                break
        else:
            return None
        experiments = [
            one.model_copy(update={"file": first.file}) if one is second else one for one in runs
        ]
        submission = self._bench.submission.model_copy(update={"experiments": tuple(experiments)})
        try:
            return analyse_under(submission, rubric=self._rubric, progress=progress)
        except SubmissionError:
            return None


def _error(rng: np.random.Generator) -> float:
    return float(np.clip(rng.standard_normal(), -2, 2))


def _three_digits(value: float) -> Decimal:
    return Decimal(f"{value:#.3g}".removesuffix("."))


def _changed(own: Reported, table: str, numbers: Mapping[str, Decimal]) -> Reported:
    """Return a report in which a table has other numbers for the same names."""
    kept = {name: numbers[name] for name in getattr(own, table)}
    return own.model_copy(update={table: kept})


def _negative(own: Reported) -> Reported:
    """Return a report with a negative damping, or without dampings another negative number."""
    dampings = [name for name in own.final if read_name(name).is_damping]
    for name in [*dampings, *own.final][:1]:
        return _changed(own, "final", {**own.final, name: -own.final[name]})
    return own


def _wrong_sign(own: Reported) -> Reported:
    """Return a report with a wrong sign of the first stiffness in A."""
    if own.state_space is None:
        return own
    A = [list(row) for row in own.state_space.A]
    A[1][0] = -A[1][0]
    space = own.state_space.model_copy(update={"A": tuple(map(tuple, A))})
    return own.model_copy(update={"state_space": space})


def _feedback(own: Reported, name: str, change: Callable[[Any], Any]) -> Reported:
    """Return a report with another value of the controller, if it has one."""
    found = getattr(own.feedback, name, None)
    if own.feedback is None or not found:
        return own
    wrong = own.feedback.model_copy(update={name: change(found)})
    return own.model_copy(update={"feedback": wrong})


def _incomplete(own: Reported) -> Reported:
    """Return a report that lacks its state model or, without one, its last number."""
    if own.state_space is not None:
        return own.model_copy(update={"state_space": None})
    table = "final" if own.final else "initial"
    numbers = getattr(own, table)
    return own.model_copy(update={table: dict(list(numbers.items())[:-1])})


# ------------------------------------------------------------------------------- as a table


def class_dict(found: SimulatedClass) -> dict[str, Any]:
    """Return the points of simulated students, for JSON."""

    def one(grade: Grade) -> dict[str, Any]:
        lost = {c.id: round(c.out_of - c.points, 2) for c in grade.criteria if c.id in grade.lost}
        return {"points": grade.points, "lost": lost, "flags": list(grade.codes)}

    return {
        "honest": [one(grade) for grade in found.honest],
        "mistakes": {code: one(grade) for code, grade in found.mistakes.items()},
        "impossible": list(found.impossible),
    }


def class_text(found: SimulatedClass) -> str:
    """Return the points of simulated students as a table."""
    points = sorted(grade.points for grade in found.honest)
    losers = [grade for grade in found.honest if grade.lost]
    rows = [("who", "points", "named", "loses points in")]
    if points:
        span = points_text(points[0])
        span += f" to {points_text(points[-1])}" if points[0] < points[-1] else ""
        lost = sorted({id_ for grade in losers for id_ in grade.lost})
        rows.append((count(len(points), "honest student"), span, "", ", ".join(lost)))
    for code, grade in found.mistakes.items():
        lost = [
            f"{c.id} −{points_text(c.out_of - c.points)}"
            for c in grade.criteria
            if c.id in grade.lost
        ]
        title = WORDS.text(f"title_{code}")
        named = "yes" if code in grade.codes else ", ".join(grade.codes) or "no"
        rows.append((title, points_text(grade.points), named, ", ".join(lost)))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    lines = [
        "  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[3]]).rstrip()
        for row in rows
    ]
    head = "simulated students with the reference's recordings:"
    by_person = next(
        (
            [f"{c.id} ({points_text(c.out_of)})" for c in one.criteria if c.id in one.open]
            for one in found.honest
        ),
        [],
    )
    never = [WORDS.text(f"title_{code}") for code in found.impossible]
    more = ["", f"a person gives the points of {', '.join(by_person)}"] if by_person else []
    more += ["", f"not possible here: {', '.join(never)}"] if never else []
    return "\n".join([head, "", *lines, *more])
