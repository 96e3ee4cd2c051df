"""Honest records of many kinds of lab: nobody's is called spoilt."""

import pytest

from pipeline.submission import load_submission
from pipeline.synthesis import write_submission
from pipeline.synthesis.hidden import prepare_bench
from pipeline.workflow import analyse
from tests.grading.mistakes.test_faults import PRESET

HONEST = {
    "smooth": {"count": 0.002},
    "coarse": {"count": 0.2},
    "sticking": {"count": 0.002, "hide": 0.0008},
    "sticking, coarse": {"count": 0.05, "hide": 0.0008},
    "sticking at every small step": {"count": 0.01, "hide": 0.008},
}


LONG = "sticking at every small step"


@pytest.mark.parametrize(
    "case",
    [
        *(case for case in HONEST if case != LONG),
        pytest.param(LONG, marks=[pytest.mark.slow, pytest.mark.sample]),
    ],
)
def test_no_honest_record_is_accused(case, tmp_path, monkeypatch):
    """Without encoder noise carts rest exactly, stick, or stay within one coarse step."""
    monkeypatch.setattr("pipeline.synthesis._NOISE_COUNTS", 0.0)
    force = HONEST[case].get("hide")
    hidden = [f"coulomb_friction:cart={cart},force={force}" for cart in (1, 2)] if force else []
    made = prepare_bench(preset=PRESET, hide=tuple(hidden))
    write_submission(
        tmp_path,
        chain=made.chain,
        effects=made.effects,
        seed=5,
        compact=True,
        count=HONEST[case]["count"],
    )
    analysis = analyse(load_submission(tmp_path), design=False)
    assert [one for one in analysis.left_out if one.is_wrong] == []
