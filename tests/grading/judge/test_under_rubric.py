"""A rubric replaces what it states of a submission and nothing else."""

import shutil
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import pytest
from numpy.testing import assert_array_equal
from pydantic import BaseModel

from pipeline.grading.judge.run import grade_submission, under_rubric
from pipeline.grading.rubric import Rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.grading.self_check.check import check_numbers
from pipeline.simulated.submission import write_submission
from pipeline.submission import (
    Author,
    Design,
    Experiment,
    InputOverride,
    InputScale,
    PidController,
    PositionScale,
    Reported,
    ReportedFeedback,
    ReportedStateSpace,
    Students,
    Submission,
    System,
    load_submission,
)
from pipeline.submission.models import Repair, Unread
from pipeline.workflow import analyse

RUN = Experiment(
    id="run",
    kind="sine",
    file="data/run.csv",
    carts=(1,),
    frequency=2.0,
    window=(1.0, 9.0),
    note="held by hand",
    input=InputOverride(sign=-1, per_count=0.5),
    columns={"time": "Time", "x1": 3},
    sample_rate=500.0,
    run="run 2",
    repair=Repair(unwrap=False, jumps=False, spikes=False, repeats=False),
    hold="band_limited",
    controlled_cart=1,
    controller=PidController(type="pid", kp=0.05, ki=0.1, kd=0.2, scale=0.01, cart=2),
    reference=1.5,
)
FULL = Submission(
    version=1,
    title="Bench 4",
    section="03",
    authors=(Author(id="s1024", name="Åsa"),),
    system=System(
        carts=2,
        springs=(True, True, False),
        input=InputScale(unit="A", sign=-1, per_count=0.25),
        position=PositionScale(unit="mm", per_count=0.0227),
        columns={"time": "Zeit", "x1": "Weg A"},
    ),
    design=Design(
        cart=2,
        reference=2.0,
        overshoot_percent=5.0,
        settling_time=2.0,
        input_limit=4.0,
        sample_time=0.01,
        method="poles",
    ),
    experiments=(RUN, RUN.model_copy(update={"id": "loop", "kind": "closed_loop"})),
    leave_out=("other-*",),
    reported=Reported(
        initial={"K_1": Decimal("25.60")},
        final={"K_1": Decimal("24.30")},
        state_space=ReportedStateSpace(A=((Decimal(1),),), B=(Decimal(2),)),
        feedback=ReportedFeedback(
            gains=(Decimal(1),),
            prefilter=Decimal(2),
            overshoot_percent=Decimal(3),
            settling_time=Decimal(4),
        ),
        effects={"input_delay": {"delay": Decimal("0.01")}},
    ),
    students=Students(see="check"),
    folder=Path("somewhere"),
    discussion="Friction matters.",
    unread=(Unread(at=("reported", "final", "K_2"), message="line 9: expected a number"),),
)


def leaves(value: object, at: str = "") -> Iterator[tuple[str, object]]:
    """Yield the dotted path and the value of every field, through models and lists of models."""
    if isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from leaves(getattr(value, name), f"{at}.{name}" if at else name)
    elif isinstance(value, tuple) and value and isinstance(value[0], BaseModel):
        for i, one in enumerate(value):
            yield from leaves(one, f"{at}[{i}]")
    else:
        yield at, value


def models(value: object) -> Iterator[BaseModel]:
    """Yield a model and all models inside it."""
    if isinstance(value, BaseModel):
        yield value
        for name in type(value).model_fields:
            yield from models(getattr(value, name))
    elif isinstance(value, tuple):
        for one in value:
            yield from models(one)


def replaced(rubric: Rubric) -> set[str]:
    """Return the paths of the fields that differ under a rubric."""
    before = dict(leaves(FULL))
    after = dict(leaves(under_rubric(FULL, rubric)[0]))
    return {at for at in before | after if before.get(at) != after.get(at)}


def test_the_submission_of_this_test_states_every_field():
    """Every field of every model in the test's submission has a value that is not its default."""
    for model in models(FULL):
        for name, field in type(model).model_fields.items():
            assert field.is_required() or getattr(model, name) != field.default, f"{model!r}.{name}"


@pytest.mark.parametrize("unit", ["count", "cm"])
def test_a_rubric_that_states_no_scale_replaces_only_the_springs(unit):
    """If a rubric states only carts and units, only the springs are replaced."""
    system = System(carts=2, position=PositionScale(unit=unit), input=InputScale(unit="mA"))
    assert replaced(Rubric(version=1, system=system, criteria=())) == {"system.springs"}


