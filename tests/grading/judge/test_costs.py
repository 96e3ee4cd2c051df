"""Harmful models and flagged mistakes cost points, and points are rounded to a step."""

import itertools
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from pipeline.grading.grade import Criterion, Flag
from pipeline.grading.judge.award import award
from pipeline.grading.judge.context import Judgement, Verdict
from pipeline.grading.mistakes.state_model import (
    StateMatrices,
    compare_entries,
    model_harm,
    order_names,
)
from pipeline.grading.rubric import Late, Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.tolerance import exact
from pipeline.grading.total import late_deduction, to_step
from pipeline.plant.chain import PRESETS
from pipeline.submission import ReportedStateSpace
from tests.helpers.grading_students import Student, criterion, student, typed


def model(one: Student) -> tuple[np.ndarray, np.ndarray]:
    """Return the A and B that a student would report."""
    space = one.reported.state_space
    assert space is not None
    return np.array(space.A, dtype=float), np.array(space.B, dtype=float)


def with_model(one: Student, A: np.ndarray, B: np.ndarray) -> Student:
    """Return the student with another state model, typed to three digits."""
    return one.reporting(state_space=space_of(A, B))


def space_of(A: np.ndarray, B: np.ndarray) -> ReportedStateSpace:
    """Return a reported state model with entries typed to three digits."""
    rows = tuple(tuple(typed(float(a)) if a else Decimal(0) for a in row) for row in A)
    return ReportedStateSpace(A=rows, B=tuple(typed(float(b)) if b else Decimal(0) for b in B))


# ---------------------------------------------------------------------- harmful models


@pytest.mark.parametrize("entries", [[(1, 0)], [(1, 1), (3, 3)], [(1, 2), (3, 0)], "B"])
def test_a_harmful_model_keeps_a_quarter_at_most(entries):
    """A wrong sign that makes the model unstable or reversed costs at least 75 % of the points."""
    one = student(2)
    A, B = model(one)
    if entries == "B":
        B *= -1
    else:
        A[tuple(zip(*entries, strict=True))] *= -1
    found = criterion(with_model(one, A, B).grade(), "state-model")
    assert found.points <= 0.25 * found.out_of
    said = ("unstable", "wrong way")
    assert [word in found.message for word in said].count(True) == 1


@pytest.mark.parametrize("carts", [2, 3])
def test_states_may_have_any_order(carts):
    """A right model with its states in any order earns all points; the message names the order."""
    one, rng = student(carts), np.random.default_rng(carts)
    A, B = model(one)
    orders = list(itertools.permutations(range(2 * carts)))
    some = [orders[i] for i in rng.choice(len(orders), 6, replace=False)]
    for order in [(*range(0, 2 * carts, 2), *range(1, 2 * carts, 2)), *some]:
        grade = with_model(one, A[np.ix_(order, order)], B[list(order)]).grade()
        found = criterion(grade, "state-model")
        assert found.points == found.out_of
        assert grade.flags == ()
        assert order_names(order) in found.message


def test_a_wrong_entry_in_another_order_costs_the_same():
    """A wrong sign costs the same in every order of the states."""
    one = student(2)
    A, B = model(one)
    A[1, 1] *= -1
    usual = criterion(with_model(one, A, B).grade(), "state-model")
    order = [0, 2, 1, 3]
    other = criterion(with_model(one, A[np.ix_(order, order)], B[order]).grade(), "state-model")
    assert 0 < other.points == usual.points < usual.out_of
    assert "A(3, 3)" in other.message


def test_gains_may_have_the_order_of_the_states():
    """Gains in the order of A's states earn all points; in another order than A they do not."""
    one = student(2)
    A, B = model(one)
    order = [0, 2, 1, 3]
    feedback = one.reported.feedback
    assert feedback is not None
    gains = tuple(feedback.gains[i] for i in order)
    listed = one.reporting(feedback=feedback.model_copy(update={"gains": gains}))
    grade = with_model(listed, A[np.ix_(order, order)], B[order]).grade()
    assert grade.points == one.grade().points
    assert order_names(order) in criterion(grade, "feedback").message
    assert criterion(listed.grade(), "feedback").points == 0


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_a_slightly_wrong_model_is_not_harmful(preset):
    """A state model with entries up to 10 % off is not judged as harmful, even if unstable."""
    chain, rng = PRESETS[preset], np.random.default_rng(5)
    A, B, _, _ = chain.state_space()
    right = np.hstack([A, B])
    models = [StateMatrices(right=right, slack=np.zeros_like(right))]
    grown = 0
    for _ in range(100):
        off = np.exp(rng.uniform(-0.1, 0.1, A.shape)) * A
        off[A == 1.0] = 1.0
        grown += bool(np.linalg.eigvals(off).real.max() > 0)
        space = space_of(off, B[:, 0])
        given = {"models": models, "n": chain.n, "order": tuple(range(2 * chain.n))}
        entries = compare_entries(space, **given)
        harm = model_harm(space, entries, tied=chain.is_tied, **given)
        assert harm is None
    assert bool(grown) == (chain.n == 3)


