"""A channel that is logged later than the others is told; carts with friction are not."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.checks.channels import LATE_CHANNEL
from pipeline.grading.judge.run import grade_submission
from pipeline.grading.mistakes.recordings import bad_runs
from pipeline.grading.rubric_file import load_rubric
from pipeline.resources import RUBRICS
from pipeline.submission import load_submission
from pipeline.synthesis import write_submission
from pipeline.synthesis.hidden import prepare_bench
from pipeline.workflow import analyse

SAMPLE = 0.00884  # s
LATE = 5  # samples


def hand_in(folder: Path, *, hide: tuple[str, ...] = (), late: int = 0) -> Path:
    """Write an honest submission of two carts; cart 2 is read so many samples late."""
    bench = prepare_bench(preset="throne-2dof", hide=hide)
    write_submission(
        folder, chain=bench.chain, effects=bench.effects, seed=3, compact=True, reported=True
    )
    for path in (folder / "data").glob("*.csv") if late else ():
        head, *rows = csv.reader(path.read_text(encoding="utf-8").splitlines())
        at = head.index("x2")
        positions = [row[at] for row in rows]
        for row, position in zip(rows, [positions[0]] * late + positions, strict=False):
            row[at] = position
        text = "\n".join(",".join(row) for row in (head, *rows)) + "\n"
        path.write_text(text, encoding="utf-8")
    return folder


def test_a_late_channel_is_told_with_its_delay(tmp_path):
    """In the report's checks, to within a fifth of a sample, and by the grade of the data."""
    submission = load_submission(hand_in(tmp_path / "team", late=LATE))
    graded = grade_submission(
        submission, rubric=load_rubric(RUBRICS / "throne-2dof.toml"), name="team"
    )
    assert graded.analysis is not None
    (check,) = [c for c in graded.analysis.checks if c.id.startswith(LATE_CHANNEL)]
    assert check.outcome == "fail"
    assert check.value is not None
    assert check.id == f"{LATE_CHANNEL}.cart-2"
    np.testing.assert_allclose(check.value, LATE * SAMPLE, atol=0.2 * SAMPLE)
    (flag,) = [flag for flag in graded.grade.flags if flag.code == "data_problem"]
    assert all(name.startswith("sine") for name in flag.parameters)
    dwells = [record for record in graded.analysis.records if record.omega]
    held = replace(dwells[0], free=(1,))
    others = [held if record is dwells[0] else record for record in graded.analysis.records]
    bad = bad_runs(replace(graded.analysis, records=tuple(others)))
    assert {one.id for one in dwells} - set(bad) == {held.id}  # its cart 2 does not move


@pytest.mark.parametrize(
    "hide",
    [
        (),
        pytest.param(
            ("coulomb_friction:cart=2,force=0.03",), marks=[pytest.mark.slow, pytest.mark.sample]
        ),
        ("input_delay:delay=0.03",),
    ],
)
def test_friction_and_a_late_input_are_no_late_channel(tmp_path, hide):
    """A delay of the motor moves all carts alike, and friction no phase in proportion."""
    analysis = analyse(load_submission(hand_in(tmp_path / "team", hide=hide)), design=False)
    assert not [c for c in analysis.checks if c.id.startswith(LATE_CHANNEL)]
