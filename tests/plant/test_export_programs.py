"""The model in C, in Octave, as an FMU and in python-control moves as our simulator does.

The exported programs take second-order steps of h s. They make an oscillation of ω rad/s too fast
by the factor 1 + (ω h)² / 24. The fastest motion here has ω = 35. With h = 0.125 ms, its phase is
off by ω t (ω h)² / 24 = 4e-5 rad after 1.5 s. A contact in the backlash is faster, with ω = 370.
"""

import io
import subprocess
import zipfile
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave
from fmpy.validation import validate_fmu
from numpy.testing import assert_allclose, assert_array_equal

from pipeline.arrays import Array
from pipeline.plant import export as fmu_module
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.catalogue import CATALOGUE, find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain, Effect
from pipeline.plant.export import Description, fmu, matlab_source
from pipeline.setup import PAPER_UNITS
from tests.helpers.effects import SIZES, make_term
from tests.helpers.exported import OCTAVE, CompiledModel, no_compiler, no_octave

CHAIN = PRESETS["throne-2dof"]
T = np.arange(0.0, 1.5, 0.002)
STEP = np.where((T >= 0.1) & (T < 0.9), 0.05, 0.0)
SWEEP = 0.05 * np.sin(2 * np.pi * (0.5 * T + 2.0 * T**2))  # from 0.5 to 6.5 Hz
RUNS: dict[str, tuple[Array, Array]] = {
    "step": (STEP, np.zeros(2)),
    "sweep": (SWEEP, np.zeros(2)),
    "release": (np.zeros(T.size), np.array([1.5, 0.5])),
}
SMOOTH, KNOCKS = 4e-5, 1e-3


def model_of(*keys: str, last: bool = True) -> AugmentedChain:
    """Return the carts with effects of clearly visible sizes."""
    effects = [find_effect(key) for key in keys]
    places = [(one.places((True, True, True)) or (0,))[-1 if last else 0] for one in effects]
    terms = [
        make_term(effect, place=place, values=SIZES[effect.key], chain=CHAIN)
        for effect, place in zip(effects, places, strict=True)
    ]
    return AugmentedChain(chain=CHAIN, terms=tuple(terms))


def compiled(
    model: AugmentedChain, folder: Path, *, free: Collection[int] | None = None
) -> CompiledModel:
    return CompiledModel(Description(model, units=PAPER_UNITS, free=free), folder)


def off(found: Array, expected: Array) -> float:
    """Return the RMS of the difference, divided by the RMS of the expected motion."""
    return float(np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected**2)))


HARD = model_of("coulomb_friction", "backlash", "input_delay", last=False)


@no_compiler
@pytest.mark.parametrize("effect", CATALOGUE, ids=lambda effect: effect.key)
def test_c_moves_as_the_simulator_does(effect: Effect, tmp_path):
    """With each effect the C program agrees with the simulator; shorter steps agree better.

    In theory a quarter of the step gives a sixteenth of the error, but an event may spoil that.
    """
    model = model_of(effect.key)
    in_c = compiled(model, tmp_path)
    step = float(Description(model, units=PAPER_UNITS).parameters[-1].text)
    for u, x0 in RUNS.values():
        expected = simulate_augmented(model, T, u, x0=x0)
        limit = KNOCKS if effect.has_play else SMOOTH
        assert off(in_c.simulate(T, u, x0=x0), expected) < limit
        assert off(in_c.simulate(T, u, x0=x0, step=step / 4), expected) < limit / 4


@no_compiler
@pytest.mark.parametrize("free", [1, 2])
def test_a_cart_that_was_always_held_does_not_move(free, tmp_path):
    """A cart that is held in all runs does not move and adds no parameters to the model."""
    model = model_of("coulomb_friction", "cubic_spring", last=free == 2)
    names = {p.name for p in Description(model, units=PAPER_UNITS, free=(free,)).parameters}
    assert f"m{free}" in names
    assert not {f"m{3 - free}", f"c{3 - free}", "k1" if free == 2 else "k3"} & names
    in_c = compiled(model, tmp_path, free=(free,))
    for u, x0 in RUNS.values():
        start = np.where(np.arange(1, 3) == free, x0, 0.0)
        expected = simulate_augmented(model, T, u, x0=start, free=(free,))
        found = in_c.simulate(T, u, x0=start)
        assert_array_equal(found[2 - free], 0.0)
        assert_allclose(found, expected, atol=SMOOTH)