def test_gains_that_only_work_on_paper_keep_a_quarter_at_most():
    """Gains that stabilise only a wrong model keep at most a quarter of the points."""
    one = student(2)
    feedback, times = one.reported.feedback, 30
    assert feedback is not None
    heavy = {name: one.value("final", name) / times for name in ("K_1", "K_2")}
    gains = tuple(times * gain for gain in feedback.gains)
    wrong = one.reporting(final=heavy, feedback=feedback.model_copy(update={"gains": gains}))
    found = criterion(wrong.grade(), "feedback")
    assert found.points <= 0.25 * found.out_of
    assert "unstable" in found.message


@pytest.mark.parametrize(("factor", "share"), [("1", 1), ("-1", 0), ("1.5", 0)])
def test_a_prefilter_needs_the_sign_of_its_loop(factor, share):
    """`judge_prefilter` gives nothing for the right size with the wrong sign."""
    one = student(1)
    feedback = one.reported.feedback
    assert feedback is not None
    assert feedback.prefilter is not None
    other = feedback.model_copy(update={"prefilter": feedback.prefilter * Decimal(factor)})
    found = criterion(one.reporting(feedback=other).grade(), "prefilter")
    assert found.points == share * found.out_of


# -------------------------------------------------------------- the least cost of a flag


def test_a_wrong_model_costs_half_if_the_rubric_states_no_cost():
    """If the rubric states no cost, a wrong state model costs at least half of its criterion.

    In the test, one coupling is too weak.
    """
    one = student(2)
    A, B = model(one)
    A[1, 2] *= 0.5
    plain = with_model(one.under(flags={}), A, B)
    found = criterion(plain.grade(), "state-model")
    assert found.points == 0.5 * found.out_of
    assert "50 %" in found.message
    free = criterion(plain.under(flags={"wrong_state_space": 0}).grade(), "state-model")
    assert 0.5 * free.out_of < free.points < free.out_of


def test_a_flag_costs_only_the_criteria_of_its_numbers():
    """A flag costs points only in the criteria that judge the flagged numbers."""
    one = student(2)
    hertz = {
        name: one.value("final", name) / (2 * np.pi)
        for name in one.reported.final
        if name.startswith("omega")
    }
    costs = {"hz_for_rad_s": 1.0, "final_off": 1.0}
    grade = one.reporting(final=hertz).under(flags=costs).grade()
    assert {flag.code for flag in grade.flags} == {"hz_for_rad_s"}
    for id_, kept in (("final-frequencies", 0), ("final-gains", 1), ("initial-decays", 1)):
        found = criterion(grade, id_)
        assert found.points == kept * found.out_of, id_


def test_the_larger_cost_of_two_flags_counts():
    """If two flags concern one criterion, the larger cost counts, not the sum."""
    one = student(2)
    off = {"omega_1": one.value("final", "omega_1") / (2 * np.pi)}
    off |= {"omega_b": one.value("final", "omega_b") * 1.35}
    costs = {"hz_for_rad_s": 0.25, "final_off": 0.75, "physically_impossible": 0.5}
    grade = one.reporting(final=off).under(flags=costs).grade()
    worst = max(costs[flag.code] for flag in grade.flags if flag.code in costs)
    assert len(grade.flags) > 1
    assert criterion(grade, "final-frequencies").points == (1 - worst) * 2


# ------------------------------------------------------------- rounding to a step


