"""A missing experiment costs points, and what rests on the main experiment is not judged."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.rubric_file import load_rubric, parse_rubric
from pipeline.resources import RUBRICS
from pipeline.simulated.submission import write_submission
from pipeline.submission import Experiment, load_submission
from tests.helpers.grading_students import Student, criterion, student

# The shipped rubrics with dwells as the main experiment, and what rests on the dwells in each.
FROM_DWELLS = ("final-", "comparison", "laws", "state-model")


def keeping(one: Student, keep: Callable[[Experiment], bool]) -> Student:
    """Return a student who handed in only some recordings; the analysis stays the same."""
    left = tuple(e for e in one.submission.experiments if keep(e))
    return replace(one, submission=one.submission.model_copy(update={"experiments": left}))


def with_dwells(one: Student, number: int) -> Student:
    """Return a student with the first few dwells and all other recordings."""
    dwells = [e.id for e in one.submission.experiments if e.kind == "sine"][:number]
    return keeping(one, lambda e: e.kind != "sine" or e.id in dwells)


PIECES = [{"id": "pieces", "check": "required", "points": 1}]


@pytest.mark.parametrize("step", [0.01, 0.25, 0.5, 1.0])
@pytest.mark.parametrize("dwells", [0, 1, 11])
def test_nothing_required_is_missing_from_a_criterion_that_passes(step, dwells):
    """Rounding to a step never turns a missing item into a pass; with all items it is one."""
    one = with_dwells(student(2), dwells).under(criteria=PIECES, step=step)
    assert criterion(one.grade(), "pieces").outcome in ("partial", "fail")
    whole = with_dwells(student(2), 12).under(criteria=PIECES, step=step)
    assert criterion(whole.grade(), "pieces").outcome == "pass"


def test_the_message_counts_what_is_there():
    """The message and the flag say "11 of 12 sine dwells", and name what is missing altogether."""
    less = keeping(with_dwells(student(2), 11), lambda e: e.kind != "closed_loop")
    grade = less.without("final", "K_1").under(criteria=PIECES).grade()
    (flag,) = grade.flags
    for said in (criterion(grade, "pieces").message, flag.message):
        assert [part in said for part in ("11 of 12", "closed-loop", "final.K_1")] == [True] * 3
    assert flag.parameters == ("12 sine", "closed_loop", "final.K_1")


def test_recordings_and_typed_numbers_are_weighed_apart():
    """All numbers without a recording earn half, and so do all recordings without a number."""
    one = student(2).under(criteria=PIECES, step=0.01)
    silent = replace(one, submission=one.submission.model_copy(update={"reported": None}))
    assert criterion(keeping(one, lambda e: False).grade(), "pieces").points == 0.5
    assert criterion(silent.grade(), "pieces").points == 0.5
    # One of five kinds of recording is missing, and no number: a tenth of all.
    assert criterion(with_dwells(one, 0).grade(), "pieces").points == 0.9


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_without_dwells_nothing_that_rests_on_them_is_judged(carts):
    """Under a shipped rubric, a lab without dwells earns nothing for its final numbers.

    Half of all points, and all of those for recordings and first estimates, are left.
    """
    whole, less = student(carts).grade(), with_dwells(student(carts), 0).grade()
    assert whole.points == whole.out_of == 20
    assert criterion(less, "dwells").outcome == "fail"
    resting = [c for c in less.criteria if c.id.startswith(FROM_DWELLS)]
    assert all((c.outcome, c.points) == ("skip", 0) for c in resting)
    assert all("'dwells'" in c.message for c in resting)
    assert less.points <= 10
    lost = {c.id for c in less.criteria if c.points < c.out_of}
    assert lost == {c.id for c in resting} | {"dwells"}
    (flag,) = less.flags
    assert flag.evidence["criteria"] == ["dwells"]


def test_one_missing_dwell_costs_one_step_only():
    """A lab with 11 of 12 dwells loses a quarter of a point."""
    assert with_dwells(student(2), 11).grade().points == 19.75


def test_other_recordings_may_replace_dwells_if_the_rubric_requires_none(tmp_path):
    """Under a rubric without dwells, steps and decays alone are graded in full."""
    write_submission(tmp_path, "throne-1dof", seed=3, compact=True, reported=True)
    submission, rubric = load_submission(tmp_path), load_rubric(Path("throne-1dof"))
    others = tuple(e for e in submission.experiments if e.kind != "sine")
    submission = submission.model_copy(update={"experiments": others})
    required = tuple(r for r in rubric.required.experiments if r.kind != "sine")
    criteria = tuple(
        c.model_copy(update={"requires": tuple(p for p in c.requires if p != "dwells")})
        for c in rubric.criteria
        if c.id != "dwells"
    )
    needed = rubric.required.model_copy(update={"experiments": required})
    rubric = rubric.model_copy(update={"required": needed, "criteria": criteria})
    grade = grade_submission(submission, rubric=rubric, name="team-07").grade
    assert (grade.points, grade.out_of, grade.flags) == (19.5, 19.5, ())


def test_a_criterion_may_only_name_kinds_that_are_required():
    """A kind that no `[[required.experiments]]` has is a mistake, with the nearest that has."""
    text = (RUBRICS / "throne-2dof.toml").read_text("utf-8")
    with pytest.raises(ConfigError, match=r"\.experiments \(dwells\): .*\[\[required\.experim"):
        parse_rubric(text.replace('experiments = ["sine"]', 'experiments = ["sweep"]'), where="r")
