"""The recording that tells two explanations apart: where they differ most, fitted or not."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.bench.design.discriminate import _left, with_proposal
from pipeline.bench.design.next_plan import plan_next
from pipeline.bench.planning.plan import Limits, Recording
from pipeline.bench.planning.plan_file import load_plan
from pipeline.errors import DataError
from pipeline.gap.stored import gap_text, read_gap
from pipeline.gap.types import Contender, Gap, Trace
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.augmented import simulate_augmented
from pipeline.plant.nonlinear.effects import find_effect
from pipeline.plant.nonlinear.effects.base import AugmentedChain, make_term
from pipeline.report.gap.page import build_gap_document
from pipeline.report.render.html import render_html
from pipeline.submission import load_submission
from tests.report.test_gap import make_gap, two_cart_analysis

LIMITS = Limits(input=0.5, travel=2.5)
CHAIN = Chain(m=np.array([3e-4, 1.8e-4]), c=np.array([6e-4, 4e-4]), k=np.array([0.0, 0.127, 0.061]))


def model(key: str, *, place: int, **values: float) -> AugmentedChain:
    term = make_term(find_effect(key), place=place, values=values, chain=CHAIN)
    return AugmentedChain(chain=CHAIN, terms=(term,))


DRY = model("coulomb_friction", place=1, force=0.002)
DRAG = model("quadratic_drag", place=1, coefficient=4e-5)
STIFF = model("cubic_spring", place=2, coefficient=0.02)


def disputed(*models: AugmentedChain) -> Gap:
    """A gap that these models explain alike."""
    t = np.arange(0.0, 4.0, 0.01)
    y = simulate_augmented(models[0], t, np.full(t.size, 0.03))
    traces = tuple(
        Trace(
            experiment="step-a", cart=i + 1, held_out=True, t=t, u=t * 0 + 0.03, measured=y[i],
            baseline=y[i], final=y[i],
        )
        for i in range(2)
    )  # fmt: skip
    return Gap(
        verdict="ambiguous",
        effects=(),
        baseline=0.1,
        final=0.01,
        noise_floor=0.002,
        repeatability=None,
        by_record=(),
        where=(),
        next_experiment="Steps of three sizes.",
        linear=AugmentedChain(chain=CHAIN),
        model=models[0],
        training=("step-a",),
        held_out=("step-a",),
        traces=traces,
        contenders=tuple(Contender(model=one, weight=1 / len(models)) for one in models),
    )


@pytest.fixture(scope="module")
def proposed() -> Gap:
    return with_proposal(disputed(DRY, DRAG), limits=LIMITS)


def test_what_is_proposed_keeps_the_limits_and_sets_them_apart(proposed):
    """The two laws of friction differ by many noises in it; nothing passes the travel limit."""
    found = proposed.proposal
    assert found is not None
    recording = Recording.model_validate({**found.recording, "carts": (1, 2)}, strict=True)
    assert recording.aim == "gap"
    assert abs(recording.amplitude) <= LIMITS.input
    assert np.abs(found.predicted).max() <= LIMITS.travel
    assert found.separation > 3
    assert np.abs(found.predicted[0] - found.predicted[1]).max() > 0


def test_what_the_parameters_can_take_up_is_no_difference():
    """A model against itself with other parameters: of the difference next to nothing is left."""
    heavier = replace(DRY, chain=replace(CHAIN, m=CHAIN.m * 1.002, k=CHAIN.k * 0.999))
    gap = with_proposal(disputed(DRY, heavier), limits=LIMITS)
    other = with_proposal(disputed(DRY, DRAG), limits=LIMITS)
    assert other.proposal is not None
    assert gap.proposal is None or gap.proposal.separation < 0.05 * other.proposal.separation
    J = np.random.default_rng(0).standard_normal((3, 2, 50))
    assert _left(J[0].ravel() * 2 - J[2].ravel(), J) == pytest.approx(0.0, abs=1e-20)


def test_another_dispute_gets_another_recording(proposed):
    """Three explanations count by pairs; where nothing is disputed nothing is proposed."""
    three = with_proposal(disputed(DRY, DRAG, STIFF), limits=LIMITS).proposal
    assert three is not None
    assert three.predicted.shape[0] == 3
    assert with_proposal(disputed(DRY), limits=LIMITS).proposal is None


def test_the_recording_is_a_plan_entry_that_can_be_recorded(proposed, tmp_path):
    """From gap.json to plan.toml, once more under another name; the page draws it."""
    analysis = two_cart_analysis()
    (tmp_path / "submission.toml").write_text("version = 1\n\n[system]\ncarts = 2\n")
    submission = load_submission(tmp_path)
    with pytest.raises(DataError, match="run `cartlab gap"):
        plan_next(submission, n=1, goal="gap", progress=lambda text: None)
    (tmp_path / "gap").mkdir()
    text = gap_text(proposed, analysis)
    (tmp_path / "gap" / "gap.json").write_text(text, encoding="utf-8")
    again, _ = read_gap(text)
    assert [one.model.terms[0].effect.key for one in again.contenders] == [
        "coulomb_friction",
        "quadratic_drag",
    ]
    for count in (1, 2):
        made = plan_next(submission, n=1, goal="gap", progress=lambda text: None)
        plan = load_plan(submission)
        assert [r.aim for r in plan.recordings].count("gap") == count
        assert made.separation == pytest.approx(proposed.proposal.separation)
    html = render_html(
        build_gap_document(
            replace(
                make_gap("ambiguous"), proposal=proposed.proposal, contenders=proposed.contenders
            ),
            analysis,
        )
    )
    assert "differ most in" in html
