"""The proposed recording shows which of several explanations is right."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import ConfigError, DataError
from pipeline.experiments.discriminate import (
    _left,
    propose_for,
    with_proposal,
)
from pipeline.experiments.next_recordings import plan_next
from pipeline.experiments.plan import Plan, PlanLimits, load_plan, save_plan
from pipeline.gap.explain import investigate
from pipeline.gap.types import AlternativeModel, Gap, Trace, read_gap
from pipeline.ingest.read import read_data
from pipeline.json_files import json_text
from pipeline.plant.augmented import simulate_augmented
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain
from pipeline.report.gap_report import build_gap_document
from pipeline.report.html import render_html
from pipeline.resources import EXAMPLES
from pipeline.results import Provenance
from pipeline.setup import Setup, Units
from pipeline.simulated.hidden import prepare_bench
from pipeline.submission import Submission, load_submission
from pipeline.words.progress import silent
from pipeline.workflow import analyse
from tests.helpers.commandline import cartlab_here
from tests.helpers.effects import model_with
from tests.helpers.gaps import make_gap, two_cart_analysis
from tests.helpers.virtual import VirtualBench, VirtualSession

BENCH = Setup(springs=(True, True, True))
LIMITS = PlanLimits(input=0.5, travel=2.5)
CHAIN = Chain(m=np.array([3e-4, 1.8e-4]), c=np.array([6e-4, 4e-4]), k=np.array([0.0, 0.127, 0.061]))


DRY = model_with("coulomb_friction", CHAIN, place=1, force=0.002)
DRAG = model_with("quadratic_drag", CHAIN, place=1, coefficient=4e-5)
STIFF = model_with("cubic_spring", CHAIN, place=2, coefficient=0.02)


def disputed(*models: AugmentedChain) -> Gap:
    """Return a gap that all of these models explain equally well."""
    t = np.arange(0.0, 4.0, 0.01)
    y = simulate_augmented(models[0], t, np.full(t.size, 0.03))
    traces = tuple(
        Trace(
            experiment="step-a", cart=i + 1, held_out=True, t=t, u=t * 0 + 0.03, measured=y[i],
            baseline=y[i], final=y[i],
        )
        for i in range(2)
    )  # fmt: skip
    return replace(
        make_gap("ambiguous"),
        by_record=(),
        noise_floor=0.002,
        linear=AugmentedChain(chain=CHAIN),
        model=models[0],
        chain_std={},
        traces=traces,
        contenders=tuple(
            AlternativeModel(chain=one.chain, terms=one.terms, weight=1 / len(models))
            for one in models
        ),
    )


@pytest.fixture(scope="module")
def proposed() -> Gap:
    return with_proposal(disputed(DRY, DRAG), limits=LIMITS)


def test_the_proposal_separates_the_laws_within_the_limits(proposed):
    """The proposed recording separates the two laws of friction and stays within the limits.

    The laws differ by more than three times the noise, and no cart passes the travel limit.
    """
    found = proposed.proposal
    assert found is not None
    recording = found.recording
    assert recording.aim == "gap"
    assert abs(recording.amplitude) <= LIMITS.input
    assert found.prediction is not None
    assert np.abs(found.prediction.positions).max() <= LIMITS.travel
    assert found.separation > 3
    assert np.ptp(found.prediction.positions[:2], axis=0).max() > 0


def test_a_difference_that_parameters_can_remove_does_not_count(proposed):
    """A difference that other values of the parameters can remove does not count."""
    heavier = replace(DRY, chain=replace(CHAIN, m=CHAIN.m * 1.002, k=CHAIN.k * 0.999))
    gap = with_proposal(disputed(DRY, heavier), limits=LIMITS)
    assert proposed.proposal is not None
    assert gap.proposal is None or gap.proposal.separation < 0.05 * proposed.proposal.separation
    J = np.random.default_rng(0).standard_normal((3, 2, 50))
    difference = J[0].ravel() * 2 - J[2].ravel()
    assert _left(difference, J, np.full(2, np.inf)) == pytest.approx(0.0, abs=1e-20)
    # Changing a parameter that the records determine costs (change / standard error)².
    known = np.array([1e-6, np.inf])
    assert _left(difference, J, known) == pytest.approx(_left(2 * J[0].ravel(), J[1:], known[1:]))
    assert _left(difference, J, np.array([1e3, np.inf])) == pytest.approx((2 / 1e3) ** 2, rel=1e-3)


def test_another_dispute_gets_another_recording(proposed):
    """Three explanations are compared in pairs, and one explanation alone gives no proposal."""
    three = with_proposal(disputed(DRY, DRAG, STIFF), limits=LIMITS).proposal
    assert three is not None
    assert three.prediction is not None
    assert three.prediction.positions.shape[0] == 3
    assert with_proposal(disputed(DRY), limits=LIMITS).proposal is None


@pytest.mark.slow
@pytest.mark.sample
def test_a_hopeless_contender_decides_nothing(proposed):
    """An explanation with almost no weight does not influence which recording is proposed."""
    gap = disputed(DRY, DRAG, STIFF)
    hopeless = replace(gap.contenders[2], weight=1e-12)
    two = with_proposal(replace(gap, contenders=(*gap.contenders[:2], hopeless)), limits=LIMITS)
    assert two.proposal is not None
    assert proposed.proposal is not None
    assert two.proposal.recording == proposed.proposal.recording
    assert two.proposal.prediction is not None
    assert two.proposal.prediction.pair == (0, 1)
    assert two.proposal.separation == pytest.approx(proposed.proposal.separation)
    chosen = replace(gap.contenders[0], weight=1e-40)  # chosen by held-out runs against the BIC
    against = with_proposal(replace(gap, contenders=(chosen, gap.contenders[1])), limits=LIMITS)
    assert against.proposal is not None
    assert against.proposal.recording == proposed.proposal.recording
    swapped = (*gap.contenders[1:2], hopeless, gap.contenders[0])
    other = with_proposal(replace(gap, contenders=swapped), limits=LIMITS).proposal
    assert other is not None
    assert other.prediction is not None
    assert other.prediction.pair == (0, 2)
    assert other.separation == pytest.approx(proposed.proposal.separation)


def test_a_longer_recording_is_proposed_if_a_short_one_is_not_enough(proposed):
    """If twelve seconds cannot separate two explanations, a longer recording is proposed."""
    late, lagged = (
        model_with("input_delay", CHAIN, delay=1e-4),
        model_with("actuator_lag", CHAIN, time_constant=1e-4),
    )
    short, long = (
        gap.proposal.recording
        for gap in (proposed, with_proposal(disputed(late, lagged), limits=LIMITS))
        if gap.proposal is not None
    )
    assert short.duration < 20
    assert 40 < long.duration < 60
    assert long.resembles(long.model_copy(update={"cycles": long.cycles // 4}))


@pytest.fixture
def swept(tmp_path) -> Callable[[list[str]], Callable[..., Gap]]:
    """Return a function that records a sweep of one cart with hidden effects and finds its gap."""
    folder = tmp_path / "work"

    def sweep(hide: list[str]) -> Callable[..., Gap]:
        hidden = prepare_bench(preset="throne-1dof", model=None, hide=hide)
        bench = VirtualBench(hidden, seed=1)
        VirtualSession(folder, bench)(["sweep"])

        def look(gap: Gap | None = None) -> Gap:
            submission = load_submission(folder)
            if gap is not None and gap.proposal is not None:
                proposed = gap.proposal.recording
                bench.record(folder, [proposed], limits=load_plan(submission).limits)
                submission = load_submission(folder)
            return propose_for(
                investigate(analyse(submission), progress=lambda _: None), submission
            )

        return look

    return sweep


@pytest.mark.slow
@pytest.mark.sample
def test_an_effect_absent_from_the_held_out_end_is_found(swept):
    """A slack spring is found even if the held-out end of the sweep does not show it."""
    slack = "slack_spring:spring=1,stiffness_change=0.0065,stretch=-0.55"
    gap = swept(["input_delay:delay=0.00167", slack])()
    found = {one.effect.key for one in gap.effects}
    assert found & {"slack_spring", "cubic_spring"}
    assert found & {"input_delay", "actuator_lag"}


@pytest.mark.slow
@pytest.mark.sample
def test_a_fast_sweep_tells_a_lag_from_a_delay(swept):
    """Lag and delay are in dispute until a sweep drives the cart far above its resonance."""
    hide = ["actuator_lag:time_constant=0.0028", "cubic_spring:coefficient=0.00016"]
    look = swept(hide)
    gap = look()
    assert gap.verdict == "ambiguous"
    assert gap.proposal is not None
    omega_n = np.abs(gap.model.chain.poles).max()
    assert gap.proposal.recording.frequency > 2 * omega_n / (2 * np.pi)
    then = look(gap)
    assert then.verdict == "named"
    assert {one.effect.key for one in then.effects} == {"actuator_lag", "cubic_spring"}


def shipped(folder: Path) -> Submission:
    """Return the shipped two carts in a new folder, with a plan of these limits."""
    shutil.copytree(EXAMPLES / "two-cart", folder, dirs_exist_ok=True)
    submission = load_submission(folder)
    save_plan(Plan(limits=LIMITS), submission)
    return submission


def write_gap(gap: Gap, submission: Submission, **other: object) -> str:
    """Write gap.json for the submission's data, with some entries changed."""
    system, files = submission.system, read_data(submission).files
    bench = replace(BENCH, units=Units(position=system.position.unit, input=system.input.unit))
    text = json_text(replace(gap, bench=bench, provenance=Provenance(files=files)))
    text = json.dumps(json.loads(text) | other)
    (submission.folder / "gap").mkdir(exist_ok=True)
    (submission.folder / "gap" / "gap.json").write_text(text, encoding="utf-8")
    return text


