"""The whole analysis of carts that lack springs at one wall or both, down to a free body."""

import json
import re
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from pipeline.arrays import Array
from pipeline.json_files import json_text
from pipeline.plant.chain import Chain
from pipeline.plant.simulate import simulate_linear
from pipeline.report.builder import Page
from pipeline.report.lab_report import build_document
from pipeline.report.sections.parameters import parameter_table
from pipeline.report.sections.summary import terminal_summary
from pipeline.resources import EXAMPLES
from pipeline.results import Analysis
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse

COUNT = 0.00227  # cm, the encoder step
RATE = 200.0  # Hz
BODY = Chain(m=np.array([3e-4]), c=np.array([1e-3]), k=np.zeros(2))  # in V, cm, s; slows in 0.3 s
# Four standard errors: only one in 16 000 parameters is further off by chance.
SIGMAS = 4.0


def record(folder: Path, chain: Chain, name: str, u: Array, *, rng: np.random.Generator) -> None:
    """Write the encoder readings of a run from rest under input u (n,) as `data/NAME.csv`."""
    t = np.arange(u.size) / RATE
    y = simulate_linear(chain, t, u)
    y = COUNT * np.round((y + rng.normal(0, COUNT / 4, y.shape)) / COUNT)
    header = ",".join(["time", "input", *(f"x{cart}" for cart in range(1, chain.n + 1))])
    (folder / "data").mkdir(parents=True, exist_ok=True)
    np.savetxt(
        folder / "data" / f"{name}.csv",
        np.vstack([t, u, y]).T,
        delimiter=",",
        header=header,
        comments="",
        fmt="%.8g",
    )


def analysed(folder: Path, *, springs: str, carts: int, runs: dict[str, str]) -> Analysis:
    """Analyse a submission; `runs` maps each experiment's id to the other lines of its table."""
    text = f'version = 1\ntitle = "Few springs"\n[system]\ncarts = {carts}\n'
    text += f'springs = {springs}\nposition = {{ unit = "cm" }}\n'
    for name, lines in runs.items():
        text += f'[[experiments]]\nid = "{name}"\nfile = "data/{name}.csv"\n{lines}\n'
    (folder / "submission.toml").write_text(text, encoding="utf-8")
    return analyse(load_submission(folder))


def dwells(
    folder: Path, frequencies: list[float], *, rng: np.random.Generator, chain: Chain = BODY
) -> dict[str, str]:
    """Write sine dwells of about 1 cm at `frequencies` (Hz); return their tables for `analysed`."""
    runs = {}
    for frequency in frequencies:
        omega = 2 * np.pi * frequency
        size = 1.0 / np.abs(chain.frequency_response(np.array([omega]))[0, 0])
        t = np.arange(int(10 * RATE)) / RATE
        name = f"sine-{frequency:g}"
        record(folder, chain, name, size * np.sin(omega * t), rng=rng)
        runs[name] = f'kind = "sine"\nfrequency = {frequency}'
    return runs


def assert_body_found(analysis: Analysis) -> None:
    """Assert that mass and damping are known to 3 % and right within `SIGMAS` standard errors."""
    final = {row.name: row.final for row in analysis.rows}
    assert list(final) == ["mass", "damping"]
    for name, truth in {"mass": BODY.m[0], "damping": BODY.c[0]}.items():
        estimate = final[name]
        assert estimate is not None
        assert estimate.std is not None
        assert estimate.std < 0.03 * truth
        assert abs(estimate.value - truth) < SIGMAS * estimate.std
    assert "null" in json_text(analysis)


@pytest.mark.parametrize(
    "k",
    [(0.06, 0.0), (0.0, 0.06), (0.05, 0.08, 0.0), (0.0, 0.08, 0.05), (0.05, 0.09, 0.08, 0.0)],
    ids=str,
)
def test_carts_on_some_springs_are_found(tmp_path, k):
    """Whichever wall lacks a spring, every named parameter of the carts is found."""
    m, c = np.array([3e-4, 2.5e-4, 2e-4]), np.array([1.2e-3, 8e-4, 6e-4])
    chain = Chain(m=m[: len(k) - 1], c=c[: len(k) - 1], k=np.array(k))
    write_submission(tmp_path / "bench", SimulatedBench(chain=chain), seed=len(k), compact=True)
    analysis = analyse(load_submission(tmp_path / "bench"))
    assert analysis.fit is not None
    assert analysis.fit.converged
    assert [check.id for check in analysis.checks if check.outcome == "fail"] == []
    for name, truth in chain.parameters().items():
        estimate = analysis.fit.parameters[name]
        assert estimate.std is not None
        assert abs(estimate.value - truth) < SIGMAS * estimate.std, name


