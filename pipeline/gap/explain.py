"""The gap workflow in one line: split, fit the chain, search, judge, say what is left."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.gap.account import (
    chain_std,
    compare_by_record,
    list_effects,
    list_suspects,
    make_traces,
    pooled_floor,
    repeatability,
)
from pipeline.gap.baseline import fit_baseline, measure_noise
from pipeline.gap.fit import Fit, covariance, fit_model
from pipeline.gap.grow import fit_whole
from pipeline.gap.hypothesis import Bench, Hypothesis, judge
from pipeline.gap.offset import find_offset
from pipeline.gap.restart import dry_force
from pipeline.gap.runs import Run
from pipeline.gap.search import choose, prune, search
from pipeline.gap.sides import prepare, take_sides
from pipeline.gap.structure import Candidate
from pipeline.gap.types import Gap
from pipeline.gap.verdict import AS_REPEATS, REFUSED_FLOOR, choose_experiment, reach_verdict
from pipeline.gap.where import find_windows
from pipeline.plant.chain import Chain
from pipeline.plant.effects import CATALOGUE, find_effect
from pipeline.plant.effects.base import Effect
from pipeline.results import Record

_NOISE_ROUNDS, _TOO_GOOD = 2, 0.7  # chi-square per point no fit to true noise falls to


def explain_gap(
    records: Sequence[Record],
    *,
    springs: Sequence[bool],
    chain: Chain | None = None,
    catalogue: Sequence[Effect] = CATALOGUE,
    position_unit: str = "cm",
    input_unit: str = "V",
    workers: int = 2,
    tell: Callable[[str], None] = lambda text: None,
) -> Gap:
    """Find where the linear chain and the records disagree, name why, and show the gap shrink.

    Parameters
    ----------
    records : any kind but tables; dwells beyond a few and, where open-loop runs exist, runs
        under feedback are left out.
    springs : (n + 1,) which springs there are, wall-1 to n-wall.
    chain : the stages' estimate, as one start of the fit.
    catalogue : the effects that may be named.
    workers : threads.
    tell : takes a line of progress.

    Raises
    ------
    DataError : no usable record.
    """
    notes: list[str] = []
    runs = prepare(records, springs=tuple(springs), notes=notes)
    training, held_out = take_sides(runs, notes=notes)
    # Its matrices are small: BLAS with threads of its own only gets in the workers' way.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(max_workers=workers) as pool:
        tell("fitting the linear chain")
        fit, training = fit_baseline(training, springs=springs, start=chain, mapper=pool.map)
        sigma = {row: s for run in training for row, s in zip(run.rows, run.sigma, strict=True)}
        held_out = [_with_noise(run, sigma) for run in held_out]
        bench = Bench(
            training=tuple(training),
            held_out=tuple(held_out),
            springs=tuple(springs),
            catalogue=tuple(catalogue),
            repeatability=repeatability([*training, *held_out]) or 0.0,
            mapper=pool.map,
            tell=tell,
        )
        chosen, found = _investigate(fit, bench)
        for _ in range(_NOISE_ROUNDS):
            if chosen.fit.chi > _TOO_GOOD:
                break
            # Less is left than was taken for noise: the misfit of the linear model was in it.
            bench = _quieter(bench, chosen)
            fit = fit_model(fit.structure, fit.theta, bench.training, mapper=pool.map)
            chosen, found = _investigate(fit, bench)
        path = _path(chosen, found, bench)
        chosen, path, judged_by = _with_offset(chosen, path, bench)
        if judged_by is not bench:
            # The others were judged with the encoders' zeros free.
            bench, found = judged_by, list(path)
        final = covariance(chosen.fit, bench.training, mapper=pool.map)
    floor = pooled_floor(bench.held_out)
    if chosen.key and chosen.error > REFUSED_FLOOR * floor:
        notes.append(f"{chosen.error / floor:.1f} times the noise is left: something remains")
    sample_time = max(run.record.sample_time for run in bench.training)
    verdict, close = reach_verdict(
        chosen, path[0], found, bench=bench, floor=floor, sample_time=sample_time
    )
    effects = list_effects(path, final, found, position_unit=position_unit, input_unit=input_unit)
    traces = make_traces(path[0], chosen, bench)
    return Gap(
        verdict=verdict,
        effects=effects,
        baseline=path[0].error,
        final=chosen.error,
        noise_floor=floor,
        repeatability=bench.repeatability or None,
        by_record=compare_by_record(traces, bench),
        where=find_windows(path[0].fit, bench.training) if verdict != "none" else (),
        next_experiment=choose_experiment(verdict, chosen, close),
        linear=path[0].fit.structure.model(path[0].fit.theta),
        model=chosen.fit.structure.model(chosen.fit.theta),
        training=tuple(run.id for run in bench.training),
        held_out=tuple(run.id for run in bench.held_out),
        traces=traces,
        chain_std=chain_std(final),
        spread=_learnt_spread(chosen.fit),
        suspects=list_suspects(found, effects) if verdict == "unexplained" else (),
        notes=tuple(notes),
    )


def _learnt_spread(fit: Fit) -> dict[int, float]:
    """Return the run-to-run spread of each cart's dry friction, where the runs asked for one."""
    moved = np.any([own.scatter != 1.0 for own in fit.locals_], axis=0)
    dry = fit.structure.dry
    return {i + 1: float(fit.spread[i]) for i in range(len(dry)) if dry[i] and moved[i]}