def test_a_unit_of_another_quantity_is_replaced():
    """A submission in amperes and counts is graded in the volts and centimetres of the rubric."""
    counts = FULL.system.model_copy(update={"position": PositionScale(per_count=0.00227)})
    rubric = Rubric(
        version=1, system=System(carts=2, position=PositionScale(unit="cm")), criteria=()
    )
    read, notes = under_rubric(FULL.model_copy(update={"system": counts}), rubric)
    assert (read.system.position.unit, read.system.input.unit) == ("cm", "V")
    assert read.system.position.per_count == 0.00227
    assert not any("as submitted" in note for note in notes)


def test_a_rubric_replaces_what_it_states():
    """A rubric replaces its design and scales, and each recording's own scale of the input."""
    stated = FULL.system.model_copy(
        update={
            "springs": (False, True, True),
            "input": InputScale(unit="mA", sign=1, per_count=500.0),
            "position": PositionScale(unit="cm", per_count=0.0023),
            "columns": {"time": "Time", "x2": "Weg B"},
        }
    )
    rubric = Rubric(version=1, system=stated, design=Design(), criteria=())
    assert replaced(rubric) == {
        "system.springs",
        "system.input.sign",
        "system.input.per_count",
        "system.position.per_count",
        "system.columns",
        "experiments[0].input.per_count",
        *(f"design.{name}" for name in Design.model_fields),
    }
    system = under_rubric(FULL, rubric)[0].system
    assert system.columns == {"time": "Zeit", "x1": "Weg A", "x2": "Weg B"}
    # The submission has millimetres and amperes; a product of two doubles is right to 2e-16.
    assert system.position.per_count == pytest.approx(0.023, rel=1e-15)
    assert system.input.per_count == pytest.approx(0.5, rel=1e-15)


def test_report_check_and_grade_see_the_same_recordings(tmp_path):
    """Headings that only `[system] columns` explains change no recording, check or grade."""
    plain, named = tmp_path / "plain", tmp_path / "named"
    write_submission(plain, "throne-1dof", seed=3, compact=True, reported=True)
    shutil.copytree(plain, named)
    for path in (named / "data").glob("*.csv"):
        heading, rows = path.read_text("utf-8").split("\n", 1)
        for known, own in (("time", "Kanal A"), ("input", "Kanal B"), ("x1", "Kanal C")):
            heading = heading.replace(known, own)
        path.write_text(f"{heading}\n{rows}", "utf-8", newline="\n")
    toml = named / "submission.toml"
    text = toml.read_text("utf-8")
    said = 'columns = { time = "Kanal A", input = "Kanal B", x1 = "Kanal C" }'
    toml.write_text(text.replace("[system]", f"[system]\n{said}"), "utf-8", newline="\n")
    rubric = load_rubric(Path("throne-1dof"))
    submission = load_submission(named)

    reported = analyse(submission, design=False).records
    graded = grade_submission(submission, rubric=rubric, name="team-07")
    before = grade_submission(load_submission(plain), rubric=rubric, name="team-07")

    assert graded.analysis is not None
    assert len(reported) == len(graded.analysis.records) > 10
    for ours, theirs in zip(reported, graded.analysis.records, strict=True):
        assert_array_equal(ours.y, theirs.y)
        assert_array_equal(ours.t, theirs.t)
    assert graded.grade == before.grade
    assert graded.grade.points == 20
    assert check_numbers(submission, rubric=rubric).disagree == ()


def test_recordings_that_are_left_out_count_as_not_handed_in(tmp_path):
    """Files that a submission leaves out earn no points, whatever they contain."""
    folder = tmp_path / "team"
    write_submission(folder, "throne-1dof", seed=3, compact=True, reported=True)
    for path in (folder / "data").glob("sine-*.csv"):
        path.write_text("garbage", "utf-8")
    toml = folder / "submission.toml"
    toml.write_text('leave_out = ["sine-*"]\n' + toml.read_text("utf-8"), "utf-8", newline="\n")
    rubric = load_rubric(Path("throne-1dof"))

    grade = grade_submission(load_submission(folder), rubric=rubric, name="team").grade

    points = {one.id: one.points for one in grade.criteria}
    assert points["dwells"] == 0
    assert "missing" in {flag.code for flag in grade.flags}
    assert any("leaves out" in note for note in grade.notes)