@no_compiler
@pytest.mark.parametrize("interval", [1e-5, 1e-3, 7e-3])
def test_a_delay_is_right_at_any_step_length(interval, tmp_path):
    """A delay shifts the whole motion by the same time, at any step length.

    The model stores up to 254 jumps of the input during a delay. If there are more, as here with
    one every 10 µs, it delays their mean.
    """
    delay = SIZES["input_delay"]["delay"]
    t = np.arange(0.0, 0.2, interval)
    u = np.full(t.size, 0.05)
    if interval < 1e-4:
        u[1::2], u[::2] = 0.0, 0.1
    (tmp_path / "late").mkdir()
    (tmp_path / "prompt").mkdir()
    late = compiled(model_of("input_delay"), tmp_path / "late").simulate(t, u, x0=np.zeros(2))
    prompt = compiled(model_of(), tmp_path / "prompt").simulate(t, u, x0=np.zeros(2))
    assert_array_equal(late[:, t <= delay - interval], 0.0)
    shifted = np.array([np.interp(t - delay, t, y, left=0.0) for y in prompt])
    # Linear interpolation is off by up to a interval² / 8, with the acceleration a = 160 cm/s².
    assert_allclose(late, shifted, atol=160 * interval**2 / 8 + 2e-5)


# --------------------------------------------------------------- MATLAB, Octave


