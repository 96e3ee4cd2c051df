"""What determines each resonance: dwells with a steady state, whole records, or only the model."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pipeline.json_files import json_text
from pipeline.names import read_name
from pipeline.plant.chain import PRESETS, Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.report.sections.questions import ask
from pipeline.report.sections.summary import terminal_summary
from pipeline.results import Analysis
from pipeline.submission import load_submission
from pipeline.workflow import analyse

COUNT = 0.00227  # cm, the encoder step
RATE = 128.0  # Hz; a power of two, so all intervals are equal and simulate fast
LONG = 25.0  # s, a dwell that surely reaches its steady state
ONE, TWO, THREE = (PRESETS[f"throne-{n}dof"] for n in (1, 2, 3))


def dwells(
    folder: Path, chain: Chain, omegas: Sequence[float], *, periods: Sequence[float], seed: int = 1
) -> Analysis:
    """Analyse dwells from rest that last so many periods, but not longer than `LONG`."""
    rng, entries = np.random.default_rng(seed), []
    (folder / "data").mkdir(parents=True)
    for i, (omega, cycles) in enumerate(zip(omegas, periods, strict=True)):
        t = np.arange(int(min(cycles * 2 * np.pi / omega, LONG) * RATE)) / RATE
        u = np.sin(omega * t)
        y = simulate_linear(chain, t, u)
        u *= 2 / np.abs(y).max()  # 2 cm
        y = COUNT * np.round((2 / np.abs(y).max() * y + rng.normal(0, COUNT / 4, y.shape)) / COUNT)
        np.savetxt(
            folder / "data" / f"sine-{i}.csv",
            np.vstack([t, u, y]).T,
            delimiter=",",
            header=",".join(["time", "u", *(f"x{cart}" for cart in range(1, chain.n + 1))]),
            comments="",
            fmt="%.8g",
        )
        entries.append(
            f'[[experiments]]\nid = "sine-{i}"\nkind = "sine"\nfile = "data/sine-{i}.csv"\n'
            f"frequency = {omega / (2 * np.pi):.12g}\n"
        )
    springs = [bool(k) for k in chain.k]
    head = (
        f"version = 1\n[system]\ncarts = {chain.n}\nsprings = {str(springs).lower()}\n"
        'input = { unit = "V", sign = 1 }\nposition = { unit = "cm" }\n'
    )
    (folder / "submission.toml").write_text(head + "".join(entries), encoding="utf-8")
    return analyse(load_submission(folder), design=False)


def grid(chain: Chain, low: float, high: float, n: int) -> list[float]:
    """Return frequencies, rad/s, from `low` to `high` and at all resonances between them."""
    roots = [v for name, v in chain.parameters().items() if read_name(name).is_frequency]
    return sorted([*np.geomspace(low, high, n), *(w for w in roots if low < w < high)])


def errors(analysis: Analysis, chain: Chain) -> dict[str, float]:
    """Return the errors of the final estimates, in standard errors."""
    truth = chain.parameters()
    return {
        row.name: abs(row.final.value - truth[row.name]) / row.final.std
        for row in analysis.rows
        if row.final and row.final.std
    }


@pytest.mark.parametrize(
    ("chain", "periods"),
    [
        (ONE, [2.3]),
        (ONE, [2.3, 60]),
        (TWO, [3.5]),
        (TWO, [60, 2.4, 2.4]),
        (THREE, [2.3]),
        (THREE, [8]),
    ],
)
def test_dwells_without_a_steady_state_are_used_by_their_whole_records(tmp_path, chain, periods):
    """Dwells of any number of periods, alone or beside long ones, give back the carts."""
    omegas = grid(chain, 5.0, 45.0, 9)
    many = [periods[i % len(periods)] for i in range(len(omegas))]
    analysis = dwells(tmp_path / "lab", chain, omegas, periods=many)
    found = errors(analysis, chain)
    assert set(found) == set(chain.parameters())
    # Of 57 numbers, one is beyond four standard errors in one of 300 choices of the noise.
    assert max(found.values()) < 4
    assert not analysis.failed_checks


def test_a_short_dwell_is_no_point_of_the_response(tmp_path):
    """Dwells that end too early are not in the frequency response, but are still shown."""
    omegas = grid(ONE, 5.0, 45.0, 9)
    periods = [2.3 if 12 < omega < 14 else 60 for omega in omegas]
    analysis = dwells(tmp_path / "lab", ONE, omegas, periods=periods)
    (response,) = analysis.frequency_responses
    short = f"sine-{periods.index(2.3)}"
    assert short not in response.experiments
    assert [p.experiment for p in analysis.sine_points if not p.settled] == [short]


@pytest.mark.parametrize(
    ("chain", "low", "high", "names"),
    [
        (ONE, 2.0, 9.0, {"omega_n"}),
        (ONE, 18.0, 45.0, {"omega_n"}),
        (TWO, 2.0, 20.0, {"omega_b", "omega_2"}),
        (TWO, 2.0, 34.5, {"omega_b"}),
        (TWO, 14.0, 60.0, {"omega_a"}),
        (THREE, 2.0, 28.0, {"omega_c", "omega_y"}),
    ],
)
def test_a_resonance_beyond_the_points_is_extrapolated(tmp_path, chain, low, high, names):
    """Such a number has no ±, a check fails, and the summary names the frequency of a dwell."""
    omegas = grid(chain, low, high, 12)
    analysis = dwells(tmp_path / "lab", chain, omegas, periods=[60] * len(omegas))
    claimed = {row.name for row in analysis.rows if row.final}
    failed = {check.parameter for check in analysis.failed_checks if check.kind == "covered"}
    assert failed == names & claimed
    finals = {row.name: row.final.value for row in analysis.rows if row.final}
    model = {row.name for row in analysis.rows if row.determined_by == "model"}
    told = terminal_summary(analysis)
    for name in failed:
        assert name in model
        if name != "omega_2":  # the summary lists resonances only
            assert "extrapolated" in told
        assert f"{finals[name]:.3g}" in told.partition("dwells")[2]
    assert failed.isdisjoint(question.id for question in ask(analysis))
    assert '"determined_by": "model"' in json_text(analysis)


def test_a_gap_of_points_at_a_resonance_is_extrapolation(tmp_path):
    """Points far below and far above a resonance do not measure it."""
    omegas = [w for w in grid(TWO, 2.0, 90.0, 25) if not 28 < w < 50]
    analysis = dwells(tmp_path / "lab", TWO, omegas, periods=[60] * len(omegas))
    assert {row.name for row in analysis.rows if row.extrapolated} >= {"omega_b", "zeta_b"}


@pytest.mark.parametrize("chain", [ONE, TWO, THREE])
def test_points_on_every_peak_measure_it(tmp_path, chain):
    """With points at all resonances and nulls, nothing is extrapolated."""
    omegas = grid(chain, 2.0, 60.0, 12)
    analysis = dwells(tmp_path / "lab", chain, omegas, periods=[60] * len(omegas))
    assert {row.determined_by for row in analysis.rows} <= {"points", "parameters", None}
    assert not analysis.failed_checks
