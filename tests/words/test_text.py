"""Sentences with parameter names as mathematics, and with code as it is typed."""

import pytest

from pipeline.words.text import rich, with_symbols


@pytest.mark.parametrize(
    "code",
    [
        "write omega_a = -10.1",
        "found zeta_1 = 0,03",
        "found omega_a : 1e-3",
        "did you mean 'omega_1'?",
        "reported.final.zeta_b: expected a number",
    ],
)
@pytest.mark.parametrize("shown", [with_symbols, lambda text: "".join(s.text for s in rich(text))])
def test_code_stays_as_it_is_typed(code, shown):
    """Nobody is told to type a Greek letter or a true minus, which no file may contain."""
    assert code in shown(f"K_1 is here; {code}. omega_b is not.")


def test_other_names_become_symbols():
    """Outside code, names are symbols, also directly after it."""
    text = "omega_a: write omega_a = 10.1. Look at zeta_b, and at zeta_2 = -0.1."
    assert with_symbols(text) == "ω_a: write omega_a = 10.1. Look at ζ_b, and at ζ₂ = -0.1."
    assert [span.text for span in rich(text) if span.math] == ["ω_a", "ζ_b", "ζ_2"]


def test_a_line_with_a_list_is_code():
    """A line for submission.toml is shown as it must be typed."""
    line = 'leave_out = ["07-Feb-2025_09", "*zeta_1*"]'
    assert [s.text for s in rich(f"of zeta_1: to keep (1), {line}; x") if s.style == "code"] == [
        line
    ]
