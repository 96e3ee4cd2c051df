"""Fit a model to whole runs, from a start that is nearly right."""

from dataclasses import replace
from typing import Any

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import cut_shots
from pipeline.gap.fit.levenberg_marquardt import GapFit, fit_model
from pipeline.gap.fit.restart import restart_runs
from pipeline.gap.fit.structure import GapModel
from pipeline.gap.fit.uncertainty import covariance
from pipeline.gap.limits import AT_FLOOR
from pipeline.gap.search.hypothesis import Study

_LENGTHS = (0.3, 0.6, 1.2, 2.4)  # s; with a contact, pieces grow to whole runs
# Factors on the size and damping of a contact at the start of a fit. The contact in `gap.pem` is
# rigid, but the simulator's contact is slightly soft.
_VARIED = ((1.0, 1.0), (1.2, 1.0), (1.0, 0.65), (1.2, 0.65))
_NEAR = 8  # iterations of a fit that starts near its end
# Options without springs: the cost of a whole run has many minima, and small gains add up.
_FINISHED: dict[str, Any] = {"iterations": 60, "tolerance": 1e-6}


def fit_on(fit: GapFit, model: GapModel, study: Study) -> GapFit:
    """Fit a slightly changed model, starting from the nuisance parameters of the original fit."""
    if not any(study.springs):
        return fit_free_run(model, study)
    moved = replace(fit, structure=model.structure, theta=model.theta)
    return study.fit(moved, iterations=_NEAR, scatter_free=fit.scattered)


def fit_free_run(start: GapModel, study: Study) -> GapFit:
    """Fit whole runs; friction is first the same in all runs, then different from run to run."""
    structure = start.structure
    steps = {} if any(study.springs) else _FINISHED
    fit = study.fit(start, scatter_free=False, **steps)
    if fit.chi > AT_FLOOR and any(c.effect.has_play for c in structure.effects):
        fit = min(fit, _fit_contact_on_pieces(start, study), key=lambda one: one.cost)
    # Two rounds in which friction differs between runs. Before each, the worst runs are restarted.
    for attempt in range(2):
        if not structure.many_rests or fit.chi < AT_FLOOR:
            break
        # A restart of the worst runs makes sense only if the better ones are nearly right.
        if np.quantile(fit.run_chi, 0.25) < 6.0:
            fit = restart_runs(fit, study.training, study.mapper)
        elif attempt:
            break
        fit = study.fit(fit, iterations=12, learn_spread=True)
    return fit


def finish(fit: GapFit, study: Study) -> GapFit:
    """Return a fit with its covariance; its parameters come from whole runs."""
    if not study.whole:
        return covariance(fit, study.training, study.mapper)
    how = replace(study.fitting, scatter_free=False, **_FINISHED)
    return covariance(fit_model(fit.without_nuisance, study.whole, how), study.whole, study.mapper)


def _fit_contact_on_pieces(start: GapModel, study: Study) -> GapFit:
    """Fit a contact to pieces that grow to whole runs, from several sizes of the contact."""
    structure = start.structure
    spans = [structure.span(i) for i, c in enumerate(structure.effects) if c.effect.contact]

    def on_pieces(model: GapModel, length: float, iterations: int) -> GapFit:
        pieces = [cut_shots(run, length=length) for run in study.training]
        how = replace(study.fitting, iterations=iterations, scatter_free=False)
        return fit_model(model, pieces, how)

    fits = []
    for size, damping in _VARIED:
        theta: Array = start.theta.copy()
        theta[[span.start for span in spans]] += np.log(size)
        theta[[span.stop - 1 for span in spans]] += np.log(damping)
        fits.append(on_pieces(GapModel(structure=structure, theta=theta), _LENGTHS[0], 6))
    grown = []
    for fit in sorted(fits, key=lambda one: one.cost)[:2]:
        for length in _LENGTHS[1:]:
            fit = on_pieces(fit.without_nuisance, length, 8)
        grown.append(study.fit(fit.without_nuisance, iterations=15, scatter_free=False))
    return min(grown, key=lambda one: one.cost)
