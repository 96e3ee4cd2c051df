"""With `from`, the rubric says whether the student's own numbers or the recordings judge."""

from dataclasses import replace
from decimal import Decimal

import pytest

from pipeline.errors import ConfigError
from pipeline.grading.judge.award import needs_recordings
from pipeline.grading.mistakes.state_model import own_chain
from pipeline.grading.rubric import Rubric, source_of
from pipeline.grading.rubric_file import load_rubric, parse_rubric
from pipeline.grading.rubric_text import rubric_text
from pipeline.names import derived_names
from pipeline.resources import RUBRICS
from pipeline.submission import ReportedStateSpace
from tests.helpers.grading_students import Student, criterion, student

SHIPPED = sorted(RUBRICS.glob("*.toml"))


def judged_from(rubric: Rubric, source: str, *checks: str) -> Rubric:
    """Return the rubric with one source for the criteria of some checks."""
    criteria = tuple(
        one.model_copy(update={"from": source}) if one.check in checks else one
        for one in rubric.criteria
    )
    return rubric.model_copy(update={"criteria": criteria})


def under(team: Student, rubric: Rubric) -> Student:
    return replace(team, rubric=rubric)


@pytest.fixture(scope="module")
def astray():
    """An honest team, and one with the table and the A and B of other, slower carts."""
    honest = student(2)
    table = honest.reported.final
    slower = {name: float(v) * (0.8 if name[0] == "o" else 1) for name, v in table.items()}
    chain = own_chain(slower, n=2)
    assert chain is not None
    A, B, _, _ = chain.state_space()
    rows = tuple(tuple(Decimal(f"{a:.5g}") for a in row) for row in A)
    space = ReportedStateSpace(A=rows, B=tuple(Decimal(f"{b:.5g}") for b in B[:, 0]))
    return honest, honest.reporting(final=slower, state_space=space)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_rubrics_take_the_better_model(path):
    """The default is that of the time before this key, for each check."""
    usual = {"state_space": "either", "gains": "either", "claims": "either", "prefilter": "either"}
    rubric = load_rubric(path)
    assert all(source_of(one) == usual.get(one.check, "recordings") for one in rubric.criteria)


def test_the_source_decides_what_follows(astray):
    """A and B that follow from an own wrong table are wrong only by the recordings."""
    _, wrong = astray
    points = {
        source: criterion(
            under(wrong, judged_from(wrong.rubric, source, "state_space")).grade(), "state-model"
        ).points
        for source in ("own", "recordings", "either")
    }
    assert points["own"] == points["either"] == 2
    assert points["recordings"] <= 1


def test_an_honest_team_keeps_its_points_by_either_source(astray):
    """What an honest team reports follows from its own table and from its recordings."""
    honest, _ = astray
    checks = ("state_space", "gains", "claims", "prefilter")
    for source in ("own", "recordings"):
        grade = under(honest, judged_from(honest.rubric, source, *checks)).grade()
        assert grade.points == honest.grade().points


def test_a_number_of_the_table_must_follow_from_the_others(astray):
    """A frequency of one cart alone follows from the rest of the table, also from a wrong one."""
    honest, wrong = astray
    rubric = judged_from(honest.rubric, "own", "final")
    own = [one for one in rubric.criteria if one.check == "final"][:1]
    only = own[0].model_copy(update={"parameters": ("omega_1",), "requires": ()})
    rubric = rubric.model_copy(update={"criteria": (only,)})
    by_recordings = judged_from(rubric, "recordings", "final")
    assert under(honest, rubric).grade().points == only.points
    assert under(wrong, rubric).grade().points == only.points
    assert under(wrong, by_recordings).grade().points < only.points
    slipped = honest.reporting(final={"omega_1": 1.3 * honest.value("final", "omega_1")})
    assert under(slipped, rubric).grade().points == 0


def test_derived_names():
    """Only tables of two and three carts have numbers that follow from others."""
    assert derived_names(1) == derived_names(4) == []
    assert derived_names(2) == ["omega_1", "zeta_1"]


def test_a_wrong_source_is_refused_with_its_line():
    """A number that nothing else gives cannot be judged from own numbers."""
    text = (RUBRICS / "throne-2dof.toml").read_text("utf-8")
    own = text.replace('parameters = ["omega_*"]', 'parameters = ["omega_1"]\nfrom = "own"', 1)
    rubric = parse_rubric(own, where="rubric")
    assert "own" in {source_of(one) for one in rubric.criteria}
    assert "own numbers only" in rubric_text(rubric)
    assert "own numbers only" not in rubric_text(parse_rubric(text, where="rubric"))
    for wrong in (own.replace('["omega_1"]', '["omega_a"]'), own.replace('"own"', '"mine"')):
        with pytest.raises(ConfigError, match="line"):
            parse_rubric(wrong, where="rubric")


def test_another_source_needs_the_recordings_again():
    """Stored errors are those of one source, and stored rubrics keep it."""
    before = load_rubric(RUBRICS / "throne-2dof.toml")
    now = judged_from(before, "own", "prefilter")
    assert needs_recordings(before, now) == ["criteria.prefilter.from"]
    assert Rubric.model_validate_json(now.model_dump_json()) == now
