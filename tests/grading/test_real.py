"""Students on a real ECP 210 bench are judged fairly.

The bench has dry friction and a reversed motor sign.
"""

import math
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from pipeline.grading.judge.run import grade_analysis, under_rubric
from pipeline.grading.rubric_file import load_rubric
from pipeline.plant.chain import Chain
from pipeline.results import Analysis
from pipeline.submission import Reported, ReportedStateSpace, Submission, load_submission
from pipeline.workflow import analyse
from tests.helpers.grading_students import typed
from tests.helpers.textbook_student import decay, initial_table
from tests.helpers.ucsd import write_two_cart_submission


@dataclass(frozen=True)
class Bench:
    """Five repeats recorded by one lab section, with their analysis."""

    submission: Submission
    analysis: Analysis

    def flags(
        self, *, initial: dict, final: dict, space: ReportedStateSpace | None = None
    ) -> list[str]:
        """Grade a report; return all flags except those for missing parts."""
        reported = Reported(initial=initial, final=final, state_space=space)
        submission = self.submission.model_copy(update={"reported": reported})
        rubric = load_rubric(Path("ucsd-mae171a"))
        graded = grade_analysis(submission, self.analysis, rubric=rubric, name="team-1")
        return [f"{f.code}: {f.message}" for f in graded.grade.flags if f.code != "missing"]


@pytest.fixture(scope="module")
def bench(real_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ucsd") / "two"
    write_two_cart_submission(folder, real_data, steps=(2, 3, 4, 5))
    submission, _ = under_rubric(load_submission(folder), load_rubric(Path("ucsd-mae171a")))
    return Bench(submission, analyse(submission))


def viscous_fit() -> Chain:
    """Return the parameters of a frictionless simulation matched to the two-cart steps."""
    m, k = np.array([5.5e-6, 3.7e-6]), np.array([1.79e-3, 1.03e-3, 0.0])
    return Chain(m=m, c=2 * np.array([0.15 * 22.6, 0.074 * 16.6]) * m, k=k)


def first_estimates(bench: Bench) -> dict[str, Decimal]:
    return {name: typed(v) for name, v in initial_table(bench.analysis.records, 2).items()}


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("digits", [2, 3])
def test_textbook_numbers_get_no_flag(bench, sign, digits):
    """Numbers found by textbook methods get no flag, with either sign and two or three digits."""

    def written(name: str, value: float) -> Decimal:
        value = sign * float(value) if name.startswith("K") else float(value)
        return Decimal(f"{value:.{digits - 1}e}")

    chain = viscous_fit()
    final = {name: written(name, value) for name, value in chain.parameters().items()}
    initial = {name: written(name, float(v)) for name, v in first_estimates(bench).items()}
    A, B, _, _ = chain.state_space()
    space = ReportedStateSpace(
        A=tuple(tuple(typed(a) if a else Decimal(0) for a in row) for row in A.tolist()),
        B=tuple(typed(sign * b) if b else Decimal(0) for b in B[:, 0].tolist()),
    )
    assert bench.flags(initial=initial, final=final, space=space) == []


def test_damping_from_any_single_repeat_gets_no_flag(bench):
    """Whichever single run a student uses for the damping of a cart, there is no flag."""
    first = first_estimates(bench)
    for record in bench.analysis.records:
        if record.kind in ("decay", "step") and len(record.free) == 1:
            (cart,) = record.free
            found = decay(record, cart)
            if found is not None:
                one = {f"omega_{cart}": typed(found[0]), f"zeta_{cart}": typed(found[1])}
                assert bench.flags(initial={**first, **one}, final={}) == []


def test_real_mistakes_are_still_named(bench):
    """Frequencies in Hz and a gain of the wrong sign are flagged on real recordings too."""
    first = first_estimates(bench)
    hertz = {n: typed(float(v) / (2 * math.pi)) for n, v in first.items() if n.startswith("omega")}
    (flag,) = bench.flags(initial={**first, **hertz}, final={})
    assert flag.startswith("hz_for_rad_s")
    one_sign = {**first, "K_1": -first["K_1"]}
    (flag,) = bench.flags(initial=one_sign, final={})
    assert flag.startswith("physically_impossible")
