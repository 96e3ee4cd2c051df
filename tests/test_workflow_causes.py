"""The first cause that a report names: wrong springs and units before anything that follows."""

import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatch
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from pipeline.gap.explain import investigate
from pipeline.identify.findings import say
from pipeline.names import read_name, toml_flags
from pipeline.plant.chain import PRESETS, Chain
from pipeline.report.gap_verdict import terminal_verdict
from pipeline.report.sections.questions import ask
from pipeline.report.sections.summary import terminal_summary
from pipeline.results import Analysis
from pipeline.simulated.bench import SimulatedBench
from pipeline.simulated.hidden import prepare_bench
from pipeline.simulated.submission import write_submission
from pipeline.submission import load_submission
from pipeline.submission.load import spring_names
from pipeline.words.progress import silent
from pipeline.workflow import analyse
from tests.helpers.honest_benches import draw_effect

_LONG = (pytest.mark.slow, pytest.mark.sample)


def bench_of(k: tuple[float, ...]) -> SimulatedBench:
    """Return a bench of two or three carts."""
    m, c = np.array([3e-4, 2.5e-4, 2e-4]), np.array([1.2e-3, 8e-4, 6e-4])
    return SimulatedBench(chain=Chain(m=m[: len(k) - 1], c=c[: len(k) - 1], k=np.array(k)))


def stated(folder: Path, k: tuple[float, ...], springs: str) -> Analysis:
    """Analyse recordings of a bench whose springs are stated as given."""
    write_submission(folder, bench_of(k), seed=3, compact=True)
    return restated(folder, "springs = .*", f"springs = {springs}")


def restated(folder: Path, old: str, new: str) -> Analysis:
    """Analyse a submission after a change of its `submission.toml`."""
    path = folder / "submission.toml"
    path.write_text(re.sub(old, new, path.read_text(encoding="utf-8")), encoding="utf-8")
    return analyse(load_submission(folder), design=False)


def first_step(analysis: Analysis) -> str:
    """Return the first thing that the summary says to do."""
    return terminal_summary(analysis).partition("What to do next.")[2].strip().split("\n")[0]


_TWO, _THREE = (0.06, 0.08, 0.05), (0.05, 0.09, 0.08, 0.06)
_QUICK = [  # two springs at a wall, none between, or one of them, or too many
    (_TWO, (False, True, True)),
    (_TWO, (True, False, True)),
    (_TWO, (False, False, False)),
    ((0.0, *_TWO[1:]), (True, True, False)),
    ((*_TWO[:-1], 0.0), (True, True, True)),
    (_THREE, (True, False, False, True)),
    ((0.0, *_THREE[1:]), (False, True, True, False)),
    ((*_THREE[:-1], 0.0), (True, True, True, True)),
]


def wrong_springs() -> Iterator[tuple[tuple[float, ...], tuple[bool, ...]]]:
    """Yield stiffnesses of carts tied to a wall, and springs of which one or more are wrong."""
    for k in (_TWO, _THREE):
        for first, last in [(True, True), (False, True), (True, False)]:
            own = (k[0] * first, *k[1:-1], k[-1] * last)
            for springs in product((False, True), repeat=len(k)):
                wrong = sum(a is not b for a, b in zip(map(bool, own), springs, strict=True))
                if 0 < wrong <= 4 - len(k) + 1 and (own, springs) not in _QUICK:
                    yield own, springs


def assert_springs_come_first(
    folder: Path, k: tuple[float, ...], springs: tuple[bool, ...]
) -> None:
    """Assert that summary, causes, questions and assumptions name the wrong springs."""
    analysis = stated(folder, k, toml_flags(springs))
    right = [stiffness > 0 for stiffness in k]
    told = first_step(analysis)
    assert f"springs = {toml_flags(right)}" in told
    wrong = [j for j, flag in enumerate(springs) if flag is not right[j]]
    names = spring_names(len(k) - 1)
    assert all(names[j] in told for j in wrong)
    assert {cause.parameter for cause in analysis.causes} == {f"k_{j + 1}" for j in wrong}
    assert analysis.lacks_springs is any(right[j] for j in wrong)
    assert all(question.kind in ("springs", "assumed") for question in ask(analysis))
    contradicted = {one.about for one in analysis.assumptions if one.support == "contradicted"}
    assert contradicted == {names[j] for j in wrong}


@pytest.mark.parametrize(
    ("k", "springs"),
    [_QUICK[0], *(pytest.param(*one, marks=_LONG) for one in _QUICK[1:])],
    ids=str,
)
def test_a_wrong_spring_is_the_first_cause(tmp_path, k, springs):
    """Springs too many or too few are named, with the right line, before their consequences."""
    assert_springs_come_first(tmp_path / "lab", k, springs)


@pytest.mark.slow
@pytest.mark.parametrize(("k", "springs"), list(wrong_springs()), ids=str)
def test_all_wrong_springs_are_the_first_cause(tmp_path, k, springs):
    """The same for all choices of springs that are nearly right."""
    assert_springs_come_first(tmp_path / "lab", k, springs)


