"""Fit a model to whole runs, from a start that is nearly right."""

from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import cut_shots
from pipeline.gap.fit.levenberg_marquardt import Fit, fit_model
from pipeline.gap.fit.restart import restart_runs
from pipeline.gap.fit.structure import Model
from pipeline.gap.fit.uncertainty import covariance
from pipeline.gap.limits import AT_FLOOR
from pipeline.gap.search.hypothesis import Study

_FRICTION_ROUNDS = 2  # of run-by-run friction, the worst runs started anew before each
_NEARLY_RIGHT = 6.0  # chi-square of the better runs, below which the bad ones are worth a new start
_LENGTHS = (0.3, 0.6, 1.2, 2.4)  # s of a piece: behind a contact the misfit of whole runs is rugged
# Times a contact's size and its damping: what follows is rigid, a bench is not quite.
_VARIED = ((1.0, 1.0), (1.2, 1.0), (1.0, 0.65), (1.2, 0.65))
_KEPT = 2  # of them
_NEAR = 8  # iterations of a fit that begins near its end
# On no spring the misfit of a whole run is rugged throughout: small gains add up.
_FINISHED: dict[str, Any] = {"iterations": 60, "tolerance": 1e-6}


def fit_on(fit: Fit, model: Model, study: Study) -> Fit:
    """Fit a model a little different from a fitted one: from where that left every run."""
    if not any(study.springs):
        return fit_whole(model, study)
    return fit_model(
        model,
        study.training,
        nuisance=fit.nuisance,
        spread=fit.spread,
        scatter_free=any(np.any(nuisance.scatter != 1.0) for nuisance in fit.nuisance),
        mapper=study.mapper,
        iterations=_NEAR,
    )


def fit_whole(start: Model, study: Study) -> Fit:
    """Fit whole runs; friction first with one size for all runs, then run by run."""
    whole, structure = study.training, start.structure
    steps = {} if any(study.springs) else _FINISHED
    fit = fit_model(start, whole, scatter_free=False, mapper=study.mapper, **steps)
    if fit.chi > AT_FLOOR and any(c.effect.has_play for c in structure.effects):
        fit = min(fit, _grown_contact(start, study), key=lambda one: one.cost)
    for attempt in range(_FRICTION_ROUNDS):
        if not structure.many_rests or fit.chi < AT_FLOOR:
            break
        if np.quantile(fit.run_chi, 0.25) < _NEARLY_RIGHT:
            fit = restart_runs(fit, whole, mapper=study.mapper)
        elif attempt:
            break
        fit = fit_model(
            fit,
            whole,
            nuisance=fit.nuisance,
            spread=fit.spread,
            iterations=12,
            learn_spread=True,
            mapper=study.mapper,
        )
    return fit


def finish(fit: Fit, study: Study) -> Fit:
    """Return a fit with its covariance, its numbers from whole runs to their end."""
    if not study.whole:
        return covariance(fit, study.training, mapper=study.mapper)
    fit = fit_model(fit, study.whole, scatter_free=False, mapper=study.mapper, **_FINISHED)
    return covariance(fit, study.whole, mapper=study.mapper)


def _grown_contact(start: Model, study: Study) -> Fit:
    """Fit a contact to pieces that grow into whole runs, from several sizes of it."""
    structure = start.structure
    spans = [structure.span(i) for i, c in enumerate(structure.effects) if c.effect.contact]

    def on_pieces(model: Model, length: float, iterations: int) -> Fit:
        pieces = [cut_shots(run, length=length) for run in study.training]
        return fit_model(
            model, pieces, iterations=iterations, scatter_free=False, mapper=study.mapper
        )

    fits = []
    for size, damping in _VARIED:
        theta: Array = start.theta.copy()
        theta[[span.start for span in spans]] += np.log(size)
        theta[[span.stop - 1 for span in spans]] += np.log(damping)
        fits.append(on_pieces(Model(structure=structure, theta=theta), _LENGTHS[0], 6))
    grown = []
    for fit in sorted(fits, key=lambda one: one.cost)[:_KEPT]:
        for length in _LENGTHS[1:]:
            fit = on_pieces(fit, length, 8)
        grown.append(
            fit_model(fit, study.training, iterations=15, scatter_free=False, mapper=study.mapper)
        )
    return min(grown, key=lambda one: one.cost)
