"""Search the catalogue for the effects of a bench.

Effects are not tried one by one. All laws at all places are fitted together, from zero, to a model
that follows the measurement. Needless laws are then dropped (`gap.fit`), and the remaining ones
are fitted to whole runs. Each effect must lower the error on runs that the fit has not seen. Rivals
come from the same fit with one law exchanged.
"""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from pipeline.gap.fit.baseline import first_chain
from pipeline.gap.fit.structure import GapModel
from pipeline.gap.pem.choose import choose_laws, rivals_of
from pipeline.gap.pem.fit import PemFit, Records
from pipeline.gap.pem.run import make_track
from pipeline.gap.search.deadline import OutOfTime
from pipeline.gap.search.free_run_fit import fit_free_run
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, worth_it
from pipeline.gap.search.prune import prune
from pipeline.gap.search.translate import as_model, filled


def find_hypotheses(baseline: Hypothesis, study: Study) -> tuple[Hypothesis, list[Hypothesis]]:
    """Return the chosen hypothesis and all that were judged, the baseline first.

    If the time limit is reached, the result is the best so far.
    """
    found = [baseline]
    with suppress(OutOfTime):
        records = Records(
            runs=tuple(make_track(run) for run in study.training),
            mapper=study.mapper,
            columns=frozenset().union(*(filled(effect) for effect in study.catalogue)),
        )
        chain = baseline.fit.structure.chain(baseline.fit.theta)
        own = first_chain(study.training, springs=study.springs)
        lean = choose_laws(
            records, springs=study.springs, chains=[chain, own], progress=study.progress
        )
        if not lean.laws.groups():
            return baseline, found
        found.append(judge(fit_free_run(_as_model(lean, study, records), study), study))
        study.progress(f"{found[-1].size} laws remain: error {found[-1].error:.1%}")
        _judge_rivals(rivals_of(lean, records), found, study, records)
        found[1:] = [h for h in found[1:] if np.isfinite(h.error)]
        # An effect with a parameter at its bound is often not real, so it is removed.
        chosen = prune(min(found, key=lambda h: h.bic_of_all), study, found)
        sound = [h for h in found if h.is_credible and np.isfinite(h.error)]
        if not chosen.is_credible:
            chosen = prune(min(sound, key=lambda h: h.bic_of_all), study, found)
        usable = chosen.is_credible and np.isfinite(chosen.error)
        return chosen if usable else baseline, [h for h in found if h.is_credible]
    found = [h for h in found if np.isfinite(h.error) and h.is_credible]
    worth = [h for h in found if worth_it(h, baseline, study)]
    return min(worth, key=lambda h: h.bic, default=baseline), found


def _judge_rivals(
    rivals: Sequence[PemFit], found: list[Hypothesis], study: Study, records: Records
) -> None:
    """Append the rivals, fitted to whole runs; those that are finished if the time is up."""
    judged: dict[int, Hypothesis] = {}

    def fit(at: int, rival: PemFit) -> None:
        judged[at] = judge(fit_free_run(_as_model(rival, study, records), study), study)

    try:
        list(study.mapper(fit, range(len(rivals)), rivals))
    finally:
        found += [judged[at] for at in sorted(judged)]


def _as_model(fit: PemFit, study: Study, records: Records) -> GapModel:
    """Return a model that follows the record as a model with effects of the catalogue."""
    if not any(study.springs):
        # Without springs, errors add up, and a missing effect would mislead a fit that starts with
        # a free simulation. So the gain is lowered step by step.
        for gain in (0.02, 0.01, 0.005, 0.002, 0.0):
            fit = records.fit(fit, gain=gain) if gain < fit.gain else fit
    return as_model(fit, springs=study.springs, catalogue=study.catalogue, runs=study.training)
