"""The gap workflow in one line: split, fit the chain, search, judge, say what is left."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from pipeline.errors import DataError
from pipeline.gap.baseline import fit_baseline, measure_noise
from pipeline.gap.fit import Fit, Locals, covariance, fit_model, simulate_run
from pipeline.gap.offset import find_offset
from pipeline.gap.runs import Run, cut_shots, make_run
from pipeline.gap.search import (
    Bench,
    Hypothesis,
    choose,
    fit_whole,
    judge,
    prune,
    search,
)
from pipeline.gap.split import split, without_twins
from pipeline.gap.structure import Candidate
from pipeline.gap.types import FoundEffect, Gap, NamedValue, RecordGap, Rival, Trace, Verdict
from pipeline.gap.where import find_windows
from pipeline.plant.chain import Chain
from pipeline.plant.effects import find_effect
from pipeline.plant.effects.base import Term
from pipeline.results import Record

_LAST_SHARE = 0.4  # of a single run is held out
_MOST_DWELLS = 4  # sine dwells used; they say little beyond their frequency
_NOISE_ROUNDS, _TOO_GOOD = 2, 0.7  # chi-square per point no fit to true noise falls to
_LEAST_MOTION = 8.0  # encoder steps
_WINDOW = 0.5  # s; a chain without springs drifts, so it is judged over windows
_CLOSE_ERROR, _CLOSE_GAIN, _CLOSE_BIC = 1.15, 0.10, 40.0
_REFUSED_SHARE, _REFUSED_FLOOR = 0.5, 1.5
_DECISIVE_SHARE, _DECISIVE_RIVAL = 0.8, 1.2


def explain_gap(
    records: Sequence[Record],
    *,
    springs: Sequence[bool],
    chain: Chain | None = None,
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
    workers : threads.
    tell : takes a line of progress.

    Raises
    ------
    DataError : no usable record.
    """
    notes: list[str] = []
    runs = _prepare(records, springs=tuple(springs), notes=notes)
    training, held_out = _sides(runs, notes=notes)
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
        chosen, path, bench = _with_offset(chosen, path, bench)
        final = covariance(chosen.fit, bench.training, mapper=pool.map)
    floor = _pooled_floor(bench.held_out)
    if chosen.key and chosen.error > _REFUSED_FLOOR * floor:
        notes.append(f"{chosen.error / floor:.1f} times the noise is left: something small remains")
    sample_time = max(run.record.sample_time for run in bench.training)
    verdict, close = _verdict(chosen, path[0], found, floor=floor, sample_time=sample_time)
    effects = _effects(path, final, found, position_unit=position_unit, input_unit=input_unit)
    order = [*bench.training, *bench.held_out]
    return Gap(
        verdict=verdict,
        effects=effects,
        baseline=path[0].error,
        final=chosen.error,
        noise_floor=floor,
        repeatability=_repeatability(order),
        by_record=_by_record(path[0], chosen, bench),
        where=find_windows(path[0].fit, bench.training) if verdict != "none" else (),
        next_experiment=_next_experiment(verdict, chosen, close),
        linear=path[0].fit.structure.model(path[0].fit.theta),
        model=chosen.fit.structure.model(chosen.fit.theta),
        training=tuple(run.id for run in bench.training),
        held_out=tuple(run.id for run in bench.held_out),
        traces=_traces(path[0], chosen, bench),
        chain_std=_chain_std(final),
        spread={
            i + 1: float(chosen.fit.spread[i])
            for i, dry in enumerate(chosen.fit.structure.dry)
            if dry
        },
        notes=tuple(notes),
    )


# ------------------------------------------------------------------------- the runs


