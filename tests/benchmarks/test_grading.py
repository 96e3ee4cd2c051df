"""The comparison of graders is fair: the notebook's reference and the mistakes are right."""

import json
from functools import partial

import pytest

from benchmarks import grading, grading_notebooks, lab_reference, report
from benchmarks.grading_batch import Cost
from pipeline.ingest.read import read_data
from pipeline.plant.chain import PRESETS
from pipeline.submission import load_submission


@pytest.fixture(scope="module")
def teams(tmp_path_factory):
    """Return a class with an honest team and one team per mistake, and the mistakes by team."""
    folder = tmp_path_factory.mktemp("class") / "class"
    return folder, grading_notebooks.write_teams(folder, honest=1, each=1)


@pytest.fixture
def checks(teams, monkeypatch):
    """Return which of the notebook's tests fail for a team."""

    def failed(team):
        monkeypatch.chdir(teams[0] / team)
        lab_reference.initial.cache_clear()
        lab_reference.final.cache_clear()
        answers: dict = {}
        exec(grading_notebooks._notebook(teams[0] / team)["cells"][0]["source"], answers)
        ask = partial(lab_reference.check, reported=answers["reported"], dwells=answers["dwells"])
        wrong = set()
        for table, name in grading_notebooks._ASKED:
            try:
                ask(table, name)
            except AssertionError:
                wrong.add((table, name))
        return wrong

    return failed


def test_the_notebooks_tests_fail_only_for_wrong_numbers(teams, checks):
    wrong = {
        "": set(),
        "hz_for_rad_s": {("initial", "omega_n"), ("final", "omega_n")},
        "log10_for_ln": {("initial", "zeta")},
        "peak_to_peak": {("initial", "K")},
        "peak_count": {("initial", "omega_n"), ("initial", "zeta")},
        "final_off": {("final", "K")},
        grading_notebooks.COPIED: set(),
    }
    assert {slip: checks(team) for team, slip in teams[1].items()} == wrong


def test_the_notebooks_reference_finds_the_true_values(teams, checks):
    checks("team-000")
    truth = PRESETS[grading_notebooks.PRESET].parameters()
    found = lab_reference.final(tuple(sorted(_dwells(teams[0] / "team-000").items())))
    assert found == pytest.approx(truth, rel=0.01)


def test_a_grader_is_judged_by_lost_points_and_named_mistakes():
    slips = {"a": "", "b": "hz_for_rad_s", "c": "final_off", "d": grading_notebooks.COPIED}
    done = grading_notebooks.Graded(
        cost=Cost(clock=9.0, parent=1.0, workers=7.0),
        lost=frozenset("bd"),
        named={"b": frozenset({"hz_for_rad_s"}), "d": frozenset({"data_problem"})},
    )
    assert grading._judged(done, slips) == [
        "2.00", "50 % (1 of 2)", "50 % (1 of 2)", "0 % (0 of 1)", "0 % (0 of 1)"
    ]  # fmt: skip


def test_the_table_of_mistakes_counts_every_grading_in_one_line():
    """Each kind of mistake has one line; an honest team with a flag counts as wrong."""

    def row(kind, codes, found):
        return {
            "seed": 1, "kind": kind, "codes": codes, "found": found, "or_else": [], "seconds": 1.0,
            "friction": True,
        }  # fmt: skip

    table = grading.named_mistakes(
        [
            row("honest, 2 carts", [], []),
            row("honest, 3 carts", [], ["final_off"]),
            row("peak_count", ["peak_count"], ["peak_count"]),
            row("one number: hz_for_rad_s", ["hz_for_rad_s"], ["peak_count"]),
            row("a + b", ["a", "b"], ["a", "b", "c"]),
        ]
    )

    lines = {cells[0]: cells[1:] for cells in table.rows}
    assert lines["honest"][0].startswith("50 % (1 of 2)")
    assert lines["one mistake"][0].startswith("100 % (1 of 1)")
    assert lines["one mistake in one number"][0].startswith("0 % (0 of 1)")
    assert lines["two mistakes in a table"][2] == "1"
    assert lines["**all mistakes**"][0].startswith("67 % (2 of 3)")
    assert "Not always right: 2 kinds once." in " ".join(table.note.split())
    assert "1 of them slightly nonlinear" in table.note


def test_records_of_many_sessions_are_all_different_and_can_be_read(tmp_path):
    report.write_records(tmp_path / "many", 40)
    data = read_data(load_submission(tmp_path / "many"))
    assert len(data.records) == 40
    assert len(set(data.files.values())) == 40
    assert not data.unreadable


def test_the_drawn_document_is_cells_that_a_kernel_can_run(tmp_path):
    cells = report._DOCUMENT.read_text(encoding="utf-8").split("# %%\n")[1:]
    report._write_notebook(tmp_path / "lab.ipynb", cells)
    notebook = json.loads((tmp_path / "lab.ipynb").read_text(encoding="utf-8"))
    assert len(notebook["cells"]) == len(cells) > 3
    for cell in notebook["cells"]:
        compile(cell["source"], "cell", "exec")


def _dwells(team):
    submission = load_submission(team)
    return {
        str(one.file).removeprefix("data/"): one.frequency
        for one in submission.experiments
        if one.kind == "sine"
    }
