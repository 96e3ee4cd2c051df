"""The printed controller can be computed again, with python-control and with the MATLAB code."""

import json
import re
from dataclasses import replace
from functools import partial
from html import unescape
from typing import Literal

import control
import numpy as np
import pytest
from numpy.testing import assert_allclose

from pipeline.estimation.state_feedback import design_feedback
from pipeline.identify.log import Log
from pipeline.identify.model_checks import design_margins
from pipeline.json_files import json_text
from pipeline.plant.chain import PRESETS, Chain
from pipeline.report.builder import Page
from pipeline.report.document import Table
from pipeline.report.html import render_fragment
from pipeline.report.sections.loops import feedback_blocks, margin_rows
from pipeline.results import Analysis, FeedbackDesign, Stage
from pipeline.setup import Setup
from pipeline.submission import Design
from pipeline.words.numbers import significant
from pipeline.words.text import plain
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.examples import analysed
from tests.helpers.matlab import response, run_matlab

FREE_PAIR = Chain(m=np.full(2, 3e-4), c=np.full(2, 4e-4), k=np.array([0.0, 0.12, 0.0]))
FOUR = Chain(m=np.full(4, 3e-4), c=np.full(4, 4e-4), k=np.array([0.1, 0.12, 0.1, 0.09, 0.05]))
PLANTS = {**PRESETS, "free pair": FREE_PAIR, "four": FOUR}
CASES = [
    (name, method, pace)
    for name in PLANTS
    for method, pace in (("lqr", (None, 1.0)), ("poles", (None, 1.0)), ("lqr", (0.02, 0.5)))
]


def with_design(
    chain: Chain, method: Literal["poles", "lqr"], pace: tuple[float | None, float]
) -> Analysis:
    """Return an analysis with a chain and a design for it, as the workflow makes them."""
    analysis = make_analysis(min(chain.n, 3))
    assert analysis.fit is not None
    sample_time, settling = pace
    task = Design(
        cart=chain.n,
        reference=1.0,
        overshoot_percent=10,
        settling_time=settling,
        sample_time=sample_time,
        method=method,
    )
    design = design_feedback(chain, task)
    design = replace(design, margins=design_margins(chain, design))
    log = Log()
    on_bench = partial(design_margins, chain, design, on_bench=True)
    design = replace(design, bench_margins=log.attempt(Stage.MARGINS, on_bench))
    assert all("unstable" in skip.reason for skip in log.skipped)
    bench = Setup(springs=tuple(bool(k) for k in chain.k))
    return replace(analysis, bench=bench, fit=replace(analysis.fit, chain=chain), feedback=design)


def printed(analysis: Analysis) -> tuple[str, dict[str, list[str]]]:
    """Return the MATLAB code on the page, and the rows of the section's tables by their names."""
    blocks = feedback_blocks(Page(analysis))
    (code,) = re.findall(r"<pre><code>(.*?)</code></pre>", render_fragment(blocks), re.DOTALL)
    rows = {
        plain(row[0].text): [plain(cell.text) for cell in row[1:]]
        for table in blocks
        if isinstance(table, Table)
        for row in table.rows
    }
    return unescape(code), rows


def margin_texts(loop, *, sample_time: float, tied: bool) -> dict[str, str]:
    """Return the margins of a loop, as a report prints them, from its frequency response alone."""
    nyquist = np.pi / sample_time
    omega = np.unique(
        np.concatenate([np.geomspace(1e-3, nyquist, 10_000), np.linspace(0.0, nyquist, 10_000)])
    )[0 if tied else 1 :]
    L = loop(np.exp(1j * omega * sample_time))
    turns = np.flatnonzero((L.imag[1:] * L.imag[:-1] < 0) & (L.real[1:] < 0))
    share = L.imag[turns] / (L.imag[turns] - L.imag[turns + 1])
    at = omega[turns] + share * (omega[turns + 1] - omega[turns])
    at = np.append(at, [0.0, nyquist] if tied else [nyquist])
    real = loop(np.exp(1j * at * sample_time)).real
    at, gain = at[real < 0], -1 / real[real < 0]
    nearest = np.argmin(np.abs(np.log(gain)))
    size = np.log(np.abs(L))
    ones = np.flatnonzero(size[1:] * size[:-1] < 0)
    share = size[ones] / (size[ones] - size[ones + 1])
    crossing = omega[ones] + share * (omega[ones + 1] - omega[ones])
    phase = np.degrees(np.angle(-loop(np.exp(1j * crossing * sample_time))))
    turn = "no limit"
    if phase.size:
        least = np.argmin(np.abs(phase))
        side = "lead" if phase[least] < 0 else "lag"
        turn = f"{_three(abs(phase[least]))}° of {side} at {_three(crossing[least])} rad/s"
    decibel = _three(20 * np.log10(gain[nearest]))
    return {
        "gain margin": f"{_three(gain[nearest])} ({decibel} dB) at {_three(at[nearest])} rad/s",
        "phase margin": turn,
        "modulus margin": _three(np.abs(1 + L).min()),
    }


def _three(value: float) -> str:
    return significant(float(value), digits=3)


