"""Describe a search in numbers: effects and rivals with errors, traces, and where it fits badly."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.fit import GapFit
from pipeline.gap.judge import Hypothesis, Study
from pipeline.gap.parameters import fresh_nuisance, simulate_run
from pipeline.gap.runs import GapRun
from pipeline.gap.types import (
    Alternative,
    AlternativeModel,
    FoundEffect,
    FreeRun,
    GapWindow,
    NamedValue,
    RecordGap,
    Trace,
)
from pipeline.plant.catalogue import find_effect
from pipeline.setup import Units

# ------------------------------------------------------------ one simulation over a whole record


def free_runs(
    fit: GapFit, runs: Sequence[GapRun], zeros: Mapping[str, Array]
) -> tuple[FreeRun, ...]:
    """Return the error of each record, all carts together, ordered by record id.

    Of the values fitted to a record, only its encoder `zeros` (n,) are used. A record interrupted
    by a hand is simulated piece by piece, but counts as one.
    """
    squares: dict[str, list[Array]] = {}
    for run in runs:
        zero = np.where(run.free, zeros[run.id], 0.0)
        fresh = fresh_nuisance(replace(run, zero=zero))
        off = run.y - simulate_run(fit, run, fresh)
        squares.setdefault(run.id, []).append(off.ravel() ** 2)
    found = []
    for experiment, parts in sorted(squares.items()):
        size = float(np.sqrt(np.mean(np.concatenate(parts))))
        found.append(FreeRun(experiment=experiment, error=size if np.isfinite(size) else None))
    return tuple(found)


# ------------------------------------------------------------ where a run departs from the model


def find_windows(fit: GapFit, runs: Sequence[GapRun]) -> tuple[GapWindow, ...]:
    """Return the windows with most of the misfit, the worst first.

    The `share` of a window is relative to the squared misfit of its cart in its run.
    """
    found: list[tuple[float, GapWindow]] = []
    for run, nuisance in zip(runs, fit.nuisance, strict=True):
        model = simulate_run(fit, run, nuisance)
        for j, row in enumerate(run.rows):
            energy = ((run.y[j] - model[j]) / run.sigma[j]) ** 2
            total = float(energy.sum())
            width = max(4, int(0.15 * run.t.size))
            if total <= 0.0 or run.t.size <= width:
                continue
            inside = np.convolve(energy, np.ones(width), mode="valid")
            first = int(np.argmax(inside))
            window = GapWindow(
                experiment=run.id,
                cart=row + 1,
                start=float(run.t[first]),
                end=float(run.t[first + width - 1]),
                what=_what(run, model[j] - run.rest[row], energy),
                share=float(inside[first] / total),
            )
            found.append((float(inside[first]), window))
    found.sort(key=lambda pair: -pair[0])
    return tuple(window for _, window in found[:8])


def _what(run: GapRun, x: Array, energy: Array) -> str:
    """Return in words what the cart does where the misfit is larger than chance allows."""
    v = np.gradient(x, run.t)
    u = run.input
    edges = np.flatnonzero(np.abs(np.diff(u)) > 0.2 * max(1e-12, float(np.ptp(u))))
    since = np.full(run.t.size, np.inf)
    for edge in edges:
        late = run.t - run.t[edge]
        since = np.where((late >= 0) & (late < since), late, since)
    speed, reach = float(np.abs(v).max()), float(np.abs(x).max())
    masks = {
        "velocity near zero": np.abs(v) < 0.1 * speed,
        "fast motion": np.abs(v) > 0.6 * speed,
        "large displacement, positive side": x > 0.6 * reach,
        "large displacement, negative side": x < -0.6 * reach,
        "after an edge of the input": since < 0.3,
        "input on": np.abs(u) > 0.05 * max(1e-12, float(np.abs(u).max())),
        "input off": np.abs(u) <= 0.05 * max(1e-12, float(np.abs(u).max())),
    }
    if not np.any(u) or np.count_nonzero(np.diff(u)) > 0.3 * u.size:
        del masks["input on"], masks["input off"]
    if not edges.size or edges.size > 6:
        del masks["after an edge of the input"]
    total = float(energy.sum())
    best, score = "throughout", 1.3  # a third above chance is worth mentioning
    for what, mask in masks.items():
        if 0.02 < mask.mean() < 0.98:
            excess = float(energy[mask].sum()) / total / float(mask.mean())
            if excess > score:
                best, score = what, excess
    return best


# -------------------------------------------------------------------- effects, rivals and traces

_MOST_RIVALS = 4  # rivals to list
_SAME_LENGTH, _SAME_LEVEL = 0.9, 0.01  # by these shares of samples and of input, repeats agree


def list_effects(
    path: Sequence[Hypothesis], final: GapFit, found: Sequence[Hypothesis], units: Units
) -> tuple[FoundEffect, ...]:
    """Return the effects of the final fit, each with its step on the path and its rivals."""
    structure, chosen = final.structure, path[-1]
    same_size = {h.key: h for h in found if len(h.key) == len(chosen.key)} | {chosen.key: chosen}
    lowest = min(h.bic_of_all for h in same_size.values())
    weight = {key: float(np.exp(-0.5 * (h.bic_of_all - lowest))) for key, h in same_size.items()}
    total, std = sum(weight.values()), None
    if final.covariance is not None:
        variance = np.diag(final.covariance + final.between_runs)
        std = np.sqrt(variance) * structure.physical_derivative(final.theta)
    places = [candidate.key for candidate in structure.effects]
    out = []
    for before, after in pairwise(path):
        (added,) = after.key - before.key
        index = places.index(added)
        term, rest = final.terms[index], chosen.key - {added}
        # A rival has one other effect in place of this one, or shares no effect with the chosen
        # hypothesis.
        rivals = [
            h
            for key, h in same_size.items()
            if key != chosen.key and (rest < key or not key & chosen.key)
        ]
        # Each effect is listed once, with the best hypothesis in which it takes this one's place.
        by_name: dict[tuple[str, int], Hypothesis] = {}
        for h in sorted(rivals, key=lambda h: h.bic_of_all):
            by_name.setdefault(_stand_in(added, h.key - rest), h)
        known = None if std is None else std[structure.span(index)]
        values = {
            p.name: NamedValue(
                value=float(value),
                std=None if known is None else float(known[i]),
                unit=p.unit_text(position=units.position, input=units.input),
            )
            for i, (p, value) in enumerate(zip(term.effect.parameters, term.values, strict=True))
        }
        reported = {p.name for p in term.effect.parameters if p.reported}
        out.append(
            FoundEffect(
                effect=term.effect,
                where=term.where,
                parameters={k: v for k, v in values.items() if k in reported},
                details={k: v for k, v in values.items() if k not in reported},
                confidence=sum(w for key, w in weight.items() if added in key) / total,
                nrmse_before=before.error,
                nrmse_after=after.error,
                rivals=tuple(
                    _rival(key, h, weight[h.key] / total)
                    for key, h in list(by_name.items())[:_MOST_RIVALS]
                ),
            )
        )
    return tuple(out)


def _stand_in(effect: tuple[str, int], others: frozenset[tuple[str, int]]) -> tuple[str, int]:
    """Return the rival's effect at the same place, or else its first effect."""
    return min(others, key=lambda other: (other[1] != effect[1], other))