def in_octave(models: dict[str, AugmentedChain], runs: str, folder: Path) -> dict[str, Array]:
    """Return the numbers that a script prints for each model, one row per time."""
    found = {}
    for name, model in models.items():
        home = folder / name
        home.mkdir()
        source = matlab_source(Description(model, units=PAPER_UNITS))
        (home / "model.m").write_text(source, encoding="ascii")
    script = "".join(
        f"cd('{folder / name}'); clear model\n{runs.format(out=f'{name}.txt')}" for name in models
    )
    (folder / "all.m").write_text(script, encoding="ascii")
    command = [str(OCTAVE), "--norc", "--no-gui", "all.m"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in models:
        found[name] = np.loadtxt(folder / name / f"{name}.txt").T
    return found


@pytest.mark.slow
@pytest.mark.sample
@no_octave
@no_compiler
def test_octave_moves_as_c_does_with_every_effect(tmp_path):
    """With all effects, Octave and C differ only by rounding."""
    keys = [effect.key for effect in CATALOGUE]
    models = {
        "many": model_of(*(key for key in keys if key != "coulomb_friction"), last=False),
        "few": model_of("coulomb_friction", "input_delay", "load_friction"),
        "none": model_of(),
    }
    runs = (
        "t = (0:0.004:0.1)'; u = 0.05 * (t > 0.01);\n"
        "y = model('simulate', t, u, [], [0.9 0.2]); save('-ascii', '-double', '{out}', 'y')\n"
    )
    found = in_octave(models, runs, tmp_path)
    t = np.arange(0.0, 0.1001, 0.004)
    for name, model in models.items():
        (tmp_path / f"c-{name}").mkdir()
        in_c = compiled(model, tmp_path / f"c-{name}")
        y = in_c.simulate(t, np.where(t > 0.01, 0.05, 0.0), x0=np.array([0.9, 0.2]))
        assert_allclose(found[name], y, atol=1e-9)


# -------------------------------------------------------------------------- FMU


@pytest.fixture(scope="module")
def hard_fmu(tmp_path_factory) -> Path:
    whole, _ = fmu(Description(HARD, units=PAPER_UNITS))
    path = tmp_path_factory.mktemp("fmu") / "model.fmu"
    path.write_bytes(whole)
    return path


def simulate_in_fmpy(path: Path, u: Array, x0: Array) -> Array:
    """Return the readings (carts, samples), with the input held from sample to sample."""
    instance, refer = instantiate(path)
    values = {f"x{i + 1}_start": x for i, x in enumerate(x0)}
    y = run(instance, refer, u, values)
    instance.terminate()
    instance.freeInstance()
    return y


def instantiate(path: Path) -> tuple[FMU2Slave, dict[str, int]]:
    """Return an instance of the model, and the references of its variables."""
    description = read_model_description(str(path))
    instance = FMU2Slave(
        guid=description.guid,
        unzipDirectory=extract(str(path), unzipdir=str(path.parent / "whole")),
        modelIdentifier="model",
        instanceName="one",
    )
    instance.instantiate()
    return instance, {v.name: v.valueReference for v in description.modelVariables}


def run(instance, refer, u: Array, values) -> Array:
    instance.setupExperiment(startTime=0.0)
    instance.enterInitializationMode()
    instance.setReal([refer[name] for name in values], list(values.values()))
    instance.exitInitializationMode()
    outputs = [refer["x1"], refer["x2"]]
    y = [instance.getReal(outputs)]
    for k in range(T.size - 1):
        instance.setReal([refer["u"]], [u[k]])
        instance.doStep(currentCommunicationPoint=T[k], communicationStepSize=T[k + 1] - T[k])
        y.append(instance.getReal(outputs))
    return np.array(y).T


@no_compiler
def test_fmpy_finds_no_fault_in_the_fmu(hard_fmu, tmp_path):
    """FMPy finds no fault in the FMU's schema, names, units and structure, with every effect."""
    assert validate_fmu(str(hard_fmu)) == []
    everything = model_of(*(effect.key for effect in CATALOGUE))
    for name, model in (("all", everything), ("none", model_of())):
        whole, compiled_too = fmu(Description(model, units=PAPER_UNITS, sign_reversed=True))
        (tmp_path / f"{name}.fmu").write_bytes(whole)
        assert compiled_too
        assert validate_fmu(str(tmp_path / f"{name}.fmu")) == []


@no_compiler
@pytest.mark.parametrize("name", RUNS)
def test_fmpy_moves_as_the_simulator_does(name, hard_fmu):
    """With friction, play and delay, the FMU in FMPy agrees with the simulator."""
    u, x0 = RUNS[name]
    found = simulate_in_fmpy(hard_fmu, u, x0)
    assert off(found, simulate_augmented(HARD, T, u, x0=x0)) < KNOCKS


@no_compiler
def test_an_fmu_can_be_reset_and_returned_to_a_state(hard_fmu):
    """After a reset an FMU repeats its run, and from a saved state it continues as before."""
    instance, refer = instantiate(hard_fmu)
    values = {"x1_start": 1.5, "x2_start": 0.5, "m1": 2 * CHAIN.m[0]}
    first = run(instance, refer, STEP, values)
    state = instance.getFMUstate()
    kept = instance.serializeFMUstate(state)
    instance.doStep(currentCommunicationPoint=T[-1], communicationStepSize=0.1)
    after = instance.getReal([refer["x1"], refer["v1"], refer["x_motor"]])
    instance.setFMUstate(instance.deSerializeFMUstate(kept))
    instance.doStep(currentCommunicationPoint=T[-1], communicationStepSize=0.1)
    assert instance.getReal([refer["x1"], refer["v1"], refer["x_motor"]]) == after
    instance.reset()
    assert_array_equal(run(instance, refer, STEP, values), first)
    instance.reset()
    assert off(run(instance, refer, STEP, {**values, "m1": CHAIN.m[0]}), first) > 0.1
    instance.freeInstance()


def test_without_a_compiler_the_fmu_has_only_sources(monkeypatch):
    """Without a compiler the FMU has only sources, and `fmu` reports that nothing was compiled."""
    monkeypatch.setattr(fmu_module.shutil, "which", lambda name: None)
    whole, compiled_too = fmu(Description(HARD, units=PAPER_UNITS))
    assert not compiled_too
    names = zipfile.ZipFile(io.BytesIO(whole)).namelist()
    assert {f"sources/{n}" for n in ("model.c", "model.h", "fmi2.c", "fmi2.h")} <= {*names}
    assert not [name for name in names if name.startswith("binaries")]