def same_text(one: str, other: str) -> bool:
    """Return whether two texts have the same words, and numbers that differ by one last digit."""
    numbers = [[float(n) for n in re.findall(r"\d+\.?\d*", text)] for text in (one, other)]
    words = [re.sub(r"\d+\.?\d*", "#", text) for text in (one, other)]
    # With three digits, the last one is at most 1 % of the number.
    return words[0] == words[1] and np.allclose(*numbers, rtol=0.0101)


@pytest.mark.parametrize(("name", "method", "pace"), CASES)
def test_the_printed_matlab_code_gives_the_printed_numbers(name, method, pace):
    """Gains, prefilter and margins from the code agree with the tables to all printed digits."""
    chain = PLANTS[name]
    analysis = with_design(chain, method, pace)
    design = analysis.feedback
    assert design is not None
    code, rows = printed(analysis)

    found = run_matlab(code)

    gains = np.ravel(found["G"])
    # Ten digits are printed; small gains are differences of larger numbers.
    assert_allclose(gains, design.gains, rtol=1e-4, atol=1e-6 * np.abs(design.gains).max())
    for i, gain in enumerate(gains):
        of = "velocity" if i % 2 else "position"
        assert same_text(rows[f"gain on the {of} of cart {i // 2 + 1}"][0], significant(gain))
    prefilter = float(np.squeeze(found["prefilter"]))
    assert same_text(rows["prefilter"][0], significant(prefilter))
    loop = found["L"]
    expected = margin_texts(
        lambda z: response(loop, z), sample_time=design.sample_time, tied=chain.is_tied
    )
    for margin, text in expected.items():
        assert same_text(rows[margin][0], text), margin
    assert same_text(rows["modulus margin"][0], _three(np.squeeze(found["modulus"])))
    assert rows["delay of the effort"] == ["1", "sample"]


@pytest.mark.parametrize("example", ["one-cart", "two-cart", "three-cart"])
def test_results_json_gives_the_gains_and_margins_again(example):
    """From A, B, Q, R and the sample time, python-control finds gains and both sets of margins."""
    analysis = analysed(example)
    results = json.loads(json_text(analysis))
    design = results["feedback"]
    A, B = (np.array(results["state_space"][name]) for name in "AB")
    T, n = design["sample_time"], len(A) // 2
    sampled = control.sample_system(control.ss(A, B, np.eye(2 * n), 0 * B), T)
    phi, gamma = sampled.A, sampled.B

    G, _, _ = control.dlqr(phi, gamma, design["Q"], design["R"])

    assert_allclose(np.ravel(G), design["gains"], rtol=1e-6)
    level = np.linalg.solve(np.eye(2 * n) - phi + gamma @ G, gamma)[2 * design["cart"] - 2]
    assert_allclose(1 / level, design["prefilter"], rtol=1e-6)
    _, rows = printed(analysis)
    S = np.kron(np.eye(n), [[1.0, 0.0], [0.5 / T, 0.0]])
    steady = np.kron(np.eye(n), [[1.0, T], [0.0, 1.0]])  # the bench predicts constant velocities
    for column, (model, drive) in enumerate([(phi, gamma), (steady, 0 * gamma)]):

        def broken(z, model=model, drive=drive):
            z = np.reshape(z, (-1, 1, 1)) * np.eye(2 * n)
            predicted = np.linalg.solve(z - model @ (np.eye(2 * n) - S) + drive @ G, model @ S)
            return (G @ predicted @ np.linalg.solve(z - phi, np.reshape(gamma, (1, -1, 1))))[
                :, 0, 0
            ]

        for margin, text in margin_texts(broken, sample_time=T, tied=True).items():
            assert same_text(rows[margin][column], text), (margin, text, rows[margin])


def test_an_unstable_loop_on_the_bench_is_said():
    """If the bench's observer makes the loop unstable, the table says so beside the margins."""
    analysis = with_design(PRESETS["throne-2dof"], "lqr", (0.02, 1.0))
    assert analysis.feedback is not None
    assert analysis.feedback.bench_margins is None
    _, rows = printed(analysis)
    assert {rows[name][1] for name, _ in margin_rows(None)} == {"unstable"}


@pytest.mark.parametrize("method", ["lqr", "poles"])
def test_no_line_of_matlab_is_wider_than_the_page(method):
    """Lines of code have at most 72 characters, also for four carts."""
    code, _ = printed(with_design(FOUR, method, (None, 1.0)))
    assert " ...\n" in code
    assert max(map(len, code.splitlines())) <= 72


def test_coinciding_poles_are_placed_by_a_command_that_accepts_them():
    """MATLAB's `place` refuses poles that coincide, so `acker` is printed for them."""
    analysis = with_design(PRESETS["throne-3dof"], "poles", (None, 0.1))
    design: FeedbackDesign | None = analysis.feedback
    assert design is not None
    assert design.requested_poles is not None
    assert len(np.unique(np.round(design.requested_poles, 6))) < 6
    code, _ = printed(analysis)
    assert "acker(" in code
    assert "place(" not in code