def list_suspects(
    found: Sequence[Hypothesis], effects: Sequence[FoundEffect]
) -> tuple[Alternative, ...]:
    """Return the effects that help most when used alone, the best first, except for `effects`."""
    baseline = next(h for h in found if not h.key)
    listed = {(f.effect.key, next(iter(f.where.values()), 0)) for f in effects}
    best: dict[frozenset[tuple[str, int]], Hypothesis] = {}  # of several fits of one effect
    for h in sorted(found, key=lambda h: h.bic):
        if len(h.key) == 1 and h.bic < baseline.bic and not h.key <= listed:
            best.setdefault(h.key, h)
    singles = [*best.values()]
    weights = [float(np.exp(-0.5 * (h.bic - singles[0].bic))) for h in singles]
    return tuple(
        _rival(next(iter(h.key)), h, weight / sum(weights))
        for h, weight in zip(singles[:_MOST_RIVALS], weights, strict=False)
    )


def _rival(key: tuple[str, int], hypothesis: Hypothesis, confidence: float) -> Alternative:
    effect = find_effect(key[0])
    where = effect.where(key[1])
    return Alternative(
        effect=effect, where=where, nrmse_after=hypothesis.error, confidence=confidence
    )


def chain_std(fit: GapFit) -> dict[str, float]:
    """Return the standard error of every mass, damping and spring by its name."""
    if fit.covariance is None:
        return {}
    structure, chain = fit.structure, fit.structure.chain(fit.theta)
    values = {f"{letter}_{i}": v for letter, row in (("m", chain.m), ("c", chain.c))
              for i, v in enumerate(row, start=1)}  # fmt: skip
    values |= {f"k_{j + 1}": chain.k[j] for j in structure.rows}
    # The vector holds logarithms, so its standard errors are relative.
    relative = np.sqrt(np.diag(fit.covariance))[: structure.base_size]
    return {name: float(v * r) for (name, v), r in zip(values.items(), relative, strict=True)}


def chain_covariance(fit: GapFit) -> Array | None:
    """Return the covariance of the parameters in `chain_std`."""
    if fit.covariance is None:
        return None
    size, std = fit.structure.base_size, np.array(list(chain_std(fit).values()))
    relative = fit.covariance[:size, :size]
    scale = std / np.sqrt(np.diag(relative))
    return relative * np.outer(scale, scale)


