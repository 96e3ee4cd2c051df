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
from typing import Literal

import numpy as np

from pipeline.arrays import Array
from pipeline.errors import DataError, PipelineError
from pipeline.experiments import propose
from pipeline.experiments.information import sampled_input
from pipeline.experiments.plan import PlanLimits, Recording
from pipeline.gap.advice import advised
from pipeline.gap.limits import CLOSE_BIC, THINNING
from pipeline.gap.types import Gap, Prediction, Proposal
from pipeline.plant.augmented import rest_positions, simulate_augmented
from pipeline.plant.chain import Chain
from pipeline.plant.effect import AugmentedChain, EffectTerm
from pipeline.plant.simulate import SETTLED, settling_wait, simulate_linear
from pipeline.plant.simulator import sensitivity
from pipeline.plant.simulator.kernel import StartState, describe_run, simulate
from pipeline.submission import Submission

TrialKind = Literal["step", "sweep"]
Shape = Literal["square", "triangle", "chirp"]

_PERIOD = 5e-3  # s between samples
# samples per period, for periods at this multiple of the highest resonance
_PER_CYCLE, _BEYOND = 10, 2.0
_TIME = 12.0  # approximate duration of a record in s
# A record may be this many times longer if it would otherwise not settle its best pair.
_LONGEST = 4
_STEP = 1e-3  # relative change of an effect's parameter for a numerical derivative
_HOPELESS = np.exp(-0.5 * CLOSE_BIC)  # a model with a smaller share of the best weight is left out
_DECIDED = CLOSE_BIC * THINNING  # sum of squares that settles a pair
# Least weight of a model. Correlated residuals make the criterion look too certain.
_LEAST_WEIGHT = 0.1
# A parameter is not visible if its effect on the motion is below this share of the largest effect.
_SAME = 1e-9


class _Weighed:
    """A recording, its value, the pair of models that it separates best, and the separation.

    `weight` (models,) is that of each model; the other arguments come from `_separate`.
    """

    def __init__(
        self, recording: Recording, *, weight: Array, separation: Array,
        t: Array, u: Array, predicted: Array,
    ) -> None:  # fmt: skip
        self.recording, self.t, self.u, self.predicted = recording, t, u, predicted
        counted = np.outer(weight, weight)
        score = counted * separation
        # First settle as many pairs as possible, then separate them as far as possible.
        settled = float((counted * np.minimum(separation, _DECIDED)).sum())
        self.worth = settled, float(score.sum())
        self.pair = divmod(int(np.argmax(score)), weight.size)
        self.separation = float(separation[self.pair])


def propose_for(gap: Gap, submission: Submission, *, without: Sequence[Recording] = ()) -> Gap:
    """Return the gap with a proposed recording within the limits of the submission's plan.

    The recording resembles none of those in `without`. If no proposal is possible, for example
    because plan.toml is broken, a note says why.
    """
    try:
        limits = propose.current_plan(submission).limits
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
    sigma, pinned = _noise(gap), _pinned(gap)

    def weighed(recording: Recording, height: float) -> _Weighed | None:
        found = _separate(models, recording, height, sigma=sigma, pinned=pinned)
        if found is None or np.abs(found[3][weight > 0.0]).max() > limits.travel:
            return None
        separation, t, u, predicted = found
        return _Weighed(
            recording, weight=weight, separation=separation, t=t, u=u, predicted=predicted
        )

    options = [
        weighed(recording, height)
        for recording, height in _candidates(models[0].chain, limits)
        if not any(recording.resembles(other) for other in without)
    ]
    best = max((one for one in options if one), key=lambda one: one.worth, default=None)
    if best is None or best.worth <= (0.0, 0.0):
        return gap
    if best.separation < _DECIDED and not best.recording.release:
        times = min(_LONGEST, ceil(_DECIDED / best.separation))
        longer = {"cycles": times * best.recording.cycles}
        best = weighed(best.recording.model_copy(update=longer), 0.0) or best
    return replace(gap, proposal=_propose(best, limits))


