"""Search the catalogue: grow the most promising hypothesis, choose, prune."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress

import numpy as np

from pipeline.gap.fit.structure import Candidate
from pipeline.gap.limits import BIC_DROP, CONTACT_LAW
from pipeline.gap.search.deadline import OutOfTime
from pipeline.gap.search.grow import fit_whole, grow
from pipeline.gap.search.hypothesis import Hypothesis, Study, judge, lowers_error, worth_it
from pipeline.plant.nonlinear.effects import find_effect

_PATIENCE = 2  # hypotheses grown in a row from which none comes with a lower held-out error
_DEPTH = 6  # effects
_HOPELESS = 5.0  # a hypothesis with this many times the best one's chi-square is not grown
_STEP = 0.81  # of the chi-square: a tenth of the error, which a further effect must take
_CONTACT_STEP = 0.3  # a contact that is there takes more, and without it others can be searched
_AS_GOOD = 1.5  # times the chi-square of one, which another may leave and be as likely


def search(baseline: Hypothesis, study: Study, *, depth: int = _DEPTH) -> list[Hypothesis]:
    """Return every hypothesis judged, the baseline first; past the time, those so far."""
    seen: dict[frozenset[tuple[str, int]], Hypothesis] = {baseline.key: baseline}
    with suppress(OutOfTime):
        _grow_the_best(baseline, study, seen, depth=depth)
    return list(seen.values())


def _grow_the_best(
    baseline: Hypothesis,
    study: Study,
    seen: dict[frozenset[tuple[str, int]], Hypothesis],
    *,
    depth: int,
) -> None:
    """Fill `seen`, the best hypothesis of each set of effects.

    Who leads is grown first. Where nothing that grows from it pays, it was the wrong way, and the
    best of those that wait has its turn.
    """
    waiting, best, idle = [baseline], baseline, 0
    done: set[frozenset[tuple[str, int]]] = set()
    while waiting and idle < _PATIENCE:
        parent, *waiting = waiting
        done.add(parent.key)
        children: list[Hypothesis] = []
        for child in grow(parent, study):
            if not (child.sound and np.isfinite(child.error)):
                continue
            if child.key not in seen or child.bic < seen[child.key].bic:
                seen[child.key] = child
                if child.bic < parent.bic - BIC_DROP:
                    children.append(child)
        leader = min(children, key=lambda h: h.bic, default=None)
        if leader is not None:
            for other in _exchanged(leader, seen, study):
                if not (other.sound and np.isfinite(other.error)):
                    continue
                if other.key not in seen or other.bic < seen[other.key].bic:
                    seen[other.key] = other
                    if other.bic < leader.bic:
                        children.append(other)
        # Who is at the floor is grown once more, for what the criterion alone can tell.
        if parent.at_floor or any(child.at_floor and child.fit.chi < 1.0 for child in children):
            break
        if children:
            leader = min(children, key=lambda h: h.bic)
            study.tell(f"{len(leader.key)} effect{'s' * (len(leader.key) > 1)}: {_names(leader)}")
        # One of two effects may do little by itself.
        pays = parent is baseline or any(lowers_error(child, best, study) for child in children)
        idle = 0 if pays else idle + 1
        best = min([best, *children], key=lambda h: h.error)
        waiting += [
            child
            for child in children
            if child is seen[child.key]
            and child.key not in done
            and child.size < depth
            and not _needlessly_rich(child, seen)
            and _leads_on(child, parent.fit.chi)
        ]
        waiting = by_promise(waiting, seen, study)


def _exchanged(
    leader: Hypothesis, seen: Mapping[frozenset[tuple[str, int]], Hypothesis], study: Study
) -> Iterator[Hypothesis]:
    """Yield the leader with an earlier effect exchanged for one that did about as well alone.

    A delay and a lag, say, look alike until what acts beside them is known: which of them came
    first is chance, and something else would have to make up for the wrong one.

    Reference: M. A. Efroymson, in Mathematical Methods for Digital Computers, 1960 (exchange in a
    stepwise selection).
    """
    effects = leader.fit.structure.effects
    for index, old in enumerate(effects):
        alone = seen.get(frozenset({old.key}))
        if leader.added == (old,) or alone is None or old.effect.contact:
            continue
        for other in list(seen.values()):
            key = leader.key - {old.key} | other.key
            if len(other.key) != 1 or other.fit.chi > _AS_GOOD * alone.fit.chi:
                continue
            # A contact's fit ends in one of many valleys: one that leaves much in a poor one.
            if key in seen and seen[key].fit.chi < _AS_GOOD * leader.fit.chi:
                continue
            (new,), (term,) = other.fit.structure.effects, other.fit.terms
            start = leader.fit.without(index).with_effect(new, term.values)
            if len(key) == len(leader.key):
                yield judge(fit_whole(start, study), study, added=(new,))


def by_promise(
    waiting: Sequence[Hypothesis],
    seen: Mapping[frozenset[tuple[str, int]], Hypothesis],
    study: Study,
) -> list[Hypothesis]:
    """Return who is worth growing, the best first: of one family of laws at its places only one.

    A whole that explains no more than its part, on runs it has not seen, leads astray.
    """
    leading: dict[frozenset[tuple[str, int]], Hypothesis] = {}
    for h in sorted(waiting, key=lambda h: h.bic):
        parts = (part for part in seen.values() if part.key and part.key < h.key)
        if all(lowers_error(h, part, study) for part in parts):
            effects = h.fit.structure.effects
            leading.setdefault(
                frozenset((c.effect.family or c.key[0], c.place) for c in effects), h
            )
    within = _HOPELESS * min(h.fit.chi for h in seen.values())
    return [h for h in leading.values() if h.fit.chi <= within]


def _leads_on(child: Hypothesis, before: float) -> bool:
    """May a further effect still make this one the best? `before` is the chi-square without."""
    if any(c.effect.contact for c in child.added):
        return child.fit.chi < _CONTACT_STEP * before
    if child.has_contact and child.fit.chi < CONTACT_LAW:
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


def choose(found: Sequence[Hypothesis], baseline: Hypothesis, study: Study) -> Hypothesis:
    """Return the best hypothesis whose every effect is worth it, the smaller where in doubt."""
    best = baseline
    for size in range(1, _DEPTH + 1):
        level = [h for h in found if h.size == size]
        level = [h for h in level if worth_it(h, best, study)]
        if level:
            best = min(level, key=lambda h: h.bic)
    return best


def prune(chosen: Hypothesis, study: Study) -> Hypothesis:
    """Drop effects, and richer laws, the others have made needless, as far as the time allows."""
    with suppress(OutOfTime):
        while len(chosen.key) > 1:
            effects = chosen.fit.structure.effects
            trials = [_without(chosen, c, study) for c in effects]
            as_good = [h for h in trials if h.sound and not worth_it(chosen, h, study)]
            plainer = [_plainer(chosen, c, study) for c in effects if c.effect.grows_from]
            as_good += [h for h in plainer if h.sound and h.bic < chosen.bic]
            if not as_good:
                break
            chosen = min(as_good, key=lambda h: h.bic)
    return chosen


def _without(hypothesis: Hypothesis, effect: Candidate, study: Study) -> Hypothesis:
    index = hypothesis.fit.structure.effects.index(effect)
    fit = fit_whole(hypothesis.fit.without(index), study)
    return judge(fit, study, added=fit.structure.effects[-1:])


def _plainer(hypothesis: Hypothesis, rich: Candidate, study: Study) -> Hypothesis:
    """Return the hypothesis with the law in place of a richer one that grew from it."""
    index = hypothesis.fit.structure.effects.index(rich)
    effect = find_effect(rich.effect.grows_from or rich.effect.key)
    at = [rich.effect.names.index(name) for name in effect.names]
    plain = Candidate(
        effect=effect,
        place=rich.place,
        signs=tuple(rich.signs[i] for i in at),
        scales=tuple(rich.scales[i] for i in at),
    )
    values = [hypothesis.fit.terms[index].values[i] for i in at]
    fit = fit_whole(hypothesis.fit.without(index).with_effect(plain, values), study)
    return judge(fit, study, added=hypothesis.added)


def steps_to(
    chosen: Hypothesis, found: Sequence[Hypothesis], study: Study
) -> tuple[Hypothesis, ...]:
    """Return the linear model, one effect, … chosen: what helps most by itself comes first."""
    steps = [chosen]
    while effects := steps[0].fit.structure.effects:
        key = steps[0].key
        smaller = [h for h in found if h.key < key and len(h.key) == len(key) - 1]
        smaller = smaller or [_without(steps[0], effects[-1], study)]
        steps.insert(0, min(smaller, key=lambda h: h.error))
    return tuple(steps)
