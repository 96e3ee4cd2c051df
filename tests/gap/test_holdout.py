"""A recording that the report leaves out is not used for the gap either."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.gap.explain import investigate
from pipeline.gap.runs import prepare
from pipeline.gap.types import read_gap
from pipeline.json_files import json_text, plain
from pipeline.plant.chain import PRESETS, Chain
from pipeline.results import Intervention
from pipeline.submission import load_submission
from pipeline.workflow import analyse
from tests.helpers.time_records import decay_record, step_record, write_records

CHAIN = PRESETS["throne-1dof"]
HEAVIER = Chain(m=1.4 * CHAIN.m, c=CHAIN.c, k=CHAIN.k)  # an extra weight on the cart


@pytest.fixture(scope="module")
def analysis(tmp_path_factory):
    """Return the analysis of a linear bench; one repeat was recorded with an extra weight."""
    rng = np.random.default_rng(5)
    records = [
        *(step_record(CHAIN, rng=rng, id=f"step-{i}") for i in (1, 2, 3)),
        step_record(HEAVIER, rng=rng, id="step-4"),
        step_record(CHAIN, rng=rng, swing=0.5, id="half"),
        *(decay_record(CHAIN, free=(1,), rng=rng, id=f"decay-{i}") for i in (1, 2)),
    ]
    folder = write_records(tmp_path_factory.mktemp("bench"), records, carts=1)
    return analyse(load_submission(folder), design=False)


def test_a_run_that_the_report_leaves_out_is_not_used(analysis):
    """The run with the weight is neither fitted nor held out, and `gap.json` has the reason."""
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
    assert plain(read_gap(text).left_out) == [told]


def test_a_cart_at_rest_before_a_release_is_not_a_run():
    """If a cart rests before a hand pulls and releases it, only the decay counts as a run."""
    decay = decay_record(CHAIN, free=(1,), rng=np.random.default_rng(6))
    wait = np.arange(int(2.0 / decay.sample_time)) * decay.sample_time
    steps = np.interp(wait, [0.06, 0.2, 0.7, 1.9], [17, 3, 3, 0])
    settling = decay.resolution[0] * np.rint(steps)
    record = replace(
        decay,
        t=np.arange(wait.size + decay.t.size) * decay.sample_time,
        y=np.concatenate((decay.y[0, 0] + settling, decay.y[0]))[None],
    )
    # The hand pulls from 2.0 s on and releases at 3.5 s.
    hand = Intervention(experiment=record.id, cart=1, start=2.0, end=3.6)

    (run,) = prepare([record], springs=(True, True), interventions=[hand], notes=[])

    assert run.t[0] > hand.end
