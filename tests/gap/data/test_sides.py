"""A recording that the report leaves out is not used for the gap either."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.errors import DataError
from pipeline.gap.explain import investigate
from pipeline.gap.types import read_gap
from pipeline.json_files import json_text
from pipeline.plant.linear.chain import Chain
from pipeline.plant.linear.presets import PRESETS
from pipeline.results import LeftOut
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.time_records import decay_record, step_record

CHAIN = PRESETS["throne-1dof"]
HEAVIER = Chain(m=1.4 * CHAIN.m, c=CHAIN.c, k=CHAIN.k)  # a weight was left on the cart


@pytest.fixture(scope="module")
def analysis(tmp_path_factory):
    """The analysis of a linear bench: two step sizes, decays, one repeat with an extra weight."""
    folder = tmp_path_factory.mktemp("bench")
    rng = np.random.default_rng(5)
    records = [
        *(step_record(CHAIN, rng=rng, id=f"step-{i}") for i in (1, 2, 3)),
        step_record(HEAVIER, rng=rng, id="step-4"),
        step_record(CHAIN, rng=rng, swing=0.5, id="half"),
        *(decay_record(CHAIN, free=(1,), rng=rng, id=f"decay-{i}") for i in (1, 2)),
    ]
    toml = "version = 1\n[system]\ncarts = 1\ninput = { sign = 1 }\n"
    for record in records:
        u = np.zeros(record.t.size) if record.u is None else record.u
        rows = [
            f"{t:.6f},{v:.6f},{x:.5f}" for t, v, x in zip(record.t, u, record.y[0], strict=True)
        ]
        text = "\n".join(["time,input,x1", *rows]) + "\n"
        (folder / f"{record.id}.csv").write_text(text, encoding="utf-8")
        toml += f'[[experiments]]\nid = "{record.id}"\nkind = "{record.kind}"\n'
        toml += f'file = "{record.id}.csv"\n'
    (folder / "submission.toml").write_text(toml, encoding="utf-8")
    return analyse(load_submission(folder), design=False)


def test_what_the_report_leaves_out_is_in_no_figure_of_the_gap(analysis):
    """The odd repeat is neither trained nor judged on; gap.json has the report's reason."""
    (odd,) = analysis.left_out
    assert (odd.experiment, odd.is_wrong) == ("step-4", False)

    gap = investigate(analysis, progress=lambda text: None)

    assert gap.verdict == "none"
    assert "step-4" not in {*gap.training, *gap.held_out}
    assert "step-4" not in {one.experiment for one in (*gap.by_record, *gap.traces, *gap.where)}
    assert any("step-4" in note and odd.reason in note for note in gap.notes)
    text = json_text(gap)
    told = {"experiment": "step-4", "reason": odd.reason, "is_wrong": False}
    assert json.loads(text)["left_out"] == [told]
    assert read_gap(text).left_out == (odd,)


def test_a_gap_file_of_before_is_still_read(analysis):
    """A gap.json without `left_out` is read as an empty list."""
    document = json.loads(json_text(investigate(analysis, progress=lambda text: None)))
    del document["left_out"]
    assert read_gap(json.dumps(document)).left_out == ()


def test_nothing_left_is_an_error_that_says_why(analysis):
    """If every recording is left out, the message gives the reasons."""
    out = tuple(
        LeftOut(experiment=record.id, reason="its clock stood still", is_wrong=True)
        for record in analysis.records
    )
    with pytest.raises(DataError, match=r"left out, as in the report: step-1.*: its clock stood"):
        investigate(replace(analysis, left_out=out), progress=lambda text: None)