def _propose(best: _Weighed, limits: PlanLimits) -> Proposal:
    """Return the proposal for a recording, with the cart on which the pair differs most."""
    one, other = best.pair
    cart = int(np.argmax(np.abs(best.predicted[one] - best.predicted[other]).max(axis=1)))
    return Proposal(
        recording=best.recording.model_dump(mode="json", exclude_defaults=True),
        limits=limits.model_dump(),
        separation=float(np.sqrt(best.separation / (best.t.size * len(best.recording.carts)))),
        prediction=Prediction(
            pair=best.pair, cart=cart + 1, t=best.t, u=best.u, positions=best.predicted[:, cart]
        ),
    )


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


# ----------------------------------------------------------------------- the candidates


def _candidates(chain: Chain, limits: PlanLimits) -> Iterator[tuple[Recording, float]]:
    """Yield steps in both directions, triangles, chirps and releases, in several sizes.

    With each recording comes the position from which a cart is released, in position units. It is
    zero if no cart is released.
    """
    resonances = np.sort(np.abs(chain.poles)) / (2 * np.pi)
    settle = propose.rounded(settling_wait(chain, time_constants=SETTLED))
    everyone = tuple(range(1, chain.n + 1))
    slow, low, high, fastest = (
        propose.rounded(float(f))
        for f in (
            1.5 / _TIME,
            0.5 * resonances[0],
            1.3 * resonances[-1],
            max(_BEYOND * resonances[-1], 1 / (_PER_CYCLE * _PERIOD)),
        )
    )
    waves: tuple[tuple[Shape, TrialKind, float, float | None], ...] = (
        ("square", "step", slow, None),
        ("square", "sweep", propose.rounded(float(resonances[0])), None),
        ("triangle", "sweep", slow, None),
        ("triangle", "sweep", propose.rounded(float(resonances[0])), None),
        ("chirp", "sweep", low, high),
        # At high frequencies the carts move little, even with the motor's full input. This shows
        # delays, and laws that matter only for small motions.
        ("chirp", "sweep", high, fastest),
        ("chirp", "sweep", propose.rounded(float(np.sqrt(high * fastest))), fastest),
    )
    for wave, kind, f, end in waves:
        whole = Recording(
            id=f"apart-{wave}",
            kind=kind,
            carts=everyone,
            wave=wave,
            amplitude=1.0,
            frequency=f,
            frequency_end=end,
            cycles=ceil(_TIME * f),
            settle=settle,
            aim="gap",
        )
        t, u = sampled_input(whole, period=_PERIOD)
        reach = float(np.max(np.abs(simulate_linear(chain, t, u))))
        largest = min(propose.FURTHEST * limits.travel / reach, limits.input)
        # Several sizes, because laws differ in how they grow with the motion.
        for size in (1.0, 0.5, 0.2):
            for sign in (1, -1) if wave == "square" else (1,):
                amplitude = sign * propose.rounded_down(size * largest)
                yield whole.model_copy(update={"amplitude": amplitude}), 0.0
    for cart in everyone:
        if chain.k[cart - 1] + chain.k[cart] <= 0:
            continue
        for share in (0.6, 0.2):  # shares of the travel limit, for a release by hand
            height = propose.rounded(share * limits.travel)
            release = propose.release_by_hand(cart, name=f"apart-decay-{cart}", seconds=_TIME)
            note = f"let go at {share:.0%} of the travel limit, {height:g} from the zero"
            yield release.model_copy(update={"note": note, "aim": "gap"}), height


def far_sweep(chain: Chain, limits: PlanLimits) -> Recording:
    """Return a sweep through the resonances that moves the carts as far as allowed."""
    every = (recording for recording, _ in _candidates(chain, limits))
    return next(one for one in every if one.wave == "chirp").model_copy(update={"id": "sweep"})


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
    t, u = sampled_input(recording, period=_PERIOD)
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
