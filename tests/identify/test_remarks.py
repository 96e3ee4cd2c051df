"""Some recordings get warnings about themselves, for example about their unit."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.identify.recording_checks import reading_remarks
from pipeline.ingest.read import read_data
from pipeline.resources import EXAMPLES
from pipeline.submission import load_submission


@pytest.mark.parametrize("name", ["one-cart", "two-cart", "three-cart"])
def test_centimetres_stated_as_metres_raise_a_question(name):
    """If metres as the unit would make carts impossibly fast, a remark questions the unit.

    Centimetres, millimetres, inches and counts are not questioned.
    """
    data = read_data(load_submission(EXAMPLES / name))
    (said,) = [one for one in reading_remarks(data, unit="m") if "m/s" in one]
    assert "faster than any cart on a bench" in said
    for unit in ("cm", "mm", "in", "count"):
        assert not [
            one for one in reading_remarks(data, unit=unit) if "faster than any cart" in one
        ]


def test_one_kind_of_recording_or_a_jump_questions_no_unit():
    """If only one kind of recording is too fast, or an encoder jumps, no unit is doubted."""
    data = read_data(load_submission(EXAMPLES / "one-cart"))
    steps = replace(data, records=tuple(r for r in data.records if r.kind == "step"))
    assert not [one for one in reading_remarks(steps, unit="m") if "faster than any cart" in one]

    def jumped(record):
        y = 1e-2 * record.y
        return replace(record, y=y + 5.0 * (np.arange(y.shape[1]) == y.shape[1] // 2))

    jumpy = replace(data, records=tuple(map(jumped, data.records)))
    assert not [one for one in reading_remarks(jumpy, unit="m") if "faster than any cart" in one]
