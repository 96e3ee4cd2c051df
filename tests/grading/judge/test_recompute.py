"""Points from stored findings under another rubric equal those of a new grading."""

from dataclasses import replace
from decimal import Decimal
from functools import cache

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.grading.judge.award import (
    findings_text,
    needs_recordings,
    read_findings,
    recompute_points,
)
from pipeline.grading.judge.run import Graded
from pipeline.grading.rubric import Rubric
from tests.helpers.grading_students import Student, student


@cache
def _erring(carts: int) -> Student:
    """Return a team with some right numbers, some slightly wrong and some badly wrong."""
    honest = student(carts)
    names = honest.rubric.names
    off = {name: honest.value("final", name) * (1 + 0.03 * i) for i, name in enumerate(names)}
    off["K" if carts == 1 else "K_1"] *= 2.0
    space = honest.reported.state_space
    assert space is not None
    rows = [list(row) for row in space.A]
    rows[1][0] *= Decimal("1.12")
    loop = honest.reported.feedback
    assert loop is not None
    claimed = loop.model_copy(update={"overshoot_percent": Decimal("14"), "prefilter": None})
    return honest.reporting(
        final=off,
        state_space=space.model_copy(update={"A": tuple(map(tuple, rows))}),
        feedback=claimed,
    )


@cache
def _graded(carts: int) -> Graded:
    return _erring(carts).graded(days_late=1.3)


@st.composite
def _changes(draw, rubric: Rubric) -> Rubric:
    """Return the rubric with other points, tolerances, costs, lateness and step."""
    step = draw(st.sampled_from([0.01, 0.25, 0.5, 1.0]))
    plain = rubric.model_dump(mode="json") | {"step": step}
    for criterion in plain["criteria"]:
        criterion["points"] = step * draw(st.integers(1, 12))
        for full in [key for key in criterion if "full" in key]:
            none = full.replace("full", "none")
            low, high = sorted(draw(st.tuples(st.integers(0, 60), st.integers(0, 200))))
            criterion[full], criterion[none] = low, high
        if draw(st.booleans()):
            criterion["requires"] = []
    for code in draw(st.sets(st.sampled_from(sorted(plain["flags"])), max_size=4)):
        plain["flags"][code] = draw(st.sampled_from([0.0, 0.1, 0.5, 1.0]))
    plain["late"] |= {
        "percent_per_day": draw(st.integers(0, 60)),
        "grace_days": draw(st.sampled_from([0, 0.5, 2])),
        "most_percent": draw(st.integers(0, 100)),
    }
    return Rubric.model_validate(plain)


@pytest.mark.parametrize(
    "carts", [1, pytest.param(2, marks=[pytest.mark.slow, pytest.mark.sample])]
)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_reweighed_points_are_those_of_grading_again(carts, data):
    """Under any changed rubric, points from stored findings equal those of a new grading."""
    team, before = _erring(carts), _graded(carts)
    now = data.draw(_changes(team.rubric))
    kept = read_findings(findings_text(before.judgements))

    weighed = recompute_points(before.grade, kept, rubric=now)

    again = replace(team, rubric=now).grade(days_late=1.3)
    now_and_then = [
        [(g.points, g.deducted, g.out_of)]
        + [(c.id, c.outcome, c.points, c.out_of) for c in g.criteria]
        for g in (weighed, again)
    ]
    assert now_and_then[0] == now_and_then[1]
    assert needs_recordings(team.rubric, now) == []


def test_the_same_rubric_gives_the_same_points():
    """Points computed from stored findings equal those of the grading that stored the findings."""
    team, before = _erring(2), _graded(2)
    weighed = recompute_points(before.grade, before.judgements, rubric=team.rubric)
    assert weighed.points == before.grade.points
    assert {c.outcome for c in weighed.criteria} == {"pass", "partial", "fail"}


def test_a_changed_key_that_needs_recordings_is_named():
    """If a changed key of the rubric needs the recordings, the result names the key."""
    rubric = student(2).rubric
    plain = rubric.model_dump(mode="json")
    plain["required"]["final"] = ["K_*"]
    plain["late"]["due"] = "2026-11-20T23:59:00-08:00"
    laws = next(c for c in plain["criteria"] if c["check"] == "laws")
    laws["frequency_percent"] = 4.0
    gains = next(c for c in plain["criteria"] if c["id"] == "final-gains")
    gains["sigmas"] = 2.0
    gains["points"] = 1.0
    plain["criteria"][0]["id"] = "another"
    plain["criteria"] = [c | {"requires": []} for c in plain["criteria"]]
    assert needs_recordings(rubric, Rubric.model_validate(plain)) == [
        "required",
        "late.due",
        "criteria.another",
        "criteria.final-gains.sigmas",
        "criteria.laws.frequency_percent",
    ]
