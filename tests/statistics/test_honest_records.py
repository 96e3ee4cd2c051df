"""No honest recording is called faulty, in many kinds of lab."""

from dataclasses import replace

import pytest

from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
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
def test_no_honest_record_is_called_faulty(case, tmp_path):
    """Without noise, carts may rest exactly or stick, and still no recording is called faulty."""
    force = HONEST[case].get("hide")
    hidden = [f"coulomb_friction:cart={cart},force={force}" for cart in (1, 2)] if force else []
    made = prepare_bench(preset=PRESET, hide=tuple(hidden))
    quiet = replace(made, count=HONEST[case]["count"], noise_counts=0.0)
    write_submission(tmp_path, quiet, seed=5, compact=True)
    analysis = analyse(load_submission(tmp_path), design=False)
    assert [one for one in analysis.left_out if one.is_wrong] == []
