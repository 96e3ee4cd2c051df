"""The comparison of graders is fair: the notebook's reference and the mistakes are right."""

from functools import partial

import pytest

from benchmarks import grading_notebooks, lab_reference, report
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


def test_records_of_many_sessions_are_all_different_and_can_be_read(tmp_path):
    report.write_records(tmp_path / "many", 40)
    data = read_data(load_submission(tmp_path / "many"))
    assert len(data.records) == 40
    assert len(set(data.files.values())) == 40
    assert not data.unreadable


def _dwells(team):
    submission = load_submission(team)
    return {
        str(one.file).removeprefix("data/"): one.frequency
        for one in submission.experiments
        if one.kind == "sine"
    }
