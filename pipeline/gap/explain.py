"""The gap workflow in one line: split, fit the chain, search, judge, say what is left."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.estimation.interventions import find_interventions
from pipeline.gap import limits
from pipeline.gap.data.runs import Run
from pipeline.gap.data.sides import prepare, take_sides
from pipeline.gap.fit.baseline import fit_baseline, measure_noise
from pipeline.gap.fit.levenberg_marquardt import Fit, fit_model
from pipeline.gap.fit.restart import holding_force
from pipeline.gap.fit.structure import Candidate
from pipeline.gap.search.deadline import Deadline, OutOfTime
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge
from pipeline.gap.search.search import search, steps_to, without_nothing
from pipeline.gap.search.whole import finish, fit_whole
from pipeline.gap.types import FoundEffect, Gap
from pipeline.gap.verdict.account import (
    chain_covariance,
    chain_std,
    compare_by_record,
    list_contenders,
    list_effects,
    list_suspects,
    make_traces,
    repeatability,
)
from pipeline.gap.verdict.decision import choose_experiment, reach_verdict
from pipeline.gap.verdict.free_run import free_runs
from pipeline.gap.verdict.left_force import left_forces
from pipeline.gap.verdict.offset import find_offset
from pipeline.gap.verdict.residual_map import map_residual
from pipeline.gap.verdict.where import find_windows
from pipeline.plant.linear.chain import Chain
from pipeline.plant.nonlinear.effects import CATALOGUE
from pipeline.plant.nonlinear.effects.base import Effect, Term
from pipeline.results import Record

_SETTLED = 0.01  # chi-square: a tenth of a standard error
_NOISE_ROUNDS = 2  # of measuring the noise anew
_PINNED, _LOOSE = 1e-4, 0.5  # noises an encoder's zero may be off: not at all; by its rounding


def explain_gap(
    records: Sequence[Record],
    *,
    springs: Sequence[bool],
    chain: Chain | None = None,
    catalogue: Sequence[Effect] = CATALOGUE,
    position_unit: str = "cm",
    input_unit: str = "V",
    workers: int = 2,
    budget: float | None = None,
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
    budget : s; past it the best answer so far. By default the search ends by itself, and the
        answer does not depend on the machine.
    tell : takes a line of progress.

    Raises
    ------
    DataError : no usable record.
    """
    notes: list[str] = []
    interventions = find_interventions(records)
    runs = prepare(records, springs=tuple(springs), interventions=interventions, notes=notes)
    training, held_out = take_sides(runs, notes=notes)
    # One run more than there were: the longest was cut in time.
    whole = runs if len(training) + len(held_out) > len(runs) and not any(springs) else []
    # Its matrices are small: BLAS with threads of its own only gets in the workers' way.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(max_workers=workers) as pool:
        deadline = Deadline(pool.map, seconds=budget)
        tell("fitting the linear chain")
        fit, training = fit_baseline(training, springs=springs, start=chain, mapper=pool.map)
        sigma = {row: s for run in training for row, s in zip(run.rows, run.sigma, strict=True)}
        held_out = [_with_noise(run, sigma) for run in held_out]
        study = Study(
            training=tuple(training),
            held_out=tuple(held_out),
            springs=tuple(springs),
            catalogue=tuple(catalogue),
            repeatability=repeatability([*training, *held_out]) or 0.0,
            mapper=pool.map,
            tell=tell,
            whole=tuple(_with_noise(run, sigma) for run in whole),
        )
        chosen, found = _investigate(fit, study, deadline)
        for _ in range(_NOISE_ROUNDS):
            if chosen.fit.chi > limits.TOO_GOOD or deadline.cut:
                break
            # Less is left than was taken for noise: the misfit of the linear model was in it.
            quiet = _quieter(study, chosen)
            fit = fit_model(fit, quiet.training, mapper=pool.map)
            again = _investigate(fit, quiet, deadline)
            if not deadline.cut:
                study, (chosen, found) = quiet, again
        if chosen.fit.chi < limits.NEAR_FLOOR**2 < chosen.held.chi and not deadline.cut:
            # An effect that acts only in the held-out runs cannot be found from the training runs.
            turned = replace(study, training=study.held_out, held_out=study.training)
            fit = fit_model(fit, turned.training, mapper=pool.map)
            again = _investigate(fit, turned, deadline)
            if again[0].at_floor and not deadline.cut:
                study, (chosen, found) = turned, again
                notes.append("training and held-out data changed sides: only the latter showed it")
        path = steps_to(chosen, found, study)
        with suppress(OutOfTime):
            path, judged_by = _with_offset(path, replace(study, mapper=deadline.map))
            if judged_by is not None:
                # The others were judged with the encoders' zeros free.
                study, found = judged_by, list(path)
        sample_time = max(run.record.sample_time for run in study.training)
        while True:
            verdict, path, close = reach_verdict(path, found, study=study, sample_time=sample_time)
            chosen = path[-1]
            with suppress(OutOfTime):
                chosen = _settled(chosen, replace(study, mapper=deadline.map))
            final = finish(chosen.fit, study)
            without = without_nothing(chosen, final, study)
            if without is None:
                break
            # Fitted to its end, an effect may turn out to be nothing.
            found = [*found, *path, without]
            path = steps_to(without, found, study)
        if study.whole:
            judged_runs, nuisance = study.whole, final.nuisance
        else:
            chosen = replace(chosen, fit=final)
            judged_runs = (*study.training, *study.held_out)
            nuisance = (*final.nuisance, *chosen.held.nuisance)
        path = (*path[:-1], chosen)
        zeros = {run.id: own.zero for run, own in zip(judged_runs, nuisance, strict=True)}
        free = free_runs(final, runs, zeros)
    if verdict == "named" and not study.explains(chosen):
        verdict = "partial"
    if verdict not in ("none", "unexplained") and not study.explains(chosen):
        times = chosen.error / study.floor
        notes.append(f"{times:.1f} times the noise is left: something remains")
    elif verdict == "named" and _may_be_half(chosen, study):
        times = chosen.error / study.floor
        notes.append(f"{times:.1f} times the noise is left: a second, smaller effect may act")
    if deadline.cut:
        notes.append(
            f"the search ended after the {budget:g} s allowed: this is the best answer so far, and "
            "another run may come further (--budget SECONDS allows more)"
        )
    if chosen.has_contact and final.covariance is not None:
        notes.append(
            "beside a contact (a backlash, a stop) the stated errors are the least they can be"
        )
    driven = any(np.any(run.command) for run in study.training)
    force_unit = input_unit if driven else f"{position_unit}/s^2"  # the first mass is one
    effects = list_effects(
        path,
        final,
        found,
        position_unit=position_unit,
        input_unit=force_unit,
    )
    traces = make_traces(path[0], chosen, study)
    model = final.structure.model(final.theta)
    enough = verdict in ("none", "named")
    settled = enough and study.is_noise(chosen)
    left = () if enough else find_windows(chosen.fit, study.training)
    told = enough or (verdict == "ambiguous" and study.explains(chosen))
    forces = left_forces(final, judged_runs, nuisance)
    return Gap(
        verdict=verdict,
        effects=effects,
        baseline=path[0].error,
        final=chosen.error,
        noise_floor=study.floor,
        repeatability=study.repeatability or None,
        by_record=compare_by_record(traces, study),
        where=find_windows(path[0].fit, study.training) if verdict != "none" else (),
        next_experiment=choose_experiment(
            verdict, chosen, close, left, repeated=study.repeatability > 0
        ),
        linear=path[0].fit.structure.model(path[0].fit.theta),
        model=replace(model, terms=_in_order(model.terms, effects)),
        training=tuple(dict.fromkeys(run.id for run in study.training)),
        held_out=tuple(dict.fromkeys(run.id for run in study.held_out)),
        interventions=interventions,
        traces=traces,
        chain_std=chain_std(final),
        chain_covariance=chain_covariance(final),
        spread=_learnt_spread(chosen.fit),
        suspects=list_suspects(found, effects) if verdict == "unexplained" else (),
        left=left,
        residual=()
        if told
        else map_residual(forces, springs=springs, position=position_unit, drive=force_unit),
        left_forces=forces,
        free_run=free,
        complete=not deadline.cut,
        notes=tuple(notes),
        contenders=() if settled else list_contenders(chosen, close or found),
    )


