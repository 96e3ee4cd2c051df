"""Some recordings get warnings about themselves, for example about their unit."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.identify.recording_checks import reading_remarks
from pipeline.ingest.read import Ingested, read_data
from pipeline.resources import EXAMPLES
from pipeline.submission import load_submission


def doubts(data: Ingested, *, unit: str) -> int:
    """Return how many remarks more there are than with a unit that fits the recordings."""
    return len(reading_remarks(data, unit=unit)) - len(reading_remarks(data, unit="cm"))


@pytest.mark.parametrize("name", ["one-cart", "two-cart", "three-cart"])
def test_centimetres_stated_as_metres_raise_a_question(name):
    """If metres as the unit would make carts impossibly fast, a remark questions the unit.

    Centimetres, millimetres, inches and counts are not questioned.
    """
    data = read_data(load_submission(EXAMPLES / name))
    units = ("m", "mm", "in", "count")
    assert [doubts(data, unit=unit) for unit in units] == [1, 0, 0, 0]


def test_one_kind_of_recording_or_a_jump_questions_no_unit():
    """If only one kind of recording is too fast, or an encoder jumps, no unit is doubted."""
    data = read_data(load_submission(EXAMPLES / "one-cart"))
    steps = replace(data, records=tuple(r for r in data.records if r.kind == "step"))
    assert doubts(steps, unit="m") == 0

    def jumped(record):
        y = 1e-2 * record.y
        return replace(record, y=y + 5.0 * (np.arange(y.shape[1]) == y.shape[1] // 2))

    assert doubts(replace(data, records=tuple(map(jumped, data.records))), unit="m") == 0
