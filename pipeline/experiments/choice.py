"""Choose the next recordings of an exploration, and say why."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from pipeline.errors import DataError
from pipeline.experiments.discriminate import far_sweep
from pipeline.experiments.next_recordings import NextPlan, choose_next
from pipeline.experiments.plan import Plan, PlanLimits, Recording, session_time
from pipeline.experiments.propose import FURTHEST, identified_chain, large_steps
from pipeline.experiments.turn import WORDS, name_model
from pipeline.gap.types import Gap
from pipeline.results import Analysis

SETTLED = ("named", "none")
# Separation squared times seconds: a recording below this limit cannot decide between explanations.
# With 200 readings a second, of which every tenth is independent, the criterion would differ by 20.
_APART = 1.0
# A recording with this share of the largest allowed amplitude is as good as the largest.
_HARD = 0.8
# One analysis plans this share of the recordings so far. Fewer data hardly change the next choice,
# but each analysis takes as much longer as there are more recordings.
_SHARE = 0.1
_FAR_OUT = "far"  # the aim of a recording that shows effects at large motion


def choose_recordings(
    analysis: Analysis,
    gap: Gap | None,
    plan: Plan,
    *,
    missing: dict[str, float],
    wanted: float,
    seconds: float,
    refused: Sequence[Recording],
    commands: frozenset[str],
) -> tuple[tuple[Recording, ...], str]:
    """Return the next recordings and why they were chosen.

    The result is empty if everything is known or nothing would help. A recording that distinguishes
    explanations comes first, then some that improve the least known parameter, then one that shows
    effects at large motion.

    Parameters
    ----------
    missing : the parameters that are not known well enough, with their relative errors.
    wanted : the relative error to reach.
    seconds : the time left at the bench; of several recordings, those beyond it are dropped.
    refused : recordings refused before; no similar recording is chosen.
    commands : the extensions of the protocol that the bench knows.
    """
    named = gap is None or gap.verdict in SETTLED
    # A named model whose error exceeds the noise still counts as only one of several contenders.
    settled = gap is None or (named and not gap.contenders)
    end = "" if named else WORDS.text("undecided")
    decides = gap and gap.proposal
    predicted = decides and decides.prediction
    if gap and decides and predicted and decides.separation**2 * predicted.t[-1] > _APART:
        recording = Recording.model_validate_json(json.dumps(decides.recording))
        disputed = [name_model(one) for one in gap.contenders]
        names = " and ".join(f'"{disputed[i]}"' for i in predicted.pair)
        return (recording,), WORDS.text("differ", names=names, times=f"{decides.separation:.2g}")
    if missing and named:
        worst = max(missing, key=lambda name: missing[name])
        # Recordings of the plan without data give no information yet, so leave them out.
        made = plan.model_copy(update={"recordings": ()})
        try:
            n = max(1, int(_SHARE * len(analysis.records)))
            found = choose_next(analysis, made, n=n, goal=worst, commands=commands, without=refused)
        except DataError as error:  # a large step is still possible
            end = str(error)
        else:
            found = _as_needed(found, wanted=wanted, seconds=seconds)
            return found.recordings, found.summary
    # Record each of these only once: carts that were held back would go no further the second time.
    recorded = {record.id for record in analysis.records}
    tried = [*refused, *(r for r in plan.recordings if r.id in recorded)]
    for recording, unseen in _reach_far_out(analysis, plan.limits):
        alike = any(
            recording.resembles(other) or (other.kind, other.aim) == (recording.kind, _FAR_OUT)
            for other in tried
        )
        if not alike and (unseen or not settled):
            why = unseen if settled else WORDS.text("as_far")
            return (recording.model_copy(update={"aim": _FAR_OUT}),), why
    return (), end


def _as_needed(found: NextPlan, *, wanted: float, seconds: float) -> NextPlan:
    """Return the plan without the recordings beyond the error to reach or the time left.

    The first recording always stays.
    """
    for n in range(1, len(found.recordings)):
        if found.errors[n] <= wanted or session_time(found.recordings[: n + 1]) > seconds:
            return replace(found, recordings=found.recordings[:n], errors=found.errors[: n + 1])
    return found


def _reach_far_out(analysis: Analysis, limits: PlanLimits) -> Iterator[tuple[Recording, str]]:
    """Yield two recordings that show effects at large motion, each with a reason in words.

    The first is a step to the furthest intended rest position; the second is a sweep with large
    swings to both sides. The reason is empty if earlier records already go about as far.
    """
    chain = identified_chain(analysis)
    driven = [record for record in analysis.records if record.kind in ("step", "sweep")]
    inputs = [float(np.abs(record.u).max()) for record in driven if record.u is not None]
    hardest = max(inputs, default=0.0)
    furthest = min(
        max((float((side * y).max()) for record in driven for y in record.y), default=0.0)
        for side in (1, -1)
    )
    step, swing = large_steps(chain, limits)[0], far_sweep(chain, limits)
    unit = analysis.bench.units.input
    words = WORDS.text("far_step", most=f"{hardest:.2g}", unit=unit)
    yield step, words if hardest < _HARD * abs(step.amplitude) else ""
    unit = analysis.bench.units.position
    words = WORDS.text("far_swing", most=f"{furthest:.2g}", unit=unit)
    yield swing, words if furthest < _HARD * FURTHEST * limits.travel else ""
