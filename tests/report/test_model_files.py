"""A model is saved in the submission's units, or the reason is given."""

from dataclasses import replace
from pathlib import Path

import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu

from pipeline.plant.catalogue import find_effect
from pipeline.plant.chain import PRESETS
from pipeline.plant.effect import AugmentedChain
from pipeline.plant.export import Description, c_sources
from pipeline.report.gap_files import FILES, clear_model, save_model
from pipeline.results import Analysis
from pipeline.setup import Units
from tests.helpers.effects import SIZES, make_term
from tests.helpers.examples import analysed
from tests.helpers.exported import CompiledModel, no_compiler

CHAIN = PRESETS["throne-1dof"]


def with_effect(key: str, **values: float) -> AugmentedChain:
    effect = find_effect(key)
    place = (effect.places((True, True)) or (0,))[0]
    term = make_term(effect, place=place, values=values or SIZES[key], chain=CHAIN)
    return AugmentedChain(chain=CHAIN, terms=(term,))


@pytest.fixture(scope="module")
def analysis() -> Analysis:
    return analysed("one-cart")


def test_the_files_are_saved_and_cleared(analysis, tmp_path):
    """All four files of a model are written, and `clear_model` removes only these."""
    (tmp_path / "model.slx").write_text("mine")
    said = save_model(with_effect("coulomb_friction"), analysis, tmp_path, free=(1,))
    assert all((tmp_path / name).stat().st_size > 1000 for name in FILES)
    assert "model.fmu" in said
    clear_model(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["model.slx"]


def test_a_drive_that_leads_its_log_is_refused(analysis, tmp_path):
    """A drive that leads its log would need future inputs: no model is saved."""
    said = save_model(with_effect("input_delay", delay=-0.01), analysis, tmp_path, free=(1,))
    assert "leads its" in said
    assert not [*tmp_path.iterdir()]


def test_the_sign_of_the_recordings_is_reported(analysis, tmp_path):
    """If the recordings count the input the other way, each file of the model says so."""
    other_way = {
        turned: [replace(r, input_scale=-1.0 if turned else 1.0) for r in analysis.records]
        for turned in (False, True)
    }
    for turned, records in other_way.items():
        model = with_effect("coulomb_friction")
        save_model(model, replace(analysis, records=tuple(records)), tmp_path, free=(1,))
        texts = [(tmp_path / name).read_text(encoding="ascii") for name in ("model.h", "model.m")]
        texts.append(next(v.description for v in read(tmp_path) if v.name == "u"))
        assert all(("other way" in text) == turned for text in texts)


def read(folder: Path) -> list:
    return read_model_description(str(folder / "model.fmu")).modelVariables


@no_compiler
@pytest.mark.parametrize("unit", ["µm", "*/ #error", "°", '"<&>', "\\", "??/", "m%n", ""])
def test_no_unit_can_break_a_file(unit, analysis, tmp_path):
    """Whatever unit a submission states, it cannot break the files of the model."""
    units = Units(position=unit, input=unit)
    bench = replace(analysis.bench, units=units)
    save_model(with_effect("cubic_spring"), replace(analysis, bench=bench), tmp_path, free=(1,))
    (tmp_path / "c").mkdir()
    CompiledModel(Description(with_effect("cubic_spring"), units=units), tmp_path / "c")
    assert validate_fmu(str(tmp_path / "model.fmu")) == []
    assert {v.unit for v in read(tmp_path) if v.name == "u"} == {unit or None}


def test_every_parameter_has_its_unit_in_the_header():
    """The C header states the submission's unit of every parameter."""
    units = Units(position="mm", input="N")
    header = c_sources(Description(with_effect("quadratic_drag"), units=units))["model.h"]
    assert "double m1; /* N s^2/mm: mass of cart 1 */" in header
    assert "quadratic_drag_1_coefficient; /* N s^2/mm^2: Quadratic drag, cart 1:" in header
