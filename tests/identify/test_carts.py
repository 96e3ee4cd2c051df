"""The checks find fitted masses, dampers and springs that may not exist on the bench."""

import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.estimation.estimates import SIGMA_LIMIT
from pipeline.identify.model_checks import NEGLIGIBLE, check_carts, check_vanishing, say_law
from pipeline.names import toml_flags
from pipeline.plant.chain import PRESETS, Chain
from pipeline.resources import EXAMPLES
from pipeline.results import ChainFit, Check
from pipeline.setup import Setup
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.analysis_factory import make_analysis
from tests.helpers.places import REAL_DATA
from tests.helpers.ucsd import write_two_cart_submission


def fitted(
    chain: Chain, *, relative: float = 1e-3, converged: bool = True, **std: float
) -> ChainFit:
    """Return a fit of a chain with the given standard errors, relative or by name."""
    values = {f"m_{i}": v for i, v in enumerate(chain.m, 1)}
    values |= {f"c_{i}": v for i, v in enumerate(chain.c, 1)}
    values |= {f"k_{i}": v for i, v in enumerate(chain.k, 1) if v or f"k_{i}" in std}
    errors = np.array([std.get(name, relative * value) for name, value in values.items()])
    return ChainFit(
        method="bode_fit",
        chain=chain,
        names=tuple(values),
        covariance=np.diag(errors**2),
        parameters={},
        chi_square_per_dof=1.0,
        dof=10,
        n_points=20,
        n_starts=1,
        converged=converged,
        message="",
    )


def vanishing(checks: tuple[Check, ...]) -> dict[str, str]:
    """Return, by parameter name, the message about each part that may not exist."""
    return {check.about: check.message for check in checks if check.kind == "vanishing"}


@pytest.mark.parametrize(
    ("name", "value", "std", "found", "limit"),  # in standard errors, or as a share of a neighbour
    [
        ("k_1", 2e-6, 5e-6, 0.4, SIGMA_LIMIT),
        ("k_1", 1e-3, 2e-5, 0.0078, NEGLIGIBLE),
        ("k_1", 0.0, 5e-6, 0.0, SIGMA_LIMIT),
        ("c_2", 3e-5, 2e-5, 1.5, SIGMA_LIMIT),
        ("c_2", 5e-6, 1e-7, 0.0075, NEGLIGIBLE),
        ("m_2", 3e-6, 1e-7, 0.0096, NEGLIGIBLE),
    ],
)
def test_a_part_that_may_not_exist_fails_a_check(name, value, std, found, limit):
    """A check fails if a parameter is zero within its error, or tiny compared with its neighbour.

    The message asks whether the part exists and gives the line to change.
    """
    plant = PRESETS["throne-2dof"]
    values = {"m": plant.m.copy(), "c": plant.c.copy(), "k": plant.k.copy()}
    values["k"][0] = 0.1
    symbol, _, number = name.partition("_")
    values[symbol][int(number) - 1] = value
    (check,) = check_vanishing(
        fitted(Chain(**values), **{name: std}), bench=Setup(springs=(True,) * 3)
    )
    assert (check.id, check.outcome, check.limit) == (f"vanishing.{name}", "fail", limit)
    assert check.value == pytest.approx(found, rel=0.01)
    codes = {"k": "no_end_spring", "c": "no_damping", "m": "no_cart"}
    assert check.code == codes[symbol]
    lines = {"k": "springs = [false, true, true]", "c": 'kind = "decay"', "m": "carts = 1"}
    assert lines[symbol] in check.message


def test_a_vanishing_damping_is_taken_from_a_decay_that_exists():
    """The message never asks for a decay that the submission has."""
    analysis = make_analysis(2)
    plant = PRESETS["throne-2dof"]
    fit = fitted(Chain(m=plant.m, c=np.array([plant.c[0], 1e-7]), k=plant.k), c_2=1e-7)
    bench = Setup(springs=(False, True, True))
    (check,) = check_vanishing(fit, decays=analysis.log_decrements, bench=bench)
    assert (check.parameter, check.code) == ("c_2", "damping_of_decay")
    assert all(d.experiment in check.message for d in analysis.log_decrements if d.cart == 2)


def test_the_residual_of_a_failed_fit_is_not_judged():
    """A fit that failed is not said to explain the data, whatever its χ²."""
    fit = fitted(PRESETS["throne-2dof"], converged=False)
    outcomes = {c.id: c.outcome for c in check_carts(fit, bench=Setup(springs=(True,) * 3))}
    assert outcomes == {"fit.converged": "fail", "fit.explains_data": "skip"}


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_a_spring_declared_as_missing_is_not_asked_about(preset):
    """If a spring is declared as missing, no check asks about it.

    The paper's plants have no spring between the wall and cart 1.
    """
    chain = PRESETS[preset]
    springs = tuple(bool(k > 0) for k in chain.k)
    assert check_vanishing(fitted(chain), bench=Setup(springs=springs)) == []
    assert (
        check_vanishing(fitted(chain, converged=False), bench=Setup(springs=(True,) * len(springs)))
        == []
    )
    found = check_vanishing(fitted(chain), bench=Setup(springs=(True,) * len(springs)))
    assert [check.id for check in found] == ([] if chain.n == 1 else ["vanishing.k_1"])


@pytest.mark.parametrize("name", ["two-cart", "three-cart"])
def test_a_spring_too_many_is_found_on_the_examples(name, tmp_path):
    """If an example declares one spring too many, the message gives the right `springs` line."""
    shutil.copytree(EXAMPLES / name, tmp_path / "s")
    toml = tmp_path / "s" / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    right = next(line for line in text.splitlines() if line.startswith("springs = "))
    toml.write_text(text.replace(right, right.replace("false", "true")), encoding="utf-8")
    said = vanishing(analyse(load_submission(tmp_path / "s"), design=False).checks)
    assert list(said) == ["k_1"]
    assert right in said["k_1"]
    assert tomllib.loads(right)["springs"][0] is False


@pytest.mark.skipif(not (REAL_DATA / "ecp210-ucsd").is_dir(), reason="the recordings are not here")
def test_a_far_spring_that_the_real_rig_lacks_is_asked_about(tmp_path):
    """If a far spring is declared that the real bench lacks, a check asks about it.

    The fit mistakes dry friction for a far spring with 1 % of its neighbour's stiffness; the static
    gains do not.
    """
    folder: Path = write_two_cart_submission(tmp_path / "s", REAL_DATA, steps=(1, 2, 3, 4, 5))
    assert vanishing(analyse(load_submission(folder), design=False).checks) == {}
    toml = folder / "submission.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace("[true, true, false]", "[true, true, true]"), encoding="utf-8")
    checks = analyse(load_submission(folder), design=False).checks
    said = {check.about: check.message for check in checks if check.kind == "springs"}
    assert list(said) == ["k_3"]
    assert toml_flags([True, True, False]) in said["k_3"]


@pytest.mark.parametrize(("size", "side"), [(0.02, "higher"), (-0.02, "lower")])
def test_the_frequency_of_large_swings_is_said_as_it_is(size, side):
    """`say_law` calls the frequency of large swings higher if the size of the law is positive."""
    (decay, *_) = make_analysis(1).log_decrements
    law = replace(decay.law, name="frequency_shift", size=size, size_std=1e-3)
    said = say_law(replace(decay, law=law), unit="cm")
    assert [word for word in ("higher", "lower") if word in said] == [side]
