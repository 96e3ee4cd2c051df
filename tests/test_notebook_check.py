"""The check in a notebook: `from pipeline import check`."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import SubmissionError
from pipeline.grading.self_check.answers import read_answers
from pipeline.notebook import check
from pipeline.resources import RUBRICS
from pipeline.simulated.submission import write_submission
from tests.helpers.commandline import cartlab_here

RIGHT = {"K": 28.9, "omega_n": 13.2, "zeta": "0.101"}
IN_HERTZ = {**RIGHT, "omega_n": 2.1}


@pytest.fixture
def lab(tmp_path) -> Path:
    """Return a folder of recordings without any reported numbers."""
    folder = tmp_path / "lab"
    write_submission(folder, "throne-1dof", seed=7, compact=True)
    return folder


def test_only_a_second_check_says_where_to_look(lab):
    """A first check says which numbers disagree, and a second where to look; both are logged."""
    first = check(lab, reported={"final": IN_HERTZ})
    assert first.disagree == ("final.omega_n",)
    assert first.agree == ("final.K", "final.zeta")
    assert "Hz" not in repr(first)
    second = check(lab, reported={"final": IN_HERTZ})
    assert "Hz" in repr(second)
    assert not re.search(r"\b1[23]\.\d", repr(second))  # not the right 13.2 rad/s
    assert read_answers(lab) == (first.answer, second.answer)


def test_without_numbers_the_files_numbers_are_checked(lab):
    """Without numbers from the notebook, those in `submission.toml` are checked."""
    with (lab / "submission.toml").open("a", encoding="utf-8") as file:
        file.write("\n[reported.final]\nK = 28.9\nomega_n = 2.1\nzeta = 0.101\n")
    typed = check(lab, reported={"final": IN_HERTZ})
    here = check(lab)
    done = cartlab_here("check", lab, "--json")
    assert here.answer.basis == typed.answer.basis == json.loads(done.stdout)["basis"]
    assert here.disagree == typed.disagree == tuple(json.loads(done.stdout)["disagree"])


def test_numpy_numbers_are_accepted(lab):
    """Numbers that numpy computed are accepted, in arrays too, such as a state model's matrices."""
    computed = {name: np.float64(value) for name, value in RIGHT.items()}
    A = np.array([[0.0, 1.0], [-(13.2**2), -2 * 0.101 * 13.2]])
    B = np.array([[0.0], [28.9 * 13.2**2]])
    found = check(lab, reported={"final": computed, "state_space": {"A": A, "B": B}})
    assert found.disagree == ()
    assert {"final.K", "state_space.A(2, 1)", "state_space.B(2)"} <= set(found.agree)


def test_missing_numbers_count_as_wrong(lab):
    """A missing number counts as wrong, so that nobody earns more by reporting less."""
    found = check(lab, reported={"final": {"K": 28.9, "omega_n": 2.1}})
    assert found.share("final.K") == 1.0
    assert found.share("final.K", "final.omega_n") == 0.5
    assert found.share("final.K", "final.omega_n", "final.zeta", "initial.K") == 0.25
    with pytest.raises(TypeError, match="numbers that count"):
        found.share()


def test_a_rubric_gives_its_tolerances(lab, tmp_path):
    """With a rubric that allows 20 %, a number that is 10 % off agrees."""
    text = (RUBRICS / "throne-1dof.toml").read_text(encoding="utf-8")
    text = re.sub(r"(?m)^(full|none)_percent = .*\n", "", text)
    limits = 'check = "final"\nfull_percent = 20.0\nnone_percent = 40.0'
    wide = re.sub(r'(?m)^check = "final"$', limits, text)
    (tmp_path / "wide.toml").write_text(wide, encoding="utf-8")
    off = {"final": {"K": 28.9 * 1.1}}
    assert check(lab, reported=off).disagree == ("final.K",)
    assert check(lab, reported=off, rubric=tmp_path / "wide.toml").disagree == ()


@pytest.mark.parametrize(
    ("reported", "where"),
    [
        ({}, "reported"),
        ({"final": {"omega": 1.0}}, r"final\.omega: .*'omega_n'"),
        ({"finl": RIGHT}, r"finl: .*'final'"),
        ({"final": {"K": "ten"}}, r"final\.K: .*'ten'"),
        ({"final": {"K": ...}}, r"final\.K: .*Ellipsis"),
        ({"final": {"K": float("nan")}}, r"final\.K: .*NaN"),
        ({"final": {"K": True}}, r"final\.K: .*True"),
        ({"feedback": {"gains": [1.0]}}, r"feedback\.gains: .*2 gains"),
    ],
)
def test_a_wrong_value_is_one_clear_error(lab, reported, where):
    """A text, NaN or unknown name in place of a number is one error, and no answer is counted."""
    with pytest.raises(SubmissionError, match=where):
        check(lab, reported=reported)
    assert read_answers(lab) == ()
