"""The laws of a final table are tested with the paper's own tables and with real chains."""

from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.grading.judge.checks import judge_laws
from pipeline.grading.mistakes.undo import Number
from pipeline.plant.chain import PRESETS, Chain

TABLE_2 = {
    "K_1": "24.3", "K_2": "16.4", "omega_a": "10.1", "omega_b": "37.3", "zeta_a": "0.11",
    "zeta_b": "0.03", "omega_1": "19.8", "omega_2": "32.9", "zeta_1": "0.05", "zeta_2": "0.04",
}  # fmt: skip
TABLE_3 = {
    "K_1": "39.4", "K_2": "30.6", "K_3": "16.0", "omega_a": "6.9", "omega_b": "24.1",
    "omega_c": "34.1", "zeta_a": "0.25", "zeta_b": "0.03", "zeta_c": "0.03", "omega_x": "20.2",
    "omega_y": "31.6", "zeta_x": "0.04", "zeta_y": "0.03", "omega_1": "20.0", "omega_2": "27.2",
    "omega_3": "25.6", "zeta_1": "0.08", "zeta_2": "0.02", "zeta_3": "0.04",
}  # fmt: skip


def broken(table: dict[str, str], *, n: int) -> set[str]:
    typed = {name: Number(typed=Decimal(value)) for name, value in table.items()}
    laws = judge_laws(typed, n=n, frequency_percent=3.0, damping_percent=30.0)
    assert laws is not None
    return {law.name for law in laws if law.widening > 0}


def test_table_2_of_the_paper_fails_in_its_first_cart():
    """Table 2 of the paper breaks the law for ω_1: 19.8 is below the recomputed 20.07 to 20.49.

    With ζ_b = 0.03, as printed, the table also breaks R1; with 0.034 it does not.
    """
    assert broken({**TABLE_2, "zeta_b": "0.034"}, n=2) == {"recomputed.omega_1"}
    assert broken(TABLE_2, n=2) == {"recomputed.omega_1", "redundancy.R1"}


def test_table_3_of_the_paper_breaks_known_laws():
    """Table 3 of the paper breaks R4, R5, the sign of a wall spring, the law for ω_2 and others."""
    failed = {"redundancy.R4", "redundancy.R5", "sign.k_1", "recomputed.omega_2"}
    assert failed < broken(TABLE_3, n=3)


@pytest.mark.parametrize(
    ("first", "second", "holds"),
    [("24.3", "24.3", True), ("24.3", "24.4", True), ("24.3", "24.5", False), ("24.3", "20", True)],
)
def test_rounding_excuses_gains_in_the_wrong_order(first, second, holds):
    """`judge_laws` finds the order of two gains broken only beyond half a digit of each."""
    found = broken({**TABLE_2, "K_1": first, "K_2": second}, n=2)
    assert ("order.K_2.K_1" in found) == (not holds)


def test_one_digit_does_not_excuse_every_broken_law():
    """If a table is typed with one digit, rounding does not excuse every broken law."""
    vague = {name: f"{float(value):.0e}" for name, value in TABLE_2.items()}
    assert broken(vague, n=2) == {"recomputed.omega_1", "recomputed.zeta_1"}
    assert "positive.K_1" in broken({**TABLE_2, "K_1": "0e2"}, n=2)


@pytest.mark.parametrize("n", [2, 3])
@settings(max_examples=20)  # for three carts, the rounding intervals have 2^15 corners
@given(data=st.data())
def test_a_rounded_table_of_a_real_chain_obeys_every_law(n, data):
    """A real chain's table, rounded to two to five digits, obeys every law."""
    sizes = st.floats(0.5, 2.0)
    digits = data.draw(st.integers(2, 5))
    chain = Chain(
        m=np.array([data.draw(sizes) for _ in range(n)]) * 3e-4,
        c=np.array([data.draw(sizes) for _ in range(n)]) * 5e-4,
        k=np.array([data.draw(sizes) for _ in range(n + 1)]) * 0.1,
    )
    table = {name: f"{value:#.{digits}g}" for name, value in chain.parameters().items()}
    assert broken({k: v.removesuffix(".") for k, v in table.items()}, n=n) == set()


def test_an_incomplete_table_is_not_judged():
    """A table that lacks a parameter is not judged."""
    typed = {name: Number(typed=Decimal(value)) for name, value in TABLE_2.items() if name != "K_1"}
    assert judge_laws(typed, n=2, frequency_percent=3.0, damping_percent=30.0) is None


@pytest.mark.parametrize(
    ("n", "name"), [*((2, x) for x in ("K_1", "omega_a", "omega_2", "zeta_2")), (3, "omega_2")]
)
def test_a_larger_error_needs_wider_tolerances(n, name):
    """The larger the error of one number, the more the tolerances of the laws must be widened."""
    table = PRESETS[f"throne-{n}dof"].parameters()

    def needed(factor: float) -> Fraction:
        rounded = {x: f"{v * (factor if x == name else 1):.3g}" for x, v in table.items()}
        typed = {x: Number(typed=Decimal(v)) for x, v in rounded.items()}
        laws = judge_laws(typed, n=n, frequency_percent=3.0, damping_percent=30.0)
        assert laws is not None
        return max(law.widening for law in laws)

    for factors in ([1.0, 1.05, 1.2, 1.5, 2.0, 4.0, 100.0], [1.0, 0.95, 0.8, 0.6, 0.4, 0.2, 0.01]):
        steps = [needed(factor) for factor in factors[:: 3 if n == 3 else 1]]
        assert steps == sorted(steps)
        assert steps[0] <= Fraction(1, 2)
        assert steps[-1] >= 1
