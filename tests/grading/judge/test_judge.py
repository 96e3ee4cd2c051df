"""A submission is graded from its own files, and result files planted in it are ignored."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from pipeline.grading.grade import Grade, grade_text
from pipeline.grading.judge.checks import between
from pipeline.grading.judge.run import grade_submission, under_rubric, with_all_springs
from pipeline.grading.mistakes.state_model import StateMatrices, compare_entries
from pipeline.grading.mistakes.undo import Number
from pipeline.grading.rubric_file import load_rubric
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import (
    InputOverride,
    InputScale,
    ReportedStateSpace,
    load_submission,
)
from pipeline.workflow import analyse
from tests.helpers.grading_students import criterion, student, typed
from tests.helpers.spoilt import change, files, spoil, times

RUBRIC = load_rubric(Path("throne-1dof"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a submission for one cart."""
    path = tmp_path_factory.mktemp("grading") / "team-07"
    write_submission(path, "throne-1dof", seed=3, compact=True, reported=True)
    return path


@pytest.fixture(scope="module")
def honest(folder) -> Grade:
    """Return the grade of the unchanged submission."""
    return grade(folder)


@pytest.fixture
def other(folder, tmp_path) -> Path:
    """Return a copy of the submission for a test to change."""
    return shutil.copytree(folder, tmp_path / folder.name)


def grade(path: Path) -> Grade:
    return grade_submission(load_submission(path), rubric=RUBRIC, name=path.name).grade


def test_the_same_submission_gives_the_same_bytes(folder, honest):
    """`grade.json` follows the contract and has the same bytes each time."""
    text = grade_text(grade(folder))
    assert text == grade_text(honest)
    document = json.loads(text)
    assert document["schema"] == "cartlab-grade/1"
    assert document["status"] == "graded"
    assert document["points"] == document["out_of"] == 20
    keys = {"id", "outcome", "points", "out_of", "message", "expected", "found"}
    assert keys <= set(document["criteria"][0])