def _prepare(
    records: Sequence[Record], *, springs: tuple[bool, ...], notes: list[str]
) -> list[Run]:
    n = len(springs) - 1
    usable = [r for r in records if r.kind != "bode" and r.t.size >= 50 and r.free]
    open_loop = [r for r in usable if r.kind != "closed_loop"]
    if open_loop and len(open_loop) < len(usable):
        notes.append("runs under feedback are left out: open-loop runs tell more")
        usable = open_loop
    dwells = [r for r in usable if r.kind == "sine"]
    if len(dwells) > _MOST_DWELLS:
        dwells.sort(key=lambda r: r.omega or 0.0)
        picked = {round(i) for i in np.linspace(0, len(dwells) - 1, _MOST_DWELLS)}
        left_out = {r.id for i, r in enumerate(dwells) if i not in picked}
        usable = [r for r in usable if r.id not in left_out]
    if not usable:
        raise DataError("gap: needs a time record with a cart free to move, found none")
    moving = [r for r in usable if _moves(r)]
    if len(moving) < len(usable):
        notes.append(f"{len(usable) - len(moving)} runs without motion left out")
    if not moving:
        raise DataError("gap: needs a run in which a free cart moves, found none")
    runs = [make_run(record, n=n) for record in moving]
    if not any(np.any(run.command) for run in runs):
        notes.append("no run has an input: forces are per unit of the first mass")
    kept = without_twins(runs)
    if len(kept) < len(runs):
        notes.append(f"{len(runs) - len(kept)} duplicate files left out")
    if not any(springs):
        notes.append("no springs: judged over windows of half a second, not by the drift")
        kept = [cut_shots(run, length=_WINDOW) for run in kept]
    return kept


def _moves(record: Record) -> bool:
    spans = [np.ptp(record.position(c)) for c in record.carts if c in record.free]
    steps = [record.encoder_step(c) for c in record.carts if c in record.free]
    return any(span > _LEAST_MOTION * step for span, step in zip(spans, steps, strict=True))


def _sides(runs: list[Run], *, notes: list[str]) -> tuple[list[Run], list[Run]]:
    """Return training and held-out runs; a single run is cut in time."""
    teach, judge_by = split(runs)
    if judge_by:
        return [runs[i] for i in teach], [runs[i] for i in judge_by]
    notes.append("one run of each kind: the last 40 % of the longest is held out")
    longest = max(range(len(runs)), key=lambda i: runs[i].t[-1] - runs[i].t[0])
    run = runs[longest]
    cut = int((1.0 - _LAST_SHARE) * run.t.size)
    pieces = []
    for piece in (slice(0, cut), slice(cut, None)):
        record = replace(
            run.record,
            # A later piece of a decay has no hand in it.
            kind=run.record.kind if piece.start == 0 and run.record.kind != "decay" else "sweep",
            t=run.t[piece],
            u=None if run.record.u is None else run.record.u[-run.t.size :][piece],
            y=np.array([run.record.y[j][-run.t.size :][piece] for j in range(len(run.record.y))]),
            reference=None,
        )
        part = make_run(record, n=run.zero.size)
        moving = replace(part, zero=run.zero, zero_std=run.zero_std, rest=run.rest)
        pieces.append(moving if len(run.shots) == 2 else cut_shots(moving, length=_WINDOW))
    others = [r for i, r in enumerate(runs) if i != longest]
    return [*others, pieces[0]], [pieces[1]]


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
    if baseline.at_floor:
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
    if offset is None or any(structure.dry):
        return chosen, path, bench
    pinned, loose = (
        replace(
            bench,
            training=tuple(_pin(run, width_in_sigma=width) for run in bench.training),
            held_out=tuple(_pin(run, width_in_sigma=width) for run in bench.held_out),
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
            parent=h.parent,
        )
        for h in path
    )
    grown = structure.with_effect(candidate)
    theta = np.append(chosen.fit.theta, np.sign(offset.force))
    fit = fit_whole(grown, theta, loose)
    final = judge(fit, loose, added=candidate, parent=without[-1])
    if final.error > 0.9 * without[-1].error:
        return chosen, path, bench
    return final, (*without, final), loose


def _pin(run: Run, *, width_in_sigma: float) -> Run:
    """Return a run whose encoders' zeros are those of the file."""
    width = np.full(run.zero.size, 1.0)
    width[list(run.rows)] = width_in_sigma * run.sigma
    return replace(run, zero=np.zeros(run.zero.size), zero_std=width)


# ---------------------------------------------------------------------- the verdict


def _verdict(
    chosen: Hypothesis,
    baseline: Hypothesis,
    found: Sequence[Hypothesis],
    *,
    floor: float,
    sample_time: float,
) -> tuple[Verdict, list[Hypothesis]]:
    if not chosen.key:
        return ("none" if baseline.at_floor else "unexplained"), []
    refused = chosen.error > _REFUSED_SHARE * baseline.error
    refused &= chosen.error > _REFUSED_FLOOR * floor
    if refused and not _decisive(chosen, baseline, found):
        return "unexplained", []
    gain = baseline.bic - chosen.bic
    close = [
        rival
        for rival in found
        if len(rival.key) == len(chosen.key)
        and len(rival.key - chosen.key) == 1
        and rival.error < _CLOSE_ERROR * chosen.error
        and rival.bic - chosen.bic < min(_CLOSE_GAIN * gain, _CLOSE_BIC)
        and not _same_thing(rival, chosen, sample_time=sample_time)
    ]
    return ("ambiguous" if close else "named"), close