def test_one_cart_without_its_spring_is_the_first_cause(tmp_path):
    """One cart that comes back has a spring, and the line to write says so."""
    write_submission(
        tmp_path / "lab", SimulatedBench(chain=PRESETS["throne-1dof"]), seed=3, compact=True
    )
    told = first_step(restated(tmp_path / "lab", "springs = .*", "springs = [false, false]"))
    assert f"springs = {toml_flags([True, True])}" in told


@pytest.mark.slow
@pytest.mark.sample
def test_untied_carts_that_come_to_rest_have_a_spring(tmp_path):
    """If no linear carts fit, because of saturation, the steps still show a spring to a wall."""
    bench = prepare_bench(preset="throne-2dof", hide=["saturation"])
    write_submission(tmp_path / "lab", bench, seed=507)
    analysis = restated(tmp_path / "lab", "springs = .*", "springs = [false, true, false]")
    assert [cause.code for cause in analysis.causes] == ["tied"]
    assert analysis.causes[0].message in first_step(analysis)
    assert analysis.lacks_springs


@pytest.mark.slow
@pytest.mark.sample
def test_the_gap_of_carts_that_lack_a_spring_accuses_nothing(tmp_path):
    """Without a spring that the recordings show, the gap names it, and no effect."""
    analysis = stated(tmp_path / "lab", (0.0, 0.08, 0.05), "[false, true, false]")
    gap = investigate(analysis, progress=silent)
    (cause,) = gap.causes
    assert cause.id == "springs.k_3"
    assert cause.message in first_step(analysis)
    assert (gap.verdict, gap.effects, gap.suspects) == ("unexplained", (), ())
    assert (gap.residual, gap.contenders, gap.next_experiment) == ((), (), "")
    assert cause.message in terminal_verdict(gap)


def scaled(folder: Path, column: str, scale: float) -> None:
    """Multiply the columns whose names match in all files by `scale`."""
    for path in (folder / "data").glob("*.csv"):
        lines = path.read_text(encoding="utf-8").splitlines()
        at = [i for i, name in enumerate(lines[0].split(",")) if re.fullmatch(column, name)]
        rows = np.genfromtxt(lines[1:], delimiter=",")
        rows[:, at] *= scale
        np.savetxt(path, rows, delimiter=",", header=lines[0], comments="", fmt="%.8g")


@pytest.mark.parametrize("scale", [10.0, 0.01])
def test_a_unit_wrong_by_a_power_of_ten_is_the_first_cause(tmp_path, scale):
    """Positions in mm or m that are stated in cm show it by the size of their encoder steps."""
    folder = tmp_path / "lab"
    write_submission(folder, bench_of((0.06, 0.08, 0.05)), seed=3, compact=True)
    scaled(folder, r"x\d", scale)
    analysis = analyse(load_submission(folder), design=False)
    first = analysis.failed_checks[0]
    assert (first.id, first.code) == ("position_unit", "other_step")
    assert first.message in terminal_summary(analysis)
    assert f" {scale:g} " in first.message
    assert "unit" in first_step(analysis)


@pytest.mark.slow
@pytest.mark.sample
@pytest.mark.parametrize(
    ("scale", "unit", "why"),
    [
        (1e3, "V", "input_scale_ecp"),
        (1.0, "mV", "input_scale_small"),
        (1e3, "N", ""),
        (1.0, "V", ""),
        (1e3, "mV", ""),
    ],
)
@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof"])
def test_an_input_that_no_converter_gives_is_asked_about(tmp_path, preset, scale, unit, why):
    """Millivolts stated as volts, and volts as millivolts, are seen by what converters can give."""
    folder = tmp_path / "lab"
    write_submission(folder, SimulatedBench(chain=PRESETS[preset]), seed=3, compact=True)
    scaled(folder, "input|u", scale)
    analysis = restated(folder, r'input = \{ unit = "V"', f'input = {{ unit = "{unit}"')
    assert [check.code for check in analysis.causes] == (["input_scale"] if why else [])
    assert not why or say(why) in first_step(analysis)


_ALL = "decay,step,sine,sweep,control"


@pytest.mark.parametrize(
    ("n", "cart", "where", "noise"),
    [
        (2, 2, _ALL, "counts"),  # a dead encoder that flickers
        (2, 1, _ALL, "smooth"),  # an open analogue input
        (2, 2, "step,sweep", "counts"),
        pytest.param(2, 1, "sine", "smooth", marks=_LONG),
        (2, 2, "decay-2a", "counts"),
    ],
)
def test_a_column_of_noise_is_the_first_cause(tmp_path, n, cart, where, noise):
    """If one column holds only noise, the first step is to repair its recordings."""
    write_submission(tmp_path, bench_of(_TWO if n == 2 else _THREE), seed=3, compact=True)
    rng = np.random.default_rng(5)
    for path in (p for one in where.split(",") for p in (tmp_path / "data").glob(f"{one}*.csv")):
        lines = path.read_text(encoding="utf-8").splitlines()
        at = lines[0].split(",").index(f"x{cart}")
        rows = np.genfromtxt(lines[1:], delimiter=",")
        drawn = 2 * rng.standard_normal(len(rows))
        count = 1e-3 * float(np.ptp(rows[:, at]))
        rows[:, at] = count * (np.rint(drawn) if noise == "counts" else drawn)
        np.savetxt(path, rows, delimiter=",", header=lines[0], comments="", fmt="%.8g")
    analysis = analyse(load_submission(tmp_path), design=False)
    (reason,) = {one.reason for one in analysis.left_out if one.code == "only_noise"}
    assert {one.cart for one in analysis.left_out if one.code == "only_noise"} == {cart}
    told = first_step(analysis)
    assert reason in told
    assert where.split(",")[0].split("-")[0] in told


