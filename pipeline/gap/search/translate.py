"""Translate the laws that `gap.fit` found into effects of the catalogue, with values."""

from collections.abc import Iterable, Mapping, Sequence
from enum import IntEnum

import numpy as np

from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.structure import Candidate, GapModel, Structure, bench_scales
from pipeline.gap.pem.fit import PemFit
from pipeline.gap.pem.laws import Column, column_set
from pipeline.plant.chain import Chain
from pipeline.plant.effect import Effect
from pipeline.plant.simulator.tables import Cart, Drive, Spring

_TABLE = {"cart": Cart, "spring": Spring, "input": Drive}


def filled(effect: Effect) -> frozenset[Column]:
    """Return the columns that an effect fills."""
    return column_set(effect.columns(dict.fromkeys(effect.names, 1.0)))


def values_of(effect: Effect, columns: Mapping[IntEnum, float]) -> tuple[float, ...]:
    """Return the parameter values for given columns: the inverse of `effect.columns`.

    The columns are linear in the parameters. So the inverse follows from the columns at one point,
    and at one unit from it in each parameter.
    """
    order = list(effect.columns(dict.fromkeys(effect.names, 1.0)))
    base = np.arange(1.0, 1.0 + len(effect.names))
    points = [base, *(base + unit for unit in np.eye(base.size))]
    at = [effect.columns(effect.named(point.tolist())) for point in points]
    table = np.array([[one[column] for column in order] for one in at])
    J = (table[1:] - table[0]).T
    wanted = np.array([columns[column] for column in order])
    return tuple(float(v) for v in base + np.linalg.solve(J, wanted - table[0]))


def as_model(
    fit: PemFit, *, springs: Sequence[bool], catalogue: Iterable[Effect], runs: Sequence[GapRun]
) -> GapModel:
    """Return the model whose effects express the found laws; richer effects are tried first."""
    by_size = sorted(catalogue, key=lambda effect: -len(filled(effect)))
    chain = fit.laws.chain(fit.p)
    candidates: list[Candidate] = []
    values: list[tuple[float, ...]] = []
    for (table, row), columns in fit.laws.columns(fit.p).items():
        left = dict(columns)
        for effect in by_size:
            mine = filled(effect)
            if _TABLE[effect.place] is table and mine <= column_set(left):
                place = 0 if table is Drive else row + 1
                value = values_of(effect, left)
                candidates.append(make_candidate(effect, place, value, runs=runs, chain=chain))
                values.append(value)
                left = {c: v for c, v in left.items() if (type(c), int(c)) not in mine}
    structure = Structure(springs=tuple(springs), effects=tuple(candidates))
    return structure.start(chain, values)


def make_candidate(
    effect: Effect, place: int, values: Sequence[float], *, runs: Sequence[GapRun], chain: Chain
) -> Candidate:
    """Return an effect at a place, with the signs of its values and its typical sizes there."""
    scales = bench_scales(runs, chain, effect=effect, place=place)
    return Candidate(
        effect=effect,
        place=place,
        signs=tuple(-1.0 if value < 0.0 else 1.0 for value in values),
        scales=tuple(p.size(scales) for p in effect.parameters),
    )