def _decisive(chosen: Hypothesis, baseline: Hypothesis, found: Sequence[Hypothesis]) -> bool:
    """Is the name beyond doubt although much of the gap remains?

    It must help clearly, and every rival of another kind must leave clearly more.
    """
    if chosen.error > _DECISIVE_SHARE * baseline.error or len(chosen.key) > 1:
        return False
    family = chosen.fit.structure.effects[0].effect.family
    rivals = [h for h in found if len(h.key) == 1 and h.key != chosen.key]
    others = [h for h in rivals if h.fit.structure.effects[0].effect.family != family or not family]
    return all(h.error > _DECISIVE_RIVAL * chosen.error for h in others)


def _same_thing(rival: Hypothesis, chosen: Hypothesis, *, sample_time: float) -> bool:
    """Is a rival a richer form of the same law, or one the data provably cannot tell from it?"""
    (mine,) = chosen.key - rival.key
    (other,) = rival.key - chosen.key
    if find_effect(other[0]).grows_from == mine[0] and other[1] == mine[1]:
        return True
    names = {mine[0], other[0]}
    if names == {"sensor_gain"}:
        return True  # only ratios of gains show
    if names == {"input_delay", "actuator_lag"}:
        term = next(
            t for t in chosen.fit.structure.model(chosen.fit.theta).terms if t.effect.key == mine[0]
        )
        return abs(term.values[0]) < 0.5 * sample_time
    return False


def _next_experiment(verdict: Verdict, chosen: Hypothesis, close: Sequence[Hypothesis]) -> str:
    if verdict == "ambiguous":
        own = next(iter(chosen.key - close[0].key))
        other = next(iter(close[0].key - chosen.key))
        texts = {find_effect(key[0]).deciding_run for key in (own, other)}
        return " ".join(sorted(texts))
    if verdict == "unexplained":
        return (
            "Repeat each run, then free decays of one cart at a time from two release heights: "
            "what is in the carts shows there, what is in the drive does not."
        )
    if verdict == "named":
        return chosen.fit.structure.effects[-1].effect.deciding_run
    return ""


def _effects(
    path: Sequence[Hypothesis],
    final: Fit,
    found: Sequence[Hypothesis],
    *,
    position_unit: str,
    input_unit: str,
) -> tuple[FoundEffect, ...]:
    structure = final.structure
    terms = structure.model(final.theta).terms
    chosen = path[-1]
    same_size = {h.key: h for h in found if len(h.key) == len(chosen.key)} | {chosen.key: chosen}
    lowest = min(h.bic for h in same_size.values())
    weight = {key: float(np.exp(-0.5 * (h.bic - lowest))) for key, h in same_size.items()}
    total = sum(weight.values())
    slopes = structure.physical_derivative(final.theta)
    std = np.sqrt(np.diag(final.covariance)) * slopes if final.covariance is not None else None
    out = []
    for index, (candidate, term) in enumerate(zip(structure.effects, terms, strict=True)):
        rest = chosen.key - {candidate.key}
        rivals = sorted(
            ((key, h) for key, h in same_size.items() if rest < key and key != chosen.key),
            key=lambda pair: pair[1].bic,
        )
        values = _named_values(
            term,
            None if std is None else std[structure.span(index)],
            position_unit=position_unit,
            input_unit=input_unit,
        )
        reported = {p.name for p in term.effect.parameters if p.reported}
        out.append(
            FoundEffect(
                effect=term.effect,
                where=term.where,
                parameters={k: v for k, v in values.items() if k in reported},
                details={k: v for k, v in values.items() if k not in reported},
                confidence=sum(w for key, w in weight.items() if candidate.key in key) / total,
                nrmse_before=path[index].error,
                nrmse_after=path[index + 1].error,
                rivals=tuple(
                    Rival(
                        effect=find_effect(next(iter(key - rest))[0]),
                        where=_where(next(iter(key - rest))),
                        nrmse_after=h.error,
                        confidence=weight[key] / total,
                    )
                    for key, h in rivals[:4]
                ),
            )
        )
    return tuple(out)


