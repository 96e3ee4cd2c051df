"""The gap workflow: split the runs, fit the chain, find effects, describe the remaining error."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from threading import Event, local
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.errors import DataError
from pipeline.estimation.force_balance import find_interventions
from pipeline.gap.advice import advised
from pipeline.gap.fit import Fitting, GapFit, Mapper, first_chain, fit_baseline
from pipeline.gap.judge import Study
from pipeline.gap.limits import AT_FLOOR
from pipeline.gap.pem.fit import start_all
from pipeline.gap.pem.model import compile_predictor
from pipeline.gap.residual import map_residual, windowed_residual_forces
from pipeline.gap.runs import notes_left_out, prepare, split_holdout
from pipeline.gap.search import Deadline, Search, are_followed, follow
from pipeline.gap.summary import (
    chain_covariance,
    chain_std,
    compare_by_record,
    find_windows,
    free_runs,
    list_contenders,
    list_effects,
    list_suspects,
    make_traces,
    repeatability,
)
from pipeline.gap.types import Gap
from pipeline.plant.augmented import compile_simulator
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import Chain
from pipeline.plant.effect import Effect
from pipeline.plant.simulator.compiler import is_compiled, kept_in
from pipeline.results import Analysis, Intervention, Record
from pipeline.setup import Setup
from pipeline.startup import with_one_thread
from pipeline.submission.load import spring_names
from pipeline.words.phrases import phrases
from pipeline.words.progress import Progress, silent

# ---------------------------------------------------------------------- two threads


@contextmanager
def two_workers() -> Iterator[Mapper]:
    """Give a function that maps like the built-in `map`, with two threads.

    A job that maps does so in its own thread. The first error ends a map.
    """
    given_up, inside = Event(), local()

    def begin() -> None:
        inside.worker = True

    def do(work: Callable[..., Any], *job: Any) -> Any:
        if given_up.is_set():  # after Ctrl-C nobody wants the other thread's work either
            raise CancelledError
        return work(*job)

    def mapper(work: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
        many = map if hasattr(inside, "worker") else pool.map
        return list(many(partial(do, work), *items))

    with ThreadPoolExecutor(2, initializer=begin) as pool:
        try:
            yield mapper
        finally:
            given_up.set()


# ----------------------------------------------------------------- compiling in a second process

_FOLDER = Path(__file__).parent / "pem"
_SCRIPT = "from pipeline.gap.pem.model import compile_predictor; compile_predictor()"


@contextmanager
def predictor_compiled() -> Iterator[None]:
    """Compile the prediction-error fit meanwhile, unless compiled code is stored or cannot be.

    So the first search on a computer with two cores begins eight seconds earlier. If the second
    process fails, it is compiled when it is needed.
    """
    stored = kept_in(_FOLDER) is None or is_compiled(_FOLDER, function="predict_run")
    if stored or (os.cpu_count() or 1) == 1:
        yield
        return
    command, none = [sys.executable, "-P", "-c", _SCRIPT], subprocess.DEVNULL
    with subprocess.Popen(
        command, stdin=none, stdout=none, stderr=none, env=with_one_thread()
    ) as beside:
        try:
            yield
        except BaseException:
            beside.kill()
            raise


# ---------------------------------------------------------------------- the workflow


def investigate(analysis: Analysis, *, progress: Progress, budget: float | None = None) -> Gap:
    """Explain the gap of a submission's time records, starting from the identified chain.

    Recordings that the identification left out are not used here either, unless they only differ
    from a linear chain and the laws of the catalogue follow them. `budget` is a time limit
    in s, not counting compilation; if it is reached, the result is the best answer so far.

    Without a spring that the recordings show, no effect is searched for, because every effect would
    only take the place of the spring.

    Raises
    ------
    DataError : no record can be used.
    """
    start = analysis.fit and analysis.fit.chain  # even a failed fit is near enough to start from
    progress("preparing the simulator")
    with predictor_compiled():
        compile_simulator()
    compile_predictor()
    out = {one.experiment for one in analysis.left_out}
    odd = {one.experiment for one in analysis.left_out if one.excludes == "odd"}
    records = [record for record in analysis.records if record.id not in out]
    if analysis.records and not records:
        reasons = "; ".join(notes_left_out(analysis.left_out))
        raise DataError(f"gap: every recording is left out; {reasons}")
    doubtful = [record for record in analysis.records if record.id in odd]
    explain = partial(explain_gap, records, analysis.bench, chain=start, progress=progress)
    if analysis.lacks_springs:
        gap = explain(catalogue=(), budget=budget)
        gap = replace(gap, residual=(), contenders=())
    else:
        gap = explain(doubtful=doubtful, budget=budget)
    used = {*gap.training, *gap.held_out}
    left_out = tuple(one for one in analysis.left_out if one.experiment not in used)
    gap = replace(
        gap,
        title=analysis.title,
        provenance=analysis.provenance,
        left_out=left_out,
        groups=analysis.groups,
        causes=tuple(c for c in analysis.causes if not c.run or c.run in used),
        notes=(*notes_left_out(left_out), *gap.notes),
    )
    return advised(gap)


def explain_gap(
    records: Sequence[Record],
    bench: Setup,
    *,
    chain: Chain | None = None,
    doubtful: Sequence[Record] = (),
    catalogue: Sequence[Effect] = CATALOGUE,
    budget: float | None = None,
    progress: Progress = silent,
) -> Gap:
    """Find where the linear chain and the records disagree, name the cause, and reduce the gap.

    Parameters
    ----------
    records : records of any kind except tables. Only a few dwells are used, and no feedback runs if
        there are open-loop runs.
    chain : the identified chain, one of the starts of the fit.
    doubtful : further records, which are used if the laws of the catalogue follow them.
    catalogue : the effects that may be named.
    budget : time limit in s. If it is reached, the result is the best answer so far. By default
        the search ends by itself, and the answer does not depend on the machine.

    Raises
    ------
    DataError : no record can be used.
    """
    notes: list[str] = []
    records, interventions = _what_to_use(records, doubtful, bench, chain, catalogue)
    runs = prepare(records, springs=bench.springs, interventions=interventions, notes=notes)
    training, held_out = split_holdout(runs, notes=notes)
    # If the longest run was cut in time, there is one run more than before.
    whole = runs if len(training) + len(held_out) > len(runs) and not any(bench.springs) else []
    # The matrices are small, so threads inside BLAS would only slow the workers down.
    with threadpool_limits(1, user_api="blas"), two_workers() as mapper:
        deadline = Deadline(mapper, seconds=budget)
        progress("fitting the linear chain")
        linear, training = fit_baseline(training, springs=bench.springs, start=chain, mapper=mapper)
        springs = linear.structure.springs
        stated = zip(spring_names(bench.n), bench.springs, springs, strict=True)
        missing = [name for name, is_stated, there in stated if is_stated and not there]
        notes += [phrases("gap").text("note_no_spring", spring=name) for name in missing]
        bench = replace(bench, springs=springs)
        study = Study(
            training=(),
            held_out=tuple(held_out),
            springs=springs,
            catalogue=tuple(catalogue),
            fitting=Fitting(mapper=mapper),
            progress=progress,
            whole=tuple(whole),
        ).with_noise(training)
        repeats = repeatability([*study.training, *study.held_out]) or 0.0
        search = Search(replace(study, repeatability=repeats), linear, deadline)
        search.find_effects()
        search.remeasure_noise()
        search.change_sides()
        search.add_constant_force()
        search.reach_verdict()
        zeros = {run.id: own.zero for run, own in search.judged}
        gap = replace(
            _describe(search, bench),
            free_run=free_runs(search.final, runs, zeros),
            interventions=interventions,
            notes=(*notes, *_notes(search, budget)),
        )
    return advised(gap)


def _what_to_use(
    records: Sequence[Record],
    doubtful: Sequence[Record],
    bench: Setup,
    chain: Chain | None,
    catalogue: Sequence[Effect],
) -> tuple[list[Record], tuple[Intervention, ...]]:
    """Return the records to use, and the stretches in which a hand acts.

    Interventions and doubtful records are found with a linear chain. Those that the laws of the
    catalogue follow are neither.
    """
    interventions = find_interventions(records)
    springs, whole = bench.springs, partial(prepare, springs=bench.springs, notes=[])
    suspects: list[tuple[Intervention | Record, str, float, float]] = [
        *((one, one.experiment, one.start, one.end) for one in interventions),
        *((one, one.id, float(one.t[0]), float(one.t[-1])) for one in doubtful),
    ]
    if not suspects or not catalogue:
        return list(records), interventions
    cut = whole(records, interventions=interventions)
    uncut = {run.id: run for run in whole([*records, *doubtful])}
    suspects = [suspect for suspect in suspects if suspect[1] in uncut]
    windows = [(uncut[name], start, end) for _, name, start, end in suspects]
    chains = [first_chain(cut, springs=springs), *([] if chain is None else [chain])]
    with threadpool_limits(1, user_api="blas"):
        followed_runs = follow(cut, catalogue, map)
        model = start_all(followed_runs, springs=springs, chains=chains)
        told = are_followed(windows, model, followed_runs)
    known = [id(one) for (one, *_), fine in zip(suspects, told, strict=True) if fine]
    used = [*records, *(record for record in doubtful if id(record) in known)]
    return used, tuple(one for one in interventions if id(one) not in known)


def _describe(search: Search, bench: Setup) -> Gap:
    """Return the result of a search as a `Gap`."""
    study, path, chosen = search.study, search.path, search.chosen
    final = replace(search.final, covariance=None) if _is_rugged(search.final) else search.final
    verdict, found, close = search.verdict, search.found, search.close
    driven = any(run.driven for run in study.training)
    # Without an input, the first mass is set to 1, so this is the unit of forces.
    units = bench.units if driven else replace(bench.units, input=f"{bench.units.position}/s^2")
    effects = list_effects(path, final, found, units)
    traces = make_traces(path[0], chosen, study)
    model = final.structure.model(final.theta)
    order = [(found.effect.key, found.where) for found in effects]
    terms = sorted(model.terms, key=lambda term: order.index((term.effect.key, term.where)))
    enough = verdict in ("none", "named")
    settled = enough and study.is_noise(chosen)
    left = () if enough else find_windows(chosen.fit, study.training)
    told = enough or (verdict == "ambiguous" and study.explains(chosen))
    measure_left = cache(
        partial(windowed_residual_forces, final, *zip(*search.judged, strict=True))
    )
    return Gap(
        bench=bench,
        verdict=verdict,
        complete=not search.deadline.cut,
        effects=effects,
        baseline=path[0].error,
        final=chosen.error,
        noise_floor=study.floor,
        repeatability=study.repeatability or None,
        by_record=compare_by_record(traces, study),
        where=find_windows(path[0].fit, study.training) if verdict != "none" else (),
        linear=path[0].fit.structure.model(path[0].fit.theta),
        model=replace(model, terms=tuple(terms)),
        training=tuple(dict.fromkeys(run.id for run in study.training)),
        held_out=tuple(dict.fromkeys(run.id for run in study.held_out)),
        traces=traces,
        chain_std=chain_std(final),
        chain_covariance=chain_covariance(final),
        spread=_learnt_spread(chosen.fit),
        suspects=list_suspects(found, effects) if verdict == "unexplained" else (),
        left=left,
        residual=() if told else map_residual(measure_left(), replace(bench, units=units)),
        measure_left=measure_left,
        contenders=() if settled else list_contenders(chosen, close or found),
    )


def _notes(search: Search, budget: float | None) -> list[str]:
    """Return the notes on the search and on how it ended."""
    words, study, chosen, notes = phrases("gap"), search.study, search.chosen, search.notes.copy()
    times = f"{chosen.error / study.floor:.1f}"
    if search.verdict not in ("none", "unexplained") and not study.explains(chosen):
        notes.append(words.text("note_left", times=times))
    elif search.verdict == "named" and study.may_be_half(chosen):
        notes.append(words.text("note_second", times=times))
    if search.deadline.cut:
        notes.append(words.text("note_budget", seconds=f"{budget:g}"))
    if _is_rugged(search.final):
        notes.append(words.text("note_contact"))
    return notes


def _is_rugged(fit: GapFit) -> bool:
    """Return whether the cost has many narrow minima, so its curvature gives no standard error.

    On simulated benches, gaps of backlash were up to 70 such errors off, even at the noise floor.
    The errors of an end stop were right, but only if nothing else was left.
    """
    structure = fit.structure
    return structure.has_play or (structure.has_contact and fit.chi > AT_FLOOR)


def _learnt_spread(fit: GapFit) -> dict[int, float]:
    """Return, by cart, how much its dry friction varies from run to run; none if it is fixed."""
    moved = np.any([nuisance.scatter != 1.0 for nuisance in fit.nuisance], axis=0)
    dry = fit.structure.dry
    return {i + 1: float(fit.spread[i]) for i in range(len(dry)) if dry[i] and moved[i]}
