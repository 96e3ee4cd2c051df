"""The first cause that a report names: wrong springs and units before anything that follows."""

import re
import shutil
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest

from pipeline.names import toml_flags
from pipeline.plant.chain import Chain
from pipeline.report.sections.questions import ask
from pipeline.report.sections.summary import terminal_summary
from pipeline.results import Analysis
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.workflow import analyse


def bench_of(k: tuple[float, ...]) -> SimulatedBench:
    """Return a bench of two or three carts."""
    m, c = np.array([3e-4, 2.5e-4, 2e-4]), np.array([1.2e-3, 8e-4, 6e-4])
    return SimulatedBench(chain=Chain(m=m[: len(k) - 1], c=c[: len(k) - 1], k=np.array(k)))


def stated(folder: Path, k: tuple[float, ...], springs: str) -> Analysis:
    """Analyse recordings of a bench whose springs are stated as given."""
    write_submission(folder, bench_of(k), seed=3, compact=True)
    path = folder / "submission.toml"
    text = re.sub(r"springs = .*", f"springs = {springs}", path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")
    return analyse(load_submission(folder), design=False)


def first_step(analysis: Analysis) -> str:
    """Return the first thing that the summary says to do."""
    return terminal_summary(analysis).partition("What to do next.")[2].strip().split("\n")[0]


@pytest.mark.parametrize(
    ("k", "springs", "name"),
    [
        ((0.06, 0.08, 0.05), "[true, true, false]", "2-wall"),
        ((0.06, 0.08, 0.05), "[false, true, true]", "wall-1"),
        ((0.06, 0.08, 0.0), "[true, true, true]", "2-wall"),
        ((0.05, 0.09, 0.08, 0.06), "[true, true, true, false]", "3-wall"),
        ((0.05, 0.09, 0.08, 0.0), "[true, true, true, true]", "3-wall"),
    ],
)
def test_a_wrong_spring_is_the_first_cause(tmp_path, k, springs, name):
    """The summary and the questions name a spring too many or too few before its consequences."""
    analysis = stated(tmp_path / "lab", k, springs)
    told = first_step(analysis)
    assert f"spring {name}" in told
    assert f"springs = {toml_flags(map(bool, k))}" in told
    assert all(question.kind in ("springs", "assumed") for question in ask(analysis))
    spring = next(a for a in analysis.assumptions if a.about == name)
    assert spring.support == "contradicted"


@pytest.mark.parametrize("scale", [10.0, 0.01])
def test_a_unit_wrong_by_a_power_of_ten_is_the_first_cause(tmp_path, scale):
    """Positions in mm or m that are stated in cm show it by the size of their encoder steps."""
    folder = tmp_path / "lab"
    write_submission(folder, bench_of((0.06, 0.08, 0.05)), seed=3, compact=True)
    for path in (folder / "data").glob("*.csv"):
        lines = path.read_text(encoding="utf-8").splitlines()
        at = [i for i, name in enumerate(lines[0].split(",")) if re.fullmatch(r"x\d", name)]
        rows = np.genfromtxt(lines[1:], delimiter=",")
        rows[:, at] *= scale
        np.savetxt(path, rows, delimiter=",", header=lines[0], comments="", fmt="%.8g")
    analysis = analyse(load_submission(folder), design=False)
    assert analysis.failed_checks[0].id == "position_unit"
    assert f"{scale:g} times a count" in terminal_summary(analysis)
    assert "unit of the positions" in first_step(analysis)


@pytest.mark.parametrize("heavy", ["s[tw]", "decay-1", "none"])
def test_recordings_of_heavier_carts_are_named(tmp_path, heavy):
    """Steps, or decays, made with 1.5 times the first mass are a group with their own numbers."""
    light = bench_of((0.06, 0.08, 0.05))
    masses = np.array([1.5, 1.0]) * light.chain.m
    write_submission(tmp_path / "lab", light, seed=3)
    other = SimulatedBench(chain=replace(light.chain, m=masses))
    write_submission(tmp_path / "other", other, seed=3)
    for path in (tmp_path / "other" / "data").glob(f"{heavy}*.csv"):
        shutil.copy(path, tmp_path / "lab" / "data" / path.name)
    analysis = analyse(load_submission(tmp_path / "lab"), design=False)
    assert [check.kind for check in analysis.causes] == ([] if heavy == "none" else ["groups"])
    if heavy != "none":
        first, second = analysis.groups
        assert all(fnmatch(name, f"{heavy}*") for name in second.experiments)
        (name,) = first.values
        # A mass 1.5 times as large lowers the cart's frequency by the square root of 1.5.
        ratio = 1.5 if name == "m_1" else 1.5**-0.5
        assert second.values[name] / first.values[name] == pytest.approx(ratio, rel=0.02)