@pytest.mark.parametrize("step", [0.01, 0.1, 0.25, 0.5, 1.0])
def test_points_are_multiples_of_the_step(step):
    """Points of each criterion and in total are multiples of the rubric's step."""
    one = student(2).under(step=step)
    off = {name: one.value("final", name) * 1.11 for name in one.reported.final}
    grade = one.reporting(final=off).grade(days_late=1.5)
    for points in (grade.points, grade.deducted, *(c.points for c in grade.criteria)):
        assert exact(points) % exact(step) == 0
    for c in grade.criteria:
        whole, none = c.points == c.out_of, c.points == 0
        assert c.outcome in (("pass",) if whole else ("fail", "skip") if none else ("partial",))


def test_half_a_step_is_rounded_in_the_students_favour():
    """Half a step is rounded in the student's favour, in points and in the late deduction."""
    assert to_step(Fraction("1.75"), 0.5) == 2
    late = Late(percent_per_day=10.0)
    assert late_deduction(Fraction("17.5"), late=late, step=0.5, days_late=1.0) == Fraction("1.5")
    assert late_deduction(Fraction("17.5"), late=late, step=0.01, days_late=1.0) == Fraction("1.75")


# -------------------------------------------------------------------- tables of awards


def awarded(
    checks: list[dict],
    shares: list[str | None],
    *,
    flags: tuple[Flag, ...] = (),
    costs: Mapping[str, object] = MappingProxyType({}),
) -> tuple[Criterion, ...]:
    """Return what `award` gives for criteria of two points each, with these shares."""
    plain = load_rubric(Path("throne-2dof")).model_dump(mode="json") | {
        "step": 0.5,
        "flags": dict(costs),
    }
    asked = [{"id": f"c{i}", "points": 2, **check} for i, check in enumerate(checks)]
    rubric = Rubric.model_validate(plain | {"criteria": asked})
    judgements = {
        one.id: Judgement.plain(
            Verdict(share=None if share is None else Fraction(share), message="")
        )
        for one, share in zip(rubric.criteria, shares, strict=True)
    }
    return award(rubric.criteria, judgements, flags, rubric=rubric)


@pytest.mark.parametrize(
    ("check", "share", "outcome", "points"),
    [
        ("laws", "1", "pass", 2.0),
        ("laws", "0.99", "pass", 2.0),
        ("laws", "0.874", "partial", 1.5),
        ("laws", "0.125", "partial", 0.5),
        ("laws", "0.124", "fail", 0.0),
        ("laws", None, "skip", 0.0),
        ("required", "1", "pass", 2.0),
        ("required", "0.99", "partial", 1.5),
    ],
)
def test_the_award_of_each_share(check, share, outcome, points):
    """Points are rounded to the step, and a missing required item is never rounded away."""
    (found,) = awarded([{"check": check}], [share])
    assert (found.outcome, found.points) == (outcome, points)


@pytest.mark.parametrize(
    ("first", "outcome"), [("1", "pass"), ("0.5", "pass"), ("0", "skip"), (None, "skip")]
)
def test_an_award_waits_for_the_criteria_it_requires(first, outcome):
    """A criterion is judged if the one that it requires earned points, not if it was skipped."""
    _, second = awarded([{"check": "laws"}, {"check": "laws", "requires": ["c0"]}], [first, "1"])
    assert second.outcome == outcome


@pytest.mark.parametrize(
    ("most", "points"),
    [((1.0, 1.0), 0.0), ((0.25, 0.75), 0.5), ((0.75, 0.25), 0.5), ((0.25, 0.5), 1.0)],
)
def test_the_flag_that_may_cost_most_limits_the_loss(most, points):
    """If no mistake can be undone, the award is limited by the largest `most` of its flags."""
    codes = ("final_off", "physically_impossible")
    flags = tuple(
        Flag(code=code, parameters=("omega_1",), message="", evidence={"table": "final"})
        for code in codes
    )
    costs = {code: {"least": 0.0, "most": one} for code, one in zip(codes, most, strict=True)}
    (found,) = awarded([{"check": "final"}], ["0"], flags=flags, costs=costs)
    assert found.points == points


@pytest.mark.parametrize(
    ("days", "points"),
    [(0.0, 0), (0.5, 0), (0.51, 1), (1.5, 1), (1.51, 2), (3.5, 3), (5.51, 5), (20.0, 5)],
)
def test_each_day_begun_after_the_grace_costs_its_share(days, points):
    """The late deduction grows with each day begun after the grace, up to the largest one."""
    late = Late(percent_per_day=10.0, grace_days=0.5, most_percent=50.0)
    assert late_deduction(Fraction(10), late=late, step=0.25, days_late=days) == points
