"""The studies count every bench that was drawn and every stated error."""

import pytest

from benchmarks import explorations, rivals
from benchmarks.drawn import draw
from pipeline.experiments.plan import Recording
from pipeline.experiments.propose import propose_plan
from pipeline.submission import load_submission
from tests.helpers.virtual import LimitPassed, VirtualBench, new_folder


def _cells(table: str, first: str) -> list[str]:
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    return next(line for line in lines if line[0] == first)


def _explored(**changed) -> dict:
    row = {
        "hidden": [],
        "verdicts": ["none"],
        "found": [],
        "reached": True,
        "errors": {"m_1": 0.5},
        "seconds": 100.0,
        "fixed": 200.0,
    }
    return row | changed


def test_errors_of_wrongly_named_benches_count_in_the_coverage():
    wrong = _explored(verdicts=["named"], found=[["cubic_spring", 1]], errors={"m_1": 9.0})

    cells = _cells(explorations.table([_explored(), wrong]), "all")

    assert "(1 of 2;" in cells[4]


def test_a_recording_beyond_the_travel_limit_is_refused(tmp_path):
    """A recording that passes the travel limit raises `LimitPassed`, which names the recording."""
    drawn = draw(71_001, effects=0)
    bench = VirtualBench(drawn.bench, seed=1)
    submission = load_submission(new_folder(tmp_path / "lab", bench, springs=drawn.springs))
    plan = propose_plan(submission, bench=bench.description)
    step = next(r for r in plan.recordings if r.kind == "step")
    narrow = plan.limits.model_copy(update={"travel": 1e-6})

    assert isinstance(step, Recording)
    with pytest.raises(LimitPassed, match=step.id):
        bench.carry_out(step, submission=submission, limits=narrow)


def test_benches_whose_first_search_failed_are_counted():
    look = {"verdict": "ambiguous", "found": []}
    rows = [{"hidden": [], "looks": [look]}, {"hidden": [], "looks": []}]

    table = rivals.table(rows)

    assert _cells(table, "ambiguous")[1] == "1 of 2"
    assert _cells(table, "none: the first look failed")[1] == "1 of 2"