def _where(key: tuple[str, int]) -> dict[str, int]:
    return find_effect(key[0]).where(key[1])


def _named_values(
    term: Term, std: np.ndarray | None, *, position_unit: str, input_unit: str
) -> dict[str, NamedValue]:
    return {
        p.name: NamedValue(
            value=float(value),
            std=None if std is None else float(std[i]),
            unit=p.unit_text(position=position_unit, input=input_unit),
        )
        for i, (p, value) in enumerate(zip(term.effect.parameters, term.values, strict=True))
    }


def _chain_std(fit: Fit) -> dict[str, float]:
    """Return the standard error of every mass, damping and spring by its name."""
    if fit.covariance is None:
        return {}
    structure, chain = fit.structure, fit.structure.chain(fit.theta)
    values = {f"{letter}_{i}": v for letter, row in (("m", chain.m), ("c", chain.c))
              for i, v in enumerate(row, start=1)}  # fmt: skip
    values |= {f"k_{j + 1}": chain.k[j] for j in structure.rows}
    # The vector holds their logarithms, whose errors are relative.
    relative = np.sqrt(np.diag(fit.covariance))[: structure.base_size]
    return {name: float(v * r) for (name, v), r in zip(values.items(), relative, strict=True)}


# ---------------------------------------------------------------------- the figures


def _pooled_floor(runs: Sequence[Run]) -> float:
    noise = sum(float((run.sigma**2).sum()) * run.t.size for run in runs)
    motion = sum(float((run.swing**2).sum()) * run.t.size for run in runs)
    return float(np.sqrt(noise / motion))


def _sides_of(hypothesis: Hypothesis, bench: Bench) -> list[tuple[Run, Locals, bool]]:
    """Return every run with its own unknowns, and whether it was held out."""
    training = zip(bench.training, hypothesis.fit.locals_, strict=True)
    held_out = zip(bench.held_out, hypothesis.held.locals_, strict=True)
    return [(run, own, False) for run, own in training] + [
        (run, own, True) for run, own in held_out
    ]


def _traces(before: Hypothesis, after: Hypothesis, bench: Bench) -> tuple[Trace, ...]:
    out = []
    for (run, own_before, held), (_, own_after, _) in zip(
        _sides_of(before, bench), _sides_of(after, bench), strict=True
    ):
        linear = simulate_run(before.fit.structure, before.fit.theta[None], run, own_before)[0]
        final = simulate_run(after.fit.structure, after.fit.theta[None], run, own_after)[0]
        u = run.record.u[-run.t.size :] if run.record.u is not None else np.zeros(run.t.size)
        out += [
            Trace(
                experiment=run.id,
                cart=row + 1,
                held_out=held,
                t=run.t,
                u=u,
                measured=run.y[j],
                baseline=linear[j],
                final=final[j],
                zero=float(own_after.zero[row]),
            )
            for j, row in enumerate(run.rows)
        ]
    return tuple(out)


def _by_record(before: Hypothesis, after: Hypothesis, bench: Bench) -> tuple[RecordGap, ...]:
    runs = {run.id: run for run in (*bench.training, *bench.held_out)}
    out = []
    for trace in _traces(before, after, bench):
        run = runs[trace.experiment]
        j = run.rows.index(trace.cart - 1)
        size = max(float(run.swing[j]), 1e-12)

        def error(model: np.ndarray, trace: Trace = trace, size: float = size) -> float:
            return float(np.sqrt(np.mean((trace.measured - model) ** 2))) / size

        out.append(
            RecordGap(
                experiment=trace.experiment,
                cart=trace.cart,
                held_out=trace.held_out,
                baseline=error(trace.baseline),
                final=error(trace.final),
                noise_floor=float(run.sigma[j]) / size,
            )
        )
    return tuple(out)


def _repeatability(runs: Sequence[Run]) -> float | None:
    """Return the relative difference of runs with the same input, or None without such."""
    squares, sizes = 0.0, 0.0
    for i, a in enumerate(runs):
        for b in runs[:i]:
            alike = a.free == b.free and a.t.size == b.t.size and np.any(a.command)
            if not alike or not np.array_equal(a.command, b.command):
                continue
            offset = (a.y - a.rest[list(a.rows)][:, None]) - (b.y - b.rest[list(b.rows)][:, None])
            squares += float((offset**2).sum()) / 2.0
            sizes += float((a.swing**2).sum()) * a.t.size
    return float(np.sqrt(squares / sizes)) if sizes else None
