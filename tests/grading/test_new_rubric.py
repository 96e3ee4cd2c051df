"""A rubric from a reference asks for what its recordings decide; simulated students show it."""

import json
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import new_rubric as benchmark
from pipeline.errors import ConfigError
from pipeline.grading.new_rubric import STEP, NewRubric, new_rubric, share_points
from pipeline.grading.rubric import Parameters
from pipeline.grading.rubric_file import load_rubric, parse_rubric
from pipeline.grading.simulated_class import MISTAKES, simulate_class
from pipeline.results import Analysis
from pipeline.simulated.submission import write_submission
from pipeline.submission import Reported, ReportedFeedback, Submission, load_submission
from pipeline.workflow import analyse
from tests.helpers.commandline import cartlab_here
from tests.helpers.grading_students import Student, student

HEADINGS = {"time": "t / s", "input": "current (A)", "x1": "carriage (mm)"}
OWN = (
    "version = 1",
    "[system]",
    "carts = 1",
    "springs = [true, false]",
    'input = { unit = "A" }',
    'position = { unit = "mm" }',
    'columns = { time = "t / s", input = "current (A)", x1 = "carriage (mm)" }',
)


def written(of: Student, *, analysis: Analysis | None = None, **changed: object) -> NewRubric:
    """Return the rubric that is written from a student's submission."""
    submission = of.submission.model_copy(update=changed)
    return new_rubric(submission, analysis or of.analysis, source="ours")


def with_std(analysis: Analysis, name: str, share: float) -> Analysis:
    """Return an analysis in which the fit gives a number with another standard error."""

    def changed(row):
        if row.name != name:
            return row
        return replace(row, final=replace(row.final, std=share * row.final.value))

    return replace(analysis, rows=tuple(map(changed, analysis.rows)))


def own_lab(folder: Path, *kinds: str) -> Submission:
    """Write a lab of one cart, in mm and A and with its own headings, and load it."""
    write_submission(folder / "bench", "throne-1dof", seed=4, compact=True)
    text = "\n".join([*OWN, ""])
    for file in sorted((folder / "bench" / "data").glob("*.csv")):
        kind = file.stem.split("-")[0]
        if kind in kinds:
            table = pd.read_csv(file)[list(HEADINGS)] * [1, 2, 10]
            table.columns = list(HEADINGS.values())
            table.to_csv(folder / file.name, sep=";", decimal=",", index=False)
            text += f'[[experiments]]\nid = "{file.stem}"\nkind = "{kind}"\nfile = "{file.name}"\n'
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    return load_submission(folder)


@given(
    weights=st.lists(st.sampled_from([0.5, 1.0, 1.5, 2.0, 2.5]), min_size=1, max_size=40),
)
def test_points_sum_to_twenty_in_proportion(weights):
    points = share_points(weights, out_of=20, step=STEP)
    assert sum(points) == 20
    for weight, own in zip(weights, points, strict=True):
        assert own >= STEP
        assert own % STEP == 0
        if min(weights) * 20 / sum(weights) >= STEP:
            assert abs(own - weight * 20 / sum(weights)) < STEP


@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_presets_rubric_has_the_criteria_and_points_of_the_shipped_one(carts):
    new, shipped = written(student(carts), reported=None), load_rubric(Path(f"throne-{carts}dof"))
    assert new.undecided == ()
    assert [(c.id, c.points, c.requires) for c in new.rubric.criteria] == [
        (c.id, c.points, c.requires) for c in shipped.criteria
    ]
    for own, usual in zip(new.rubric.criteria, shipped.criteria, strict=True):
        limits = [key for key in type(own).model_fields if key.endswith("_percent")]
        assert all(getattr(own, key) >= getattr(usual, key) for key in limits)
    assert new.rubric.required.initial == new.rubric.required.final == ("*",)
    assert parse_rubric(new.text, where="x").out_of == 20


@pytest.mark.parametrize(
    ("share", "full", "none"), [(0.001, 5, 20), (0.017, 10, 40), (0.05, 15, 60), (0.2, None, None)]
)
def test_tolerances_follow_the_standard_errors(share, full, none):
    """Three standard errors cost no points; a number that is too uncertain is not asked for."""
    base = student(2)
    new = written(base, analysis=with_std(base.analysis, "K_2", share), reported=None)
    gains = new.rubric.criterion("final-gains")
    assert isinstance(gains, Parameters)
    if full is None:
        assert gains.parameters == ("K_1",)
        assert "K_2" not in new.rubric.required.final
        assert "final K_2" in " ".join(new.undecided)
        assert new.rubric.criterion("laws") is None  # they need the whole table
    else:
        assert (gains.full_percent, gains.none_percent) == (full, none)
    assert new.rubric.out_of == 20


def test_a_rubric_asks_for_what_the_reference_reports():
    reported = Reported(initial={"K_1": Decimal(1)}, final={"K_1": Decimal(1), "K_2": Decimal(1)})
    rubric = written(student(2), reported=reported).rubric
    assert rubric.required.initial == ("K_1",)
    assert rubric.required.final == ("K_*",)
    assert not rubric.required.state_space
    assert not rubric.required.feedback
    assert {c.check for c in rubric.criteria} == {
        *("required", "data", "initial", "final", "initial_final", "hardware"),
    }
    assert rubric.out_of == 20


