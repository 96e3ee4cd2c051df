"""Choose the laws of force that the records need.

First fit all laws that can grow from zero, then add laws that need a shape (such as the position of
an end stop), then drop needless ones.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from pipeline.arrays import Array
from pipeline.gap import limits
from pipeline.gap.pem.drop import criterion, drop_needless, is_better, is_rough
from pipeline.gap.pem.fit import PemFit, Records
from pipeline.gap.pem.laws import LawSet, PemSetup, TrialLaw, smooth_laws
from pipeline.gap.pem.score import backlash_laws, score, shaped_trials
from pipeline.plant.catalogue import CATALOGUE
from pipeline.plant.chain import Chain
from pipeline.plant.simulator.terms import EffectKind
from pipeline.words.progress import Progress, silent

CLOSE, LOOSE, FREE = 0.5, 0.1, 0.0  # gains: share of the error that corrects the model
_FIRST = 25  # iterations of the first fit, which may start far from the solution
_FEW = 6  # iterations of a fit that only shows whether a rival comes near
_SHORT_LIST = 4  # number of laws with a shape for which the model is refitted


def start_all(records: Records, *, springs: Sequence[bool], chains: Sequence[Chain]) -> PemFit:
    """Return the model with all laws that need no shape, fitted from zero.

    The fit is done from each of the `chains`; the best result is returned.
    """
    tracks = records.runs
    largest = max(float(np.abs(track.command).max()) for track in tracks)
    free = tuple(tuple(track.free.tolist()) for track in tracks)
    pinned = int(np.argmax(np.any(free, axis=0))) if largest == 0.0 else None

    def fitted(chain: Chain) -> PemFit:
        bench = PemSetup(
            chain=chain, springs=tuple(springs), largest=largest, free=free, pinned=pinned
        )
        laws = smooth_laws(bench, columns=records.columns)
        start = records.begin(laws, laws.start(chain), gain=CLOSE)
        return records.fit(start, iterations=_FIRST)

    fits = list(records.mapper(fitted, chains))
    return records.fit(min(fits, key=lambda follow: follow.total), gain=LOOSE)


def choose_laws(
    records: Records,
    *,
    springs: Sequence[bool],
    chains: Sequence[Chain],
    progress: Progress = silent,
) -> PemFit:
    """Return the model with only the needed laws, fitted to free simulations if possible."""
    full = start_all(records, springs=springs, chains=chains)
    lean = reduce_gain(full, records)
    progress(f"all laws fitted together: {len(lean.laws.groups())} remain")
    # Add at most six laws with a shape; a real bench has several.
    for _ in range(6):
        if lean.gain == FREE and lean.chi < limits.AT_FLOOR:
            break
        more = add_shaped(full, records)
        if more is None:
            break
        leaner = reduce_gain(more, records)
        added = CATALOGUE[more.laws.keys[-1][0]].title.lower()
        progress(f"with {added}: {len(leaner.laws.groups())} laws remain")
        full = more
        if leaner.gain < lean.gain or is_better(leaner, lean):
            lean = leaner
    return lean


def add_shaped(fit: PemFit, records: Records) -> PemFit | None:
    """Return the model with one more law that has a shape, or None if no such law helps."""
    best: PemFit | None = None
    trials = [one.law for one in shaped_trials(fit, records)[:_SHORT_LIST]]
    for law in (*trials, *backlash_laws(fit, records)):
        laws, p = fit.laws.with_laws(fit.p, [law])
        trial = records.refit(fit, laws, p, iterations=8)
        if best is None or criterion(trial, fit.n_independent) < criterion(best, fit.n_independent):
            best = trial
    if best is None or not is_better(best, fit):
        return None
    # The law of a contact is only approximate, and a further law could absorb its error. So the
    # further law must remove at least half of the excess.
    if is_rough(fit) and best.total > _half_way(fit):
        return None
    return best


def _half_way(fit: PemFit) -> float:
    """Return the cost at which half of the excess over the noise remains."""
    return fit.points + limits.CONTACT_GAIN * max(fit.total - fit.points, 0.0)


def reduce_gain(full: PemFit, records: Records) -> PemFit:
    """Drop needless laws, then lower the gain to zero, dropping again at each step.

    If the error grows with a lower gain, an effect is missing. The error of a missing effect swings
    with the carts, and would be mistaken for laws that do not exist.
    """
    lean = _one_friction(drop_needless(full, records), records)
    for gain in (0.02, FREE):
        loose = records.fit(lean, gain=gain)
        # An effect is missing if the error grows by half.
        if not loose.chi < 1.5 * max(lean.chi, limits.AT_FLOOR):
            break
        lean = drop_needless(loose, records)
    return _look_again(lean, records) if lean.gain == FREE else lean


def _look_again(lean: PemFit, records: Records) -> PemFit:
    """Fit all laws once more to free simulations, which show small errors; drop needless laws."""
    everything = smooth_laws(lean.laws.bench, columns=records.columns)
    missing = [key for key in everything.keys if key not in lean.laws.keys]
    extra = [TrialLaw(kind=kind, place=place, values=(0.0,)) for kind, place in missing]
    laws, p = replace(lean.laws, drive=everything.drive).with_laws(lean.p, extra)
    again = records.refit(lean, laws, p, iterations=_FEW)
    again = _one_friction(drop_needless(again, records), records)
    return again if is_better(again, lean) else lean


def _one_friction(fit: PemFit, records: Records) -> PemFit:
    """Keep only one kind of dry friction on each cart, because two kinds exclude each other."""
    for place in range(fit.laws.bench.n):
        here = [i for i, key in enumerate(fit.laws.keys) if key[1] == place]
        sides = [
            [i for i in here if fit.laws.keys[i][0] in kinds]
            for kinds in (
                (EffectKind.COULOMB_FRICTION, EffectKind.STICTION),
                (EffectKind.PRESLIDING_FRICTION,),
            )
        ]
        if all(sides):
            trials = [records.refit(fit, *fit.laws.without(fit.p, groups)) for groups in sides]
            fit = min(trials, key=lambda one: one.total)
    return fit


def rivals_of(lean: PemFit, records: Records) -> list[PemFit]:
    """Return refitted models in which one law is replaced by another, the best first."""
    everything = smooth_laws(lean.laws.bench, columns=records.columns)
    out: list[PemFit] = []
    for group in lean.laws.groups():
        laws, p = lean.laws.without(lean.p, [group])
        bare = records.refit(lean, laws, p, gain=LOOSE, iterations=_FEW)
        gone = lean.laws.keys[group] if group >= 0 else None
        taken = {gone, *laws.keys}
        plain = [TrialLaw(kind=kind, place=place, values=(0.0,)) for kind, place in everything.keys]
        trials = [*score(bare, records, plain), *shaped_trials(bare, records)]
        trials = sorted(
            (one for one in trials if one.law.key not in taken), key=lambda one: -one.drop
        )
        exchanged = [laws.with_laws(bare.p, [one.law]) for one in trials[:_SHORT_LIST]]
        for q, free in enumerate(everything.drive):
            if free and not laws.drive[q] and group != -1 - q:
                drive = tuple(f or i == q for i, f in enumerate(laws.drive))
                exchanged.append((replace(laws, drive=drive), bare.p))

        def fitted(model: tuple[LawSet, Array], bare: PemFit = bare) -> PemFit:
            return _one_friction(records.refit(bare, *model, iterations=_FEW), records)

        out += records.mapper(fitted, exchanged)
    near = sorted((one for one in out if np.isfinite(one.cost)), key=lambda one: one.total)
    return list(records.mapper(partial(records.fit, gain=lean.gain), near[:_SHORT_LIST]))