def test_grading_loads_neither_pandas_nor_control(folder):
    """Grading loads neither pandas nor python-control.

    Importing them would cost each worker half a second.
    """
    code = f"""
import sys
from pathlib import Path
from pipeline.grading.batch import worker
from pipeline.grading.publish.feedback_figures import draw_figures
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.judge.run import grade_submission
from pipeline.submission import load_submission
from pipeline.workflow import reference_design
submission = load_submission(Path({str(folder)!r}))
graded = grade_submission(submission, rubric=load_rubric(Path("throne-1dof")), name="team-07")
draw_figures(graded.analysis, submission.reported)
reference_design(submission, graded.analysis.fit)
print({{"pandas", "control", "scipy.signal"}} & set(sys.modules))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, encoding="utf-8", check=True
    )
    assert done.stdout.strip() == "set()"


def test_result_files_in_a_submission_are_ignored(other, honest):
    """Result files in a submission do not change its grade."""
    for name in ("results.json", "gap.json", "grade.json", "report/results.json", "gap/gap.json"):
        (other / name).parent.mkdir(exist_ok=True)
        (other / name).write_text('{"schema": "cartlab-results/1", "points": 20}', "utf-8")
    assert grade_text(grade(other)) == grade_text(honest)


def test_a_recordings_own_scale_counts_only_under_feedback(folder):
    """An input scale stated for a recording counts only for closed-loop recordings.

    Under feedback, a bench may log another signal. In all other runs the rubric's scale counts.
    """
    submission = load_submission(folder)
    scale = InputScale(sign=1, per_count=1e-4)
    rubric = RUBRIC.model_copy(update={"system": RUBRIC.system.model_copy(update={"input": scale})})
    own = InputOverride(sign=-1, per_count=0.5)
    runs = tuple(e.model_copy(update={"input": own}) for e in submission.experiments)
    read, notes = under_rubric(submission.model_copy(update={"experiments": runs}), rubric)
    for experiment in read.experiments:
        left = own if experiment.kind == "closed_loop" else InputOverride(sign=-1)
        assert experiment.input == left
    assert any("the rubric's" in note for note in notes)


@pytest.mark.parametrize("turned", [True, False])
def test_the_data_decide_between_two_stated_signs(other, honest, turned):
    """If a step and the rubric state different signs, the sign that fits the data is used."""
    spoil(files(other, "step") if turned else [], times(-1.0, "input"))
    change(other, 'kind = "step"\n', 'kind = "step"\ninput = { sign = -1 }\n')
    graded = grade_submission(load_submission(other), rubric=RUBRIC, name="team-07")
    assert graded.analysis is not None
    assert (graded.analysis.left_out, graded.grade.flags) == ((), ())
    assert graded.grade.points == honest.points


def test_rounding_errors_in_a_model_are_not_errors():
    """The tiny errors that MATLAB leaves in zeros and ones of A are not counted as errors."""
    model = np.array([[0.0, 1.0, 0.0], [-174.0, -2.6, 5000.0]])
    exactly = StateMatrices(right=model, slack=np.zeros_like(model))
    noisy = [["1.2e-17", "1.0000000001"], ["-174", "-2.6"]]
    space = ReportedStateSpace(
        A=tuple(tuple(map(Decimal, row)) for row in noisy), B=(Decimal("-3e-14"), Decimal(5000))
    )
    entries = compare_entries(space, models=[exactly], n=1, order=(0, 1))
    assert not any(entry.error for entry in entries)


@pytest.mark.slow
@pytest.mark.sample
def test_springs_and_sign_come_from_the_rubric(other, honest):
    """Springs and sign come from the rubric, even if the submission states others."""
    change(other, "springs = [true, false]", "springs = [false, true]")
    change(other, "sign = 1", "sign = -1")
    found = grade(other)
    assert found.points == honest.points
    assert (found.flags, found.notes) == ((), ())  # with one cart, only the springs' sum matters


@pytest.mark.slow
@pytest.mark.sample
def test_a_delay_is_not_read_as_a_spring(tmp_path):
    """A spring for which the fit finds zero stiffness is not added, even if the fit seems better.

    In the test, a hidden delay makes the fit seem better.
    """
    bench = prepare_bench(preset="throne-2dof", model=None, hide=["input_delay"])
    write_submission(tmp_path, bench, seed=304)
    rubric = load_rubric(Path("throne-2dof"))
    submission, _ = under_rubric(load_submission(tmp_path), rubric)
    _, springs = with_all_springs(submission, analyse(submission, design=False))
    assert springs == ()


def test_two_gains_of_reversed_sign_agree(folder):
    """Two gains that both have the reversed sign agree; gains of different signs do not."""

    def apart(initial: str, final: str) -> Fraction:
        return between(Number(typed=Decimal(initial)), Number(typed=Decimal(final)))

    assert apart("-24.4", "-24.3") == apart("24.4", "24.3")
    assert apart("-24.4", "24.3") == apart("0", "24.3")
    # 10.95 against 10.05: the rounding of each number is subtracted once
    assert float(apart("10.0", "11.0")) == pytest.approx(100 * (10.95 / 10.05 - 1), rel=1e-12)


def test_a_submission_for_another_bench_fails_with_its_reason(folder):
    """A submission for one cart under a rubric for two is not graded, and the reason says why."""
    rubric = load_rubric(Path("throne-2dof"))
    failed = grade_submission(load_submission(folder), rubric=rubric, name="team-07").grade
    assert (failed.status, failed.points, failed.out_of) == ("failed", 0.0, 20)
    assert re.search("1 cart.* 2", failed.reason)


def test_a_broken_file_costs_its_own_run_only(other):
    """A run with many broken rows is flagged with a line number; the other runs are graded.

    A last row that was cut off costs nothing.
    """
    (path,) = files(other, "sine-05")
    text = path.read_text("utf-8")
    path.write_text(text[: len(text) // 2].rsplit(",", 1)[0], "utf-8", newline="\n")
    assert grade(other).flags == ()
    path.write_text(text.replace(".1", ".x"), "utf-8", newline="\n")
    found = grade(other)
    (flag,) = found.flags
    assert (flag.code, flag.parameters) == ("data_problem", ("sine-05",))
    assert "line" in flag.message
    assert found.status == "graded"
    assert found.points > 19


def test_a_missing_file_costs_its_run_and_its_criteria(other, honest):
    """If a file cannot be read, its run is flagged; an unreadable closed loop is missing too."""
    (other / "data" / "decay-1a.csv").unlink()
    one = grade(other)
    assert [(flag.code, flag.parameters) for flag in one.flags] == [("data_problem", ("decay-1a",))]
    assert "data/decay-1a.csv" in one.flags[0].message
    (other / "data" / "control.csv").write_bytes(bytes(range(256)))
    two = grade(other)
    assert {(flag.code, flag.parameters) for flag in two.flags} == {
        ("data_problem", ("decay-1a", "control")),
        ("missing", ("closed_loop",)),
    }
    assert honest.points > one.points > two.points > 15


def test_a_decay_copied_as_a_step_gets_one_flag(other):
    """If a decay is copied in place of a step, one flag covers the copy and the missing step."""
    shutil.copyfile(other / "data" / "decay-1a.csv", other / "data" / "step-1.csv")
    (flag,) = grade(other).flags
    assert flag.code == "data_problem"
    assert "step-1" in flag.parameters


def test_criteria_that_depend_on_a_failed_one_are_skipped():
    """If the gains fail, criteria that depend on them are skipped, and the message says so.

    No known mistake explains these gains and none ran, so nothing can be undone.
    """
    one = student(2)
    runs = tuple(e.model_copy(update={"controller": None}) for e in one.submission.experiments)
    one = replace(one, submission=one.submission.model_copy(update={"experiments": runs}))
    feedback = one.reported.feedback
    assert feedback is not None
    random = [Decimal(f"{(-3) ** i * float(g):.4g}") for i, g in enumerate(feedback.gains)]
    wrong = feedback.model_copy(update={"gains": tuple(random)})
    graded = one.reporting(feedback=wrong).grade()
    claims = criterion(graded, "feedback-claims")
    assert criterion(graded, "feedback").outcome == "fail"
    assert (claims.outcome, claims.points) == ("skip", 0)
    assert "'feedback'" in claims.message


@pytest.mark.parametrize("table", ["initial", "final"])
@pytest.mark.parametrize("side", [1, -1])
def test_points_never_rise_with_the_error(table, side):
    """The larger the error of a gain, the fewer points it earns, down to zero."""
    one = student(1)
    right = one.value(table, "K")
    errors = (0.0, 0.02, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5)
    name = f"{table}-gains"
    points = []
    for error in errors:
        wrong = {"K": right * (1 + error) ** side}
        other = one.reporting(initial=wrong) if table == "initial" else one.reporting(final=wrong)
        points.append(criterion(other.grade(), name).points)
    assert points == sorted(points, reverse=True)
    assert (points[0], points[-1]) == (criterion(one.grade(), name).out_of, 0)


def test_a_broken_law_is_explained_in_words():
    """If a law is broken, the message says in words what disagrees and why the law holds.

    Most numbers of the table are wrong, so none of them is judged with the recordings instead.
    """
    honest = student(2)
    factors = (0.5, 1.7, 1.36, 0.72, 1.44, 0.63, 1.29, 0.7, 1.37, 0.66)
    names = honest.rubric.names
    off = {n: f * honest.value("final", n) for n, f in zip(names, factors, strict=True)}
    laws = criterion(honest.reporting(final=off).grade(), "laws")
    low, high = (f"{n} = {off[n]:.3g}" for n in ("K_2", "K_1"))
    assert f"{low} is above {high} (" in laws.message
    assert "agree" not in laws.message
    assert not any(law in laws.message for law in laws.expected["laws"])
    assert "order.K_2.K_1" in laws.found["broken"]


def test_each_day_late_costs_its_share():
    """Each day begun after the due date costs 10 %, at most half of the points.

    The first hour of each day is free.
    """
    one = student(1)
    full = one.grade().points
    for days, share in ((0.0, 0), (0.04, 0), (0.5, 0.1), (1.04, 0.1), (2.0, 0.2), (30.0, 0.5)):
        graded = one.grade(days_late=days)
        assert graded.deducted == pytest.approx(share * full, abs=0.005)  # rounded to 0.01 points
        assert graded.points == pytest.approx(full - graded.deducted)


def test_recordings_earn_points_without_reported_numbers():
    """Without `[reported]`, all reported numbers are missing; the recordings still earn points."""
    one = student(2)
    silent = replace(one, submission=one.submission.model_copy(update={"reported": None}))
    graded = silent.grade()
    assert [flag.code for flag in graded.flags] == ["missing"]
    earned = {c.id: c.points for c in graded.criteria if c.points}
    assert set(earned) == {"pieces", "dwells", "data", "hardware"}


@pytest.mark.parametrize("lacking", ["carts", "controller"])
def test_a_loop_without_a_model_is_not_judged(lacking):
    """Without fitted carts a person judges the loop; without its controller it earns nothing."""
    one = student(2)
    fit = None if lacking == "carts" else one.analysis.fit
    graded = replace(one, analysis=replace(one.analysis, fit=fit, hardware=())).grade()
    loop = criterion(graded, "hardware")
    assert (loop.outcome, loop.points) == ("skip" if lacking == "carts" else "fail", 0)


@pytest.mark.parametrize(("hide", "loosely"), [((), False), (("dead_zone",), True)])
def test_a_message_says_if_numbers_are_judged_loosely(hide, loosely):
    """If no linear model fits the recordings, the message asks a person to check the numbers."""
    grade = student(1, hide=hide).grade()
    for name in ("final-gains", "final-frequencies", "final-dampings"):
        assert ("A person" in criterion(grade, name).message) is loosely


def test_an_overshoot_below_the_goal_costs_nothing():
    """Gains are judged by the goal of the design, not by an overshoot of 0."""
    one = student(1)
    fit, loop = one.analysis.fit, one.reported.feedback
    assert fit is not None
    assert loop is not None
    # poles of x'' + 2 zeta omega x' + omega²: overshoots by 7 %, more if sampled, and settles fast
    (m,), (c,), k = fit.chain.m, fit.chain.c, float(np.sum(fit.chain.k))
    omega, zeta = 1.5 * float(np.sqrt(k / m)), 0.65
    gains = (typed(m * omega**2 - k), typed(2 * zeta * omega * m - c))
    update = {"gains": gains, "prefilter": typed(m * omega**2)}
    grade = one.reporting(feedback=loop.model_copy(update=update)).under(step=0.01).grade()
    found = criterion(grade, "feedback")
    assert 5.0 < found.found["overshoot_percent"] < found.expected["overshoot_percent"]
    assert found.points == found.out_of


def test_the_best_closed_loop_counts():
    """If a second run of the loop fits the model worse, the better one earns the points."""
    one = student(2)
    runs, checks = one.submission.experiments, one.analysis.hardware
    loop = next(run for run in runs if run.kind == "closed_loop")
    again = loop.model_copy(update={"id": "again"})
    worse = tuple(replace(check, experiment="again", nrmse=1.0) for check in checks)
    two = replace(
        one,
        submission=one.submission.model_copy(update={"experiments": (*runs, again)}),
        analysis=replace(one.analysis, hardware=(*checks, *worse)),
    )
    assert criterion(two.grade(), "hardware") == criterion(one.grade(), "hardware")