# ------------------------------------------------------------------------ the noise


def _quieter(bench: Bench, best: Hypothesis) -> Bench:
    """Return the bench with the noise that the best model leaves."""
    training = measure_noise(best.fit, bench.training, bench.training)
    sigma = {row: s for run in training for row, s in zip(run.rows, run.sigma, strict=True)}
    held_out = tuple(_with_noise(run, sigma) for run in bench.held_out)
    return replace(bench, training=tuple(training), held_out=held_out)


def _with_noise(run: Run, sigma: dict[int, float]) -> Run:
    return replace(
        run, sigma=np.array([sigma.get(r, s) for r, s in zip(run.rows, run.sigma, strict=True)])
    )


# -------------------------------------------------------------------- the hypotheses


def _investigate(fit: Fit, bench: Bench) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return the hypothesis chosen and all that were judged, the linear one first."""
    baseline = judge(fit, bench)
    if baseline.at_floor or baseline.error < AS_REPEATS * bench.repeatability:
        return baseline, [baseline]
    bench.tell(f"linear model: error {baseline.error:.1%} of the motion on held-out runs")
    found = search(baseline, bench)
    return prune(choose(found, baseline), bench), found


def _path(chosen: Hypothesis, found: Sequence[Hypothesis], bench: Bench) -> tuple[Hypothesis, ...]:
    """Return baseline, one effect, … chosen: the steps by which the effects were added."""
    by_key = {h.key: h for h in found}
    effects = chosen.fit.structure.effects
    path = [by_key[frozenset()]]
    for size in range(1, len(effects)):
        key = frozenset(c.key for c in effects[:size])
        if key in by_key:
            path.append(by_key[key])
            continue
        structure = chosen.fit.structure
        theta = chosen.fit.theta
        for index in range(len(effects) - 1, size - 1, -1):
            theta = np.delete(theta, np.r_[structure.span(index)])
            structure = structure.without(index)
        path.append(judge(fit_whole(structure, theta, bench), bench, added=effects[size - 1]))
    return (*path, chosen) if effects else (path[0],)


def _with_offset(
    chosen: Hypothesis, path: tuple[Hypothesis, ...], bench: Bench
) -> tuple[Hypothesis, tuple[Hypothesis, ...], Bench]:
    """Return everything with a constant force added, where the rest points ask for one.

    With the force in the model the encoders' zeros are those of the file, within half a noise.
    """
    structure = chosen.fit.structure
    runs = [*bench.training, *bench.held_out]
    own = [*chosen.fit.locals_, *chosen.held.locals_]
    offset = find_offset(structure.chain(chosen.fit.theta), runs, own)
    if offset is None:
        return chosen, path, bench
    cart, _, _ = structure.model(chosen.fit.theta).tables()
    if abs(offset.force) < dry_force(cart)[offset.cart - 1]:
        # Friction holds a cart as far from its equilibrium: no proof of a constant force.
        return chosen, path, bench
    pinned, loose = (
        replace(
            bench,
            training=tuple(_pin(run, width=width) for run in bench.training),
            held_out=tuple(_pin(run, width=width) for run in bench.held_out),
        )
        for width in (1e-4, 0.5)
    )
    effect = find_effect("force_offset")
    candidate = Candidate(
        effect=effect, place=offset.cart, signs=(1.0,), scales=(abs(offset.force),)
    )
    without = tuple(
        judge(
            fit_whole(h.fit.structure, h.fit.theta, pinned),
            pinned,
            added=h.added,
        )
        for h in path
    )
    grown = structure.with_effect(candidate)
    theta = np.append(chosen.fit.theta, np.sign(offset.force))
    fit = fit_whole(grown, theta, loose)
    final = judge(fit, loose, added=candidate)
    if final.error > 0.9 * without[-1].error:
        return chosen, path, bench
    return final, (*without, final), loose


def _pin(run: Run, *, width: float) -> Run:
    """Return a run whose encoders' zeros are those of the file, within `width` noises."""
    std = np.full(run.zero.size, 1.0)
    std[list(run.rows)] = width * run.sigma
    return replace(run, zero=np.zeros(run.zero.size), zero_std=std)