def _may_be_half(chosen: Hypothesis, study: Study) -> bool:
    """Does a name leave what no contact's own law, and no difference of repeats, explains?"""
    enough = max(limits.FURTHER * study.floor, limits.ENOUGH_REPEATS * study.repeatability)
    return chosen.error > enough and not chosen.has_contact


def _settled(hypothesis: Hypothesis, study: Study) -> Hypothesis:
    """Return it where its cost falls no more: a search ends within some standard errors.

    Its `bic` stays: its rivals are compared as the search left them, and so is it.
    """
    fit = hypothesis.fit
    fit = fit_model(
        fit,
        study.training,
        nuisance=fit.nuisance,
        spread=fit.spread,
        scatter_free=any(np.any(nuisance.scatter != 1.0) for nuisance in fit.nuisance),
        tolerance=_SETTLED / fit.n_points,
        mapper=study.mapper,
    )
    return replace(judge(fit, study), bic=hypothesis.bic)


def _learnt_spread(fit: Fit) -> dict[int, float]:
    """Return the run-to-run spread of each cart's dry friction, where the runs asked for one."""
    moved = np.any([nuisance.scatter != 1.0 for nuisance in fit.nuisance], axis=0)
    dry = fit.structure.dry
    return {i + 1: float(fit.spread[i]) for i in range(len(dry)) if dry[i] and moved[i]}