@pytest.mark.parametrize(
    "other",
    [
        {"verdict": "perhaps"},
        {"next_recording": {"id": "apart-square"}},
        {"next_limits": {"input": 5.0, "travel": 2.5}},
        {"next_limits": None},
        {"provenance": {"version": "1", "files": {"data/step-1.csv": 64 * "0"}}},
    ],
)
def test_a_proposal_of_other_data_or_limits_is_refused(proposed, tmp_path, other):
    """A proposal for other data or limits, or a broken gap.json, is refused and not planned."""
    submission = shipped(tmp_path)
    write_gap(proposed, submission, **other)
    before = (tmp_path / "plan.toml").read_bytes()
    done = cartlab_here("plan", tmp_path, "--next", 1, "--for", "gap")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "again" in done.stderr
    assert (tmp_path / "plan.toml").read_bytes() == before


def test_the_recording_is_a_plan_entry_that_can_be_recorded(proposed, tmp_path):
    """The proposal in gap.json is added to plan.toml once, however often it is requested."""
    analysis = two_cart_analysis()
    submission = shipped(tmp_path)
    with pytest.raises(DataError, match="run `cartlab gap"):
        plan_next(submission, n=1, goal="gap", commands=frozenset(), progress=silent)
    text = write_gap(proposed, submission)
    again = read_gap(text)
    assert [one.terms[0].effect.key for one in again.contenders] == [
        "coulomb_friction",
        "quadratic_drag",
    ]
    for _ in range(2):
        made, _ = plan_next(submission, n=1, goal="gap", commands=frozenset(), progress=silent)
        plan = load_plan(submission)
        assert [r.id for r in plan.recordings if r.aim == "gap"] == [made.recordings[0].id]
        assert made.separation == pytest.approx(proposed.proposal.separation)
    with pytest.raises(ConfigError, match="expected --next 1"):
        plan_next(submission, n=3, goal="gap", commands=frozenset(), progress=silent)
    html = render_html(
        build_gap_document(
            replace(
                make_gap("ambiguous"), proposal=proposed.proposal, contenders=proposed.contenders
            ),
            analysis,
        )
    )
    assert "decides best" in html