@pytest.mark.parametrize(
    ("fields", "criteria"),
    [
        ({"gains": (Decimal(1), Decimal(2))}, {"feedback"}),
        ({"gains": (Decimal(1), Decimal(2)), "prefilter": Decimal(1)}, {"feedback", "prefilter"}),
        ({"overshoot_percent": Decimal(1)}, {"feedback-claims"}),
    ],
)
def test_a_rubric_asks_for_the_controller_that_the_reference_reports(fields, criteria):
    base = student(1)
    reported = base.reported.model_copy(update={"feedback": ReportedFeedback(**fields)})
    rubric = written(base, reported=reported).rubric
    assert set(rubric.required.feedback) == set(fields)
    of_loop = {c.id for c in rubric.criteria if c.check in ("gains", "claims", "prefilter")}
    assert of_loop == criteria
    without = written(base, reported=reported, design=None)
    assert not without.rubric.required.feedback
    assert "[design]" in " ".join(without.undecided)


def test_a_person_grades_what_a_linear_chain_leaves_out():
    base = student(1)
    assert base.analysis.fit is not None
    fit = replace(base.analysis.fit, chi_square_per_dof=50.0)
    assert written(base).rubric.criterion("gap") is None
    gap = written(base, analysis=replace(base.analysis, fit=fit)).rubric.criterion("gap")
    assert gap is not None
    assert gap.check == "manual"


def test_recordings_that_decide_nothing_are_refused():
    base = student(1)
    rows = tuple(replace(row, initial=None, final=None) for row in base.analysis.rows)
    with pytest.raises(ConfigError):
        written(base, analysis=replace(base.analysis, rows=rows))


@pytest.mark.parametrize(
    ("kinds", "criteria"),
    [
        (
            ("sweep",),
            "pieces sweeps data final-gains final-frequencies final-dampings state-model",
        ),
        (("decay",), "pieces data initial-decays"),
    ],
)
def test_another_lab_is_asked_for_what_it_can_decide(kinds, criteria, tmp_path):
    """A lab in mm and A with its own headings gets a rubric, and its honest students all points."""
    submission = own_lab(tmp_path, *kinds)
    new = new_rubric(submission, analyse(submission, design=False), source="ours")
    assert [c.id for c in new.rubric.criteria] == criteria.split()
    assert new.rubric.out_of == 20
    assert new.rubric.system.columns == HEADINGS
    assert (new.rubric.system.position.unit, new.rubric.system.input.unit) == ("mm", "A")
    assert {one.kind for one in new.rubric.required.experiments} == set(kinds)
    found = simulate_class(submission, rubric=new.rubric, honest=3)
    assert [grade.points for grade in found.honest] == [20, 20, 20]
    assert {"wrong_gains", "carts_swapped"} <= set(found.impossible)
    assert all(grade.points < 20 for grade in found.mistakes.values())


# ---------------------------------------------------------------------- simulated students


@pytest.mark.slow
@pytest.mark.parametrize("carts", [1, 2, 3])
def test_simulated_students_lose_points_only_for_mistakes(carts, tmp_path):
    """Every mistake that is possible is named and costs points; honest students keep all."""
    write_submission(tmp_path, f"throne-{carts}dof", seed=8, compact=True)
    submission = load_submission(tmp_path)
    new = new_rubric(submission, analyse(submission, design=False), source="ours")
    found = simulate_class(submission, rubric=new.rubric)
    assert {grade.points for grade in found.honest} == {20}
    assert len(found.honest) == 20
    assert {*found.mistakes, *found.impossible} == set(MISTAKES)
    assert set(found.impossible) == ({"carts_swapped"} if carts == 1 else set())
    for code, grade in found.mistakes.items():
        if code != "no_fit_done" or carts > 1:  # one cart's tables may be equal by chance
            assert code in grade.codes
            assert grade.points < 20


def test_the_commands_write_and_show_a_rubric(tmp_path):
    own_lab(tmp_path / "lab", "sweep")
    rubric = tmp_path / "mine.toml"
    new = ("new-rubric", "--from", tmp_path / "lab", "--out", rubric)
    assert cartlab_here(*new).returncode == 0
    text = rubric.read_text(encoding="utf-8")
    assert cartlab_here(*new).returncode == 2  # an existing file is not replaced
    assert rubric.read_text(encoding="utf-8") == text

    plain = cartlab_here("check-rubric", rubric)
    shown = cartlab_here("check-rubric", rubric, "--from", tmp_path / "lab")
    assert plain.returncode == shown.returncode == 0
    assert shown.stdout.startswith(plain.stdout)
    assert len(shown.stdout) > len(plain.stdout)

    found = json.loads(cartlab_here("check-rubric", rubric, "--json").stdout)
    assert "simulated" not in found
    shown = cartlab_here("check-rubric", rubric, "--json", "--from", tmp_path / "lab")
    simulated = json.loads(shown.stdout)["simulated"]
    assert len(simulated["honest"]) == 20
    assert simulated["mistakes"]["hz_for_rad_s"]["flags"] == ["hz_for_rad_s"]
    assert simulated["mistakes"]["hz_for_rad_s"]["lost"]
    assert "carts_swapped" in simulated["impossible"]


@pytest.mark.slow
@pytest.mark.parametrize("carts", [1, 2, 3])
def test_a_new_rubric_gives_the_points_of_the_shipped_one(carts):
    """Teams of the study get the same points of 20 under both rubrics, within half a point."""
    rubric = benchmark.written(f"throne-{carts}dof")
    seeds = range(980_000 + (carts - 1 - 980_000) % 3, 980_009, 3)
    points = benchmark.compare(rubric, seeds=seeds, slips=3)
    assert len(points) > 5
    assert all(map(benchmark.is_close, points))