def mixed(folder: Path, *, n: int, cart: int, ratio: float, heavy: str) -> Analysis:
    """Analyse recordings of which some were made with another mass of one cart.

    Parameters
    ----------
    heavy : patterns of the names of the recordings with the other mass, separated by commas.
    """
    light = bench_of(_TWO if n == 2 else _THREE)
    m = light.chain.m * np.where(np.arange(1, n + 1) == cart, ratio, 1.0)
    write_submission(folder / "lab", light, seed=3, compact=True)
    other = SimulatedBench(chain=replace(light.chain, m=m))
    write_submission(folder / "other", other, seed=4, compact=True)
    for pattern in heavy.split(","):
        for path in (folder / "other" / "data").glob(f"{pattern}*.csv"):
            shutil.copy(path, folder / "lab" / "data" / path.name)
    return analyse(load_submission(folder / "lab"), design=False)


def assert_groups_differ(analysis: Analysis, *, cart: int, ratio: float, heavy: str) -> None:
    """Assert that the recordings with the other mass are a group that shows this mass."""
    assert [check.kind for check in analysis.causes] == ["groups"]
    first, second = analysis.groups
    patterns = [f"{pattern}*" for pattern in heavy.split(",")]
    held = {any(fnmatch(name, one) for one in patterns) for name in second.experiments}
    assert len(held) == 1
    if held == {False}:  # the larger group has the other mass
        ratio = 1 / ratio
    (name,) = first.values
    assert read_name(name).cart == cart
    # A frequency falls with the square root of the mass.
    expected = ratio if name == f"m_{cart}" else ratio**-0.5
    # The errors of both numbers are below 0.5 %, and the smallest difference is 5 %.
    assert second.values[name] / first.values[name] == pytest.approx(expected, rel=0.01)


_MIXED = [  # carts, the cart with another mass, its ratio, and the recordings with it
    (2, 2, 1.1, "step,sweep"),
    (2, 2, 1 / 1.1, "decay"),
    pytest.param(2, 1, 1.2, "sweep", marks=_LONG),
    pytest.param(3, 3, 1.3, "step,sweep", marks=_LONG),
]


@pytest.mark.parametrize(("n", "cart", "ratio", "heavy"), _MIXED)
def test_recordings_of_other_masses_are_named(tmp_path, n, cart, ratio, heavy):
    """Recordings made with a mass that is 10 % off or more are a group with their own number."""
    analysis = mixed(tmp_path, n=n, cart=cart, ratio=ratio, heavy=heavy)
    assert_groups_differ(analysis, cart=cart, ratio=ratio, heavy=heavy)


@pytest.mark.slow
@pytest.mark.parametrize("heavy", ["step,sweep", "decay", "sine", "step,sweep,decay", "sweep"])
@pytest.mark.parametrize("ratio", [1.1, 1.2, 1.3, 1 / 1.1, 1 / 1.3])
@pytest.mark.parametrize("cart", [1, 2, 3])
def test_any_mass_and_kind_of_recording_is_named(tmp_path, cart, ratio, heavy):
    """The same for each of three carts, masses, and kinds of recordings."""
    analysis = mixed(tmp_path, n=3, cart=cart, ratio=ratio, heavy=heavy)
    assert_groups_differ(analysis, cart=cart, ratio=ratio, heavy=heavy)


@pytest.mark.parametrize("n", [2, pytest.param(3, marks=_LONG)])
def test_recordings_of_one_bench_are_one_group(tmp_path, n):
    """Recordings of one bench cause no question, and no group."""
    analysis = mixed(tmp_path, n=n, cart=1, ratio=1.0, heavy="sweep")
    assert not analysis.causes
    assert not analysis.groups


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["throne-1dof", "throne-2dof", "throne-3dof"])
@pytest.mark.parametrize("seed", range(60, 70))
def test_an_honest_bench_has_no_groups(tmp_path, preset, seed):
    """With one hidden effect, or none, no recordings are said to want other carts."""
    chain = PRESETS[preset]
    effects = (draw_effect(chain, seed),) if seed % 3 else ()
    bench = SimulatedBench(chain=chain, effects=effects)
    write_submission(tmp_path, bench, seed=seed, compact=seed % 2 == 1)
    assert not analyse(load_submission(tmp_path), design=False).groups
