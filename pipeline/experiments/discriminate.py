"""Choose the experiment that distinguishes two explanations even after they are refitted.

This is a T-optimal design: only that part of a difference counts which neither model can absorb. A
model may adjust its initial state, the encoder zeros and, as far as all earlier records allow, its
parameters. With several models, each pair is weighted by the product of its probabilities. The
weighted sum bounds the expected decrease in entropy.

References: A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975), 57-70 and 289-303; G. E. P. Box, W.
J. Hill, Technometrics 9 (1967), 57-71.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from math import ceil
from typing import TypeAlias

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError, PipelineError
from pipeline.experiments.information import sampled_input
from pipeline.experiments.next_recordings import TRIAL_PERIOD, propose_trials
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.experiments.propose import current_plan
from pipeline.gap.advice import advised
from pipeline.gap.limits import CLOSE_BIC, THINNING
from pipeline.gap.types import Gap, Prediction, Proposal
from pipeline.plant.augmented import rest_positions, simulate_augmented
from pipeline.plant.effect import AugmentedChain, EffectTerm
from pipeline.plant.simulator import sensitivity
from pipeline.plant.simulator.kernel import StartState, describe_run, simulate
from pipeline.submission import Submission

# A record may be this many times longer if it would otherwise not settle its best pair.
_LONGEST = 4
_STEP = 1e-3  # relative change of an effect's parameter for a numerical derivative
_HOPELESS = np.exp(-0.5 * CLOSE_BIC)  # a model with a smaller share of the best weight is left out
_DECIDED = CLOSE_BIC * THINNING  # sum of squares that settles a pair
# Least weight of a model. Correlated residuals make the criterion look too certain.
_LEAST_WEIGHT = 0.1
# The value of a recording, the separation of its best pair, and its proposal.
_Weighed: TypeAlias = tuple[tuple[float, float], float, Proposal]
# A parameter is not visible if its effect on the motion is below this share of the largest effect.
_SAME = 1e-9


def propose_for(gap: Gap, submission: Submission, *, without: Sequence[Recording] = ()) -> Gap:
    """Return the gap with a proposed recording within the limits of the submission's plan.

    The recording resembles none of those in `without`. If no proposal is possible, for example
    because plan.toml is broken, a note says why.
    """
    try:
        limits = current_plan(submission).limits
        return advised(with_proposal(gap, limits=limits, without=without))
    except PipelineError as error:
        return replace(gap, notes=(*gap.notes, f"no recording is proposed: {error}"))


def with_proposal(gap: Gap, *, limits: PlanLimits, without: Sequence[Recording] = ()) -> Gap:
    """Return the gap with the recording that best distinguishes its contenders.

    A gap with fewer than two contenders gets no proposal.

    Raises
    ------
    DataError : the carts never settle.
    """
    gap = replace(gap, proposal=None)
    models = list(gap.contenders)
    if len(models) < 2 or not all(model.chain.is_tied for model in models):
        return gap
    weight = np.array([one.weight for one in gap.contenders])
    weight = np.where(weight < _HOPELESS * weight.max(), 0.0, np.maximum(weight, _LEAST_WEIGHT))
    weight[0] = max(weight[0], _LEAST_WEIGHT)  # the chosen model always counts
    if np.count_nonzero(weight) < 2:
        return gap
    sigma, pinned, counted = _noise(gap), _pinned(gap), np.outer(weight, weight)

    def weigh(recording: Recording, height: float) -> _Weighed | None:
        found = _separate(models, recording, height, sigma=sigma, pinned=pinned)
        if found is None or np.abs(found[3][weight > 0.0]).max() > limits.travel:
            return None
        separation, t, u, x = found
        score = counted * separation
        one, other = pair = divmod(int(np.argmax(score)), weight.size)
        cart = int(np.argmax(np.abs(x[one] - x[other]).max(axis=1)))  # where the pair differs most
        proposal = Proposal(
            recording=recording,
            limits=limits,
            separation=float(np.sqrt(separation[pair] / (t.size * len(recording.carts)))),
            prediction=Prediction(pair=pair, cart=cart + 1, t=t, u=u, positions=x[:, cart]),
        )
        # First settle as many pairs as possible, then separate them as far as possible.
        settled = float((counted * np.minimum(separation, _DECIDED)).sum())
        return (settled, float(score.sum())), float(separation[pair]), proposal

    trials = propose_trials(models[0].chain, limits=limits, without=without)
    weighed = [found for trial in trials if (found := weigh(*trial))]
    if not weighed:
        return gap
    worth, apart, proposal = max(weighed, key=lambda found: found[0])
    if worth <= (0.0, 0.0):
        return gap
    recording = proposal.recording
    if apart < _DECIDED and not recording.release:
        cycles = min(_LONGEST, ceil(_DECIDED / apart)) * recording.cycles
        if longer := weigh(recording.model_copy(update={"cycles": cycles}), 0.0):
            proposal = longer[2]
    return replace(gap, proposal=proposal)


def _noise(gap: Gap) -> Array:
    """Return the noise (n,) of each cart from the noise floors of its runs."""
    floor = {(row.experiment, row.cart): row.noise_floor for row in gap.by_record}
    found: dict[int, list[float]] = {}
    for trace in gap.traces:
        share = floor.get((trace.experiment, trace.cart), gap.noise_floor)
        rms = float(np.sqrt(np.mean((trace.measured - trace.zero) ** 2)))
        found.setdefault(trace.cart, []).append(share * rms)
    typical = float(np.median(np.concatenate(list(found.values()))))
    n = gap.linear.chain.n
    return np.array([np.median(found.get(cart, [typical])) for cart in range(1, n + 1)])


def _pinned(gap: Gap) -> Array:
    """Return how far the records allow each parameter of the chain to be from its estimate."""
    chain = gap.model.chain
    return np.array(
        [
            # A standard error holds for one explanation only, so three standard errors are allowed.
            3.0 * gap.chain_std.get(f"{letter}_{i + 1}", np.inf)
            for letter, values in (("m", chain.m), ("c", chain.c), ("k", chain.k))
            for i in np.flatnonzero(values).tolist()
        ]
    )


# ------------------------------------------------------------------ the separation


def _separate(
    models: Sequence[AugmentedChain],
    recording: Recording,
    height: float,
    *,
    sigma: Array,
    pinned: Array,
) -> tuple[Array, Array, Array, Array] | None:
    """Return the separation (models, models) of each pair, with times, input and predictions.

    A separation is the sum of squared differences, relative to the noise, that neither model can
    absorb. The result is None if the motion of a model cannot be computed.
    """
    t, u = sampled_input(recording, period=TRIAL_PERIOD)
    u = recording.amplitude * u
    x0 = height * np.eye(sigma.size)[recording.release - 1] if recording.release else None
    try:
        moved = [_predict(model, t, u, recording, x0) for model in models]
    except DataError:
        return None
    predicted = np.array([x for x, _ in moved])
    free = [cart - 1 for cart in recording.carts]
    separation = np.zeros((len(models), len(models)))
    for i, j in combinations(range(len(models)), 2):
        if not u.any() and _need_input(models[i], models[j]):
            continue
        difference = ((predicted[i] - predicted[j]) / sigma[:, None])[free].ravel()
        separation[i, j] = min(
            _left(difference, (by / sigma[:, None])[:, free], pinned)
            for _, by in (moved[i], moved[j])
        )
    return separation, t, u, predicted


def _need_input(one: AugmentedChain, other: AugmentedChain) -> bool:
    """Return whether two models differ only in effects on an input, such as a lag and a delay.

    Without an input, the motions of both models should then agree. Only bounces at a contact may
    make them differ by accident.
    """
    mine, others = ({(t.effect.key, t.place): t for t in m.terms} for m in (one, other))
    lone = [(mine | others)[key] for key in mine.keys() ^ others.keys()]
    return all(term.effect.needs_input for term in lone)


def _left(difference: Array, by: Array, pinned: Array) -> float:
    """Return what remains of a difference (n,), as a sum of squares, after the best refit.

    `by` has the derivatives of the difference with respect to the parameters; the chain's
    parameters come first. Earlier records confine these: a change by `pinned` (n_p,) adds one to
    the sum.
    """
    columns = by.reshape(len(by), -1).T
    held = np.zeros((pinned.size, len(by)))
    np.fill_diagonal(held, 1.0 / pinned)
    columns, difference = np.vstack([columns, held]), np.append(difference, np.zeros(pinned.size))
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.maximum(size, _SAME * size.max())
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    U = U[:, s > _SAME * s[0]]
    rest = difference - U @ (U.T @ difference)
    return float(rest @ rest)


def _predict(
    model: AugmentedChain, t: Array, u: Array, recording: Recording, x0: Array | None
) -> tuple[Array, Array]:
    """Return the readings (n, samples) and their derivatives (n_free, n, samples).

    The derivatives are with respect to the parameters of the chain and its effects, the position
    from which a cart is released, and the encoder zeros.
    """
    n, k = model.chain.n, model.chain.k
    variants = [model, *_changed(model)]
    # With a constant force or cogging, the rest position changes if the force or a spring changes.
    stiffer = [
        replace(model, chain=replace(model.chain, k=k * (1 + _STEP * (np.arange(n + 1) == j))))
        for j in np.flatnonzero(k)
    ]
    start, by_spring = (
        np.array([rest_positions(one, free=recording.carts) if x0 is None else x0 for one in some])
        for some in (variants, stiffer)
    )
    by_spring = (by_spring - start[0]) / (_STEP * k[k != 0.0, None])
    of = [
        (kind, i)
        for kind, values in (
            (sensitivity.BY_MASS, model.chain.m),
            (sensitivity.BY_DAMPING, model.chain.c),
            (sensitivity.BY_STIFFNESS, k),
        )
        for i in np.flatnonzero(values).tolist()
    ]
    shared = len(of)
    of += [(sensitivity.BY_POSITION, i) for i in range(n)]
    still, alike = np.zeros((1, n)), np.ones(n)
    y, by_chain = simulate(
        [(variant.tables(), StartState(x0[None], still, alike))
         for variant, x0 in zip(variants, start, strict=True)],
        describe_run(t, u, free=np.isin(np.arange(1, n + 1), recording.carts)),
        of=np.array(of).T,
    )  # fmt: skip
    by_chain, by_start = by_chain[:shared], by_chain[shared:]
    by_chain[shared - len(stiffer) :] += np.tensordot(by_spring, by_start, axes=1)
    by_start = by_start[recording.release - 1 :][:1] if recording.release else by_start[:0]
    by_effects = (y[1:] - y[0]) / _STEP
    zeros = np.repeat(np.eye(n)[:, :, None], t.size, axis=2)
    x = simulate_augmented(model, t, u, free=recording.carts, x0=start[0])
    return x, np.concatenate([by_chain, by_start, by_effects, zeros])


def _changed(model: AugmentedChain) -> Iterator[AugmentedChain]:
    """Yield copies of the model, each with one parameter of an effect slightly larger."""
    for at, term in enumerate(model.terms):
        for i, value in enumerate(term.values):
            moved = (*term.values[:i], value * (1 + _STEP), *term.values[i + 1 :])
            new = EffectTerm(effect=term.effect, place=term.place, values=moved)
            terms = (*model.terms[:at], new, *model.terms[at + 1 :])
            yield replace(model, terms=terms)