def make_traces(before: Hypothesis, after: Hypothesis, study: Study) -> tuple[Trace, ...]:
    """Return the measured and simulated motion of every cart in every run, for both models."""
    out, runs = [], (*study.training, *study.held_out)
    own = [(*one.fit.nuisance, *one.held.nuisance) for one in (before, after)]
    for index, (run, own_before, own_after) in enumerate(zip(runs, *own, strict=True)):
        linear = simulate_run(before.fit, run, own_before)
        final = simulate_run(after.fit, run, own_after)
        u = run.record.input[-run.t.size :]
        out += [
            Trace(
                experiment=run.id,
                cart=row + 1,
                held_out=index >= len(study.training),
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


def compare_by_record(traces: Sequence[Trace], study: Study) -> tuple[RecordGap, ...]:
    """Return the relative error of every cart in every record, without and with effects.

    The held-out part of a record is listed separately. Runs of the same record, between
    interventions, are pooled.
    """
    order = (*study.training, *study.held_out)
    rows = [(run, j) for run in order for j in range(len(run.rows))]
    pooled: dict[tuple[str, int, bool], list[Array]] = {}
    for trace, (run, j) in zip(traces, rows, strict=True):
        squares = [
            np.sum((trace.measured - trace.baseline) ** 2),
            np.sum((trace.measured - trace.final) ** 2),
            trace.t.size * run.sigma[j] ** 2,
            trace.t.size * max(float(run.swing[j]), 1e-12) ** 2,
        ]
        of = trace.experiment, trace.cart, trace.held_out
        pooled.setdefault(of, []).append(np.array(squares))
    out = []
    for (experiment, cart, held_out), parts in pooled.items():
        *errors, size = np.sum(parts, axis=0)
        baseline, final, noise = np.sqrt(np.array(errors) / size).tolist()
        out.append(
            RecordGap(
                experiment=experiment,
                cart=cart,
                held_out=held_out,
                baseline=baseline,
                final=final,
                noise_floor=noise,
            )
        )
    return tuple(out)


def repeatability(runs: Sequence[GapRun]) -> float | None:
    """Return the relative difference of runs with the same input, or None without repeats.

    The second of two runs is interpolated at the times of the first, after the first edges of their
    inputs are aligned. Two pieces of one record are not repeats, because the later piece begins in
    motion.
    """
    squares, sizes = 0.0, 0.0
    for i, a in enumerate(runs):
        for b in runs[:i]:
            if a.id == b.id or a.free != b.free or a.rows != b.rows or not a.driven:
                continue
            t = a.t - _edge(a) + _edge(b)
            inside = (t >= b.t[0]) & (t <= b.t[-1])
            if not _same_input(a, b, a.t[inside], t[inside]):
                continue
            other = np.array([np.interp(t[inside], b.t, y) for y in b.y])
            difference, motion = a.y[:, inside] - other, np.gradient(other, a.t[inside], axis=1)
            # Encoders are zeroed before every run, so a constant difference does not count. Neither
            # does a delay of up to a sample, because an edge may be logged one sample late.
            difference = difference - difference.mean(axis=1, keepdims=True)
            most = a.record.sample_time
            late = float((difference * motion).sum() / max((motion**2).sum(), 1e-300))
            difference -= np.clip(late, -most, most) * motion
            squares += float((difference**2).sum()) / 2.0
            sizes += float((a.swing**2).sum()) * np.count_nonzero(inside)
    return float(np.sqrt(squares / sizes)) if sizes else None


def _edge(run: GapRun) -> float:
    """Return the time at which the input first changes, or the run's start."""
    return float(run.knots[int(np.argmax(run.command != run.command[0]))])


def _same_input(a: GapRun, b: GapRun, t_a: Array, t_b: Array) -> bool:
    """Return whether two inputs agree over most of the runs, except for samples at their edges."""
    if t_a.size < _SAME_LENGTH * max(a.t.size, b.t.size):
        return False
    u, v = (
        run.command[np.searchsorted(run.knots, t, side="right") - 1]
        for run, t in ((a, t_a), (b, t_b))
    )
    # 2 % of the samples may differ, because an edge may be one sample off.
    return bool(np.mean(np.abs(u - v) > _SAME_LEVEL * np.abs(u).max()) < 0.02)


def list_contenders(
    chosen: Hypothesis, others: Sequence[Hypothesis]
) -> tuple[AlternativeModel, ...]:
    """Return the models that may be true: the chosen one, then the likeliest others.

    A model with only some of the chosen effects is not an alternative. Nor is one with additional
    effects, if the chosen model leaves only noise.
    """
    rivals = [one for one in others if one.key and not one.key <= chosen.key]
    if chosen.at_floor:
        rivals = [one for one in rivals if not one.key > chosen.key]
    # At most three models, so that an experiment can distinguish them.
    kept = [chosen, *sorted(rivals, key=lambda one: one.bic)[:2]]
    likely = np.exp(-0.5 * np.array([one.bic - min(k.bic for k in kept) for one in kept]))
    return tuple(
        AlternativeModel(chain=model.chain, terms=model.terms, weight=float(weight))
        for one, weight in zip(kept, likely / likely.sum(), strict=True)
        for model in [one.fit.structure.model(one.fit.theta)]
    )
