"""Search the catalogue: keep a few hypotheses, grow them, choose, prune."""

from collections.abc import Mapping, Sequence
from contextlib import suppress

import numpy as np

from pipeline.gap.fit.structure import Candidate
from pipeline.gap.search.deadline import OutOfTime
from pipeline.gap.search.grow import fit_whole, grow
from pipeline.gap.search.hypothesis import BIC_DROP, Bench, Hypothesis, judge, worth_it

_BEAM = (2,)  # hypotheses kept after the first step; then one
_DEPTH = 6  # effects
_HOPELESS = 5.0  # a hypothesis with this many times the best one's chi-square is not grown
_STEP = 0.81  # of the chi-square: a tenth of the error, which a further effect must take
_CONTACT_STEP = 0.3  # a contact that is there takes more, and without it others can be searched …
_CONTACT_LAW = 10.0  # … chi-square that a contact of another law leaves: nothing to explain


def search(baseline: Hypothesis, bench: Bench, *, depth: int = _DEPTH) -> list[Hypothesis]:
    """Return every hypothesis judged, the baseline first; past the time, those so far."""
    seen: dict[frozenset[tuple[str, int]], Hypothesis] = {baseline.key: baseline}
    with suppress(OutOfTime):
        _grow_beam(baseline, bench, seen, depth=depth)
    return list(seen.values())


def _grow_beam(
    baseline: Hypothesis,
    bench: Bench,
    seen: dict[frozenset[tuple[str, int]], Hypothesis],
    *,
    depth: int,
) -> None:
    """Fill `seen`, the best hypothesis of each set of effects."""
    beam = [baseline]
    for level in range(depth):
        children: list[Hypothesis] = []
        for parent in beam:
            for child in grow(parent, bench):
                if not (child.sound and np.isfinite(child.error)):
                    continue
                if child.key not in seen or child.bic < seen[child.key].bic:
                    seen[child.key] = child
                    if child.bic < parent.bic - BIC_DROP:
                        children.append(child)
            if any(child.at_floor for child in children):
                break
        if not children:
            break
        unique = {child.key: child for child in sorted(children, key=lambda h: -h.bic)}
        worthy = [child for child in unique.values() if not _needlessly_rich(child, unique)]
        worthy.sort(key=lambda h: h.bic)
        count = len(worthy[0].key)
        bench.tell(f"{count} effect{'s' * (count > 1)}: " + _names(worthy[0]))
        if worthy[0].at_floor:
            break
        before = min(h.fit.chi for h in beam)
        within = _HOPELESS * worthy[0].fit.chi
        beam = []
        for child in worthy:
            # What grows from a part grows from the whole that explains more too.
            if child.fit.chi <= within and not any(child.key < h.key for h in beam):
                beam += [child] if _leads_on(child, before) else []
        beam = beam[: _BEAM[level] if level < len(_BEAM) else 1]
        if not beam or max(h.size for h in beam) >= depth:
            break


def _leads_on(child: Hypothesis, before: float) -> bool:
    """May a further effect still make this one the best? `before` is the chi-square without."""
    if any(c.effect.contact for c in child.added):
        return _CONTACT_LAW < child.fit.chi < _CONTACT_STEP * before
    if child.has_contact and child.fit.chi < _CONTACT_LAW:
        return False
    # One of two effects may do little by itself.
    return child.size == 1 or child.fit.chi < _STEP * before


def _needlessly_rich(
    child: Hypothesis, others: Mapping[frozenset[tuple[str, int]], Hypothesis]
) -> bool:
    """Does a simpler law in the places of the effects added last explain no less?"""
    grown = {c.key: c.effect.grows_from for c in child.added if c.effect.grows_from}
    simple = {(key, place) for (_, place), key in grown.items()}
    simpler = others.get(child.key - frozenset(grown) | simple)
    return bool(grown) and simpler is not None and simpler.bic < child.bic


def _names(hypothesis: Hypothesis) -> str:
    return " + ".join(c.label for c in hypothesis.fit.structure.effects)


def choose(found: Sequence[Hypothesis], baseline: Hypothesis, bench: Bench) -> Hypothesis:
    """Return the best hypothesis whose every effect is worth it, the smaller where in doubt."""
    best = baseline
    for size in range(1, _DEPTH + 1):
        level = [h for h in found if h.size == size]
        level = [h for h in level if worth_it(h, best, bench)]
        if level:
            best = min(level, key=lambda h: h.bic)
    return best


def prune(chosen: Hypothesis, bench: Bench) -> Hypothesis:
    """Drop effects the others have made needless, as far as the time allows."""
    with suppress(OutOfTime):
        while len(chosen.key) > 1:
            trials = [_without(chosen, c, bench) for c in chosen.fit.structure.effects]
            as_good = [h for h in trials if h.sound and not worth_it(chosen, h, bench)]
            if not as_good:
                break
            chosen = min(as_good, key=lambda h: h.bic)
    return chosen


def _without(hypothesis: Hypothesis, effect: Candidate, bench: Bench) -> Hypothesis:
    structure = hypothesis.fit.structure
    index = structure.effects.index(effect)
    theta = np.delete(hypothesis.fit.theta, np.r_[structure.span(index)])
    fit = fit_whole(structure.without(index), theta, bench)
    return judge(fit, bench, added=fit.structure.effects[-1:])


def steps_to(
    chosen: Hypothesis, found: Sequence[Hypothesis], bench: Bench
) -> tuple[Hypothesis, ...]:
    """Return the linear model, one effect, … chosen: what helps most by itself comes first."""
    steps = [chosen]
    while effects := steps[0].fit.structure.effects:
        key = steps[0].key
        smaller = [h for h in found if h.key < key and len(h.key) == len(key) - 1]
        smaller = smaller or [_without(steps[0], effects[-1], bench)]
        steps.insert(0, min(smaller, key=lambda h: h.error))
    return tuple(steps)