def _in_order(terms: Sequence[Term], effects: Sequence[FoundEffect]) -> tuple[Term, ...]:
    """Return the terms in the order in which the effects were found."""
    order = [(found.effect.key, found.where) for found in effects]
    return tuple(sorted(terms, key=lambda term: order.index((term.effect.key, term.where))))


# ------------------------------------------------------------------------ the noise


def _quieter(study: Study, best: Hypothesis) -> Study:
    """Return the study with the noise that the best model leaves."""
    training = measure_noise(best.fit, study.training, study.training)
    sigma = {row: s for run in training for row, s in zip(run.rows, run.sigma, strict=True)}
    held_out = tuple(_with_noise(run, sigma) for run in study.held_out)
    whole = tuple(_with_noise(run, sigma) for run in study.whole)
    return replace(study, training=tuple(training), held_out=held_out, whole=whole)


def _with_noise(run: Run, sigma: dict[int, float]) -> Run:
    return replace(
        run, sigma=np.array([sigma.get(r, s) for r, s in zip(run.rows, run.sigma, strict=True)])
    )


# -------------------------------------------------------------------- the hypotheses


def _investigate(fit: Fit, study: Study, deadline: Deadline) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return the hypothesis chosen and all that were judged in time, the linear one first."""
    baseline = judge(fit, study)
    if baseline.at_floor or baseline.error < limits.AS_REPEATS * study.repeatability:
        return baseline, [baseline]
    study.tell(f"linear model: error {baseline.error:.1%} of the motion on held-out runs")
    timed = replace(study, mapper=deadline.map)
    return search(baseline, timed)


def _with_offset(
    path: tuple[Hypothesis, ...], study: Study
) -> tuple[tuple[Hypothesis, ...], Study | None]:
    """Return the path with a constant force at its end, where the rest points ask for one.

    With the force in the model the encoders' zeros are those of the file, within half a noise:
    then the study by which all is judged is returned with it.
    """
    chosen = path[-1]
    structure = chosen.fit.structure
    effect = next((effect for effect in study.catalogue if effect.only_rest), None)
    runs = [*study.training, *study.held_out]
    nuisance = [*chosen.fit.nuisance, *chosen.held.nuisance]
    offset = find_offset(structure.chain(chosen.fit.theta), runs, nuisance)
    if effect is None or offset is None:
        return path, None
    holding = holding_force(structure.model(chosen.fit.theta).tables())
    if abs(offset.force) < holding[offset.cart - 1]:
        # What holds a cart as far from its equilibrium is there: no proof of a constant force.
        return path, None
    pinned, loose = (
        replace(
            study,
            training=tuple(_pin(run, width=width) for run in study.training),
            held_out=tuple(_pin(run, width=width) for run in study.held_out),
        )
        for width in (_PINNED, _LOOSE)
    )
    candidate = Candidate(
        effect=effect, place=offset.cart, signs=(1.0,), scales=(abs(offset.force),)
    )
    without = tuple(judge(fit_whole(h.fit, pinned), pinned) for h in path)
    fit = fit_whole(chosen.fit.with_effect(candidate, (offset.force,)), loose)
    final = judge(fit, loose)
    if final.error > min(
        limits.OFFSET_GAIN * without[-1].error, limits.OFFSET_AS_FREE * chosen.error
    ):
        return path, None
    return (*without, final), loose


def _pin(run: Run, *, width: float) -> Run:
    """Return a run whose encoders' zeros are those of the file, within `width` noises."""
    std = np.full(run.zero.size, 1.0)
    std[list(run.rows)] = width * run.sigma
    return replace(run, zero=np.zeros(run.zero.size), zero_std=std)