@pytest.mark.parametrize("frequencies", [[0.5, 2.0], [0.5, 1.0, 2.0], [0.4, 0.6, 1.0, 1.5, 2.5]])
def test_dwells_give_mass_and_damping_of_a_free_body(tmp_path, frequencies):
    """Two dwells suffice for a free body: two amplitudes and two phases give mass and damping."""
    runs = dwells(tmp_path, frequencies, rng=np.random.default_rng(len(frequencies)))
    analysis = analysed(tmp_path, springs="[false, false]", carts=1, runs=runs)
    assert analysis.fit is not None
    assert analysis.fit.method == "bode_fit"
    assert_body_found(analysis)


def test_a_step_gives_mass_and_damping_of_a_free_body(tmp_path):
    """Without dwells, a run under constant force gives a free body's mass and damping."""
    t = np.arange(int(4 * RATE)) / RATE
    u = 5e-3 * (np.where(t > 0.2, 1.0, 0.0) - np.where(t > 2.0, 1.0, 0.0))
    record(tmp_path, BODY, "push", u, rng=np.random.default_rng(1))
    runs = {"push": 'kind = "step"'}
    analysis = analysed(tmp_path, springs="[false, false]", carts=1, runs=runs)
    assert analysis.fit is not None
    assert analysis.fit.method == "time_fit"
    assert_body_found(analysis)
    assert "step gain" in {skip.stage for skip in analysis.skipped}


def test_two_carts_without_wall_springs_are_found(tmp_path):
    """Two carts without wall springs have masses, dampings and one spring, but no static gains."""
    chain = Chain(m=np.array([3e-4, 2e-4]), c=np.array([1e-3, 6e-4]), k=np.array([0, 0.06, 0]))
    t = np.arange(int(8 * RATE)) / RATE
    u = 0.02 * np.sin(2 * np.pi * (0.5 + 0.3 * t) * t)
    record(tmp_path, chain, "sweep", u, rng=np.random.default_rng(2))
    runs = {"sweep": 'kind = "sweep"'}
    analysis = analysed(tmp_path, springs="[false, true, false]", carts=2, runs=runs)
    fit = analysis.fit
    assert fit is not None
    assert fit.converged
    truth = [*chain.m, *chain.c, chain.k[1]]
    found = [*fit.chain.m, *fit.chain.c, fit.chain.k[1]]
    assert np.all(np.abs(np.subtract(found, truth)) < SIGMAS * np.sqrt(np.diag(fit.covariance)))
    assert {"named parameters", "step gain"} <= {skip.stage for skip in analysis.skipped}


@pytest.mark.parametrize(
    "springs", [(False, True, False), (True, False, False)], ids=["no wall", "not joined"]
)
def test_wrongly_stated_springs_are_questioned(tmp_path, springs):
    """If no carts fit the stated springs, the summary asks about them, and no section is empty."""
    shutil.copytree(EXAMPLES / "two-cart", tmp_path / "bench")  # its cart 2 has a spring to a wall
    toml = tmp_path / "bench" / "submission.toml"
    text = re.sub("springs = .*", f"springs = {json.dumps(springs)}", toml.read_text("utf-8"))
    toml.write_text(text, encoding="utf-8")
    analysis = analyse(load_submission(tmp_path / "bench"))

    assert analysis.fit is None
    assert "springs" in terminal_summary(analysis).partition("next")[2]
    (model,) = (s for s in build_document(analysis).sections if s.id == "model")
    kinds = [block.kind for block in model.blocks]
    assert "heading" not in [kinds[-1], *(a for a, b in pairwise(kinds) if a == b)]
    assert len(parameter_table(Page(analysis)).head) == 4
