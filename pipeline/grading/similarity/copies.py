"""Find recordings that two submissions share.

Two kinds of evidence count. Rows that are equal up to a factor prove that one recording is a copy.
Without them, a pair of submissions is judged as a whole, by the noise of most of its recordings
and the releases of its decays (see `noise`). In a class of fewer than five teams, only equal rows
count.
"""

from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from itertools import zip_longest

import numpy as np

from pipeline.grading.gradings import Grading
from pipeline.grading.platforms import same_number
from pipeline.grading.similarity import noise
from pipeline.grading.similarity.fingerprints import PASSED, Fingerprint, unpack
from pipeline.grading.similarity.releases import Releases, chance, is_decay, usual_parts

_WIDTH = 512  # samples around an anchor that the first comparison uses
_BEFORE = 128  # number of these samples that precede the anchor
# Number of best anchors of each recording, with which all anchors are compared.
_FIRST_IN_MOTION, _FIRST_IN_NOISE = 2, 1
# Levels per standard deviation to which noise is rounded in the first comparison, and the largest
# level. Finer levels would show rounding.
_PER_SIGMA, _LEVELS = 1.5, 5.0
_BLOCK = 2048  # anchors compared in one matrix product
_WORTH_A_LOOK = 3.2  # sigmas in the first comparison; chance reaches this once in a thousand
# With the next two limits, the further work grows with the number of recordings, not with its
# square. The first one is the number of most similar candidates kept for each anchor, besides
# recordings of the lab. With 4,000 recordings of one kind, chance gives as many.
_MOST_ALIKE = 16
# Comparisons of two submissions, as a multiple of their recordings of one kind. Two honest teams
# with 20 recordings each need a tenth of this.
_MOST_COMPARED = 10
_LEAST_ALIKE = 4.5  # sigmas at which two recordings are searched for equal rows
# Suppose two honest runs have the same motion and encoder zero, and noise of 1/25 count. Then one
# reading in 22 is rounded differently, so 22 equal readings have a probability of 1/e.
_TO_A_ROUNDING = 22
_FEWEST_TEAMS = 3  # other teams that are needed to tell what a class shares
_MOST_TEAMS = 8  # other teams that are asked
# The noise of a submission is compared with that of a few others whose recordings are the most
# similar, and of those whose releases agree this well.
_MOST_SIMILAR, _RELEASED_ALIKE = 3, 0.05
_SPECTRA_KEPT = 36  # submissions


@dataclass(frozen=True, kw_only=True)
class SharedRecord:
    """A recording that another submission also contains.

    Attributes
    ----------
    submission, other_experiment : the other submission, and the recording's name in it.
    sigmas : agreement of the noise, in standard deviations above chance.
    equal_rows : number of consecutive rows that are equal up to one factor per column; 0 if this is
        not the evidence.
    delay : samples between two decays that are one motion, None if this is not the evidence.
    time, other_time : start and end of the equal part, in s, in both recordings.
    """

    experiment: str
    submission: str
    other_experiment: str
    sigmas: float
    equal_rows: int
    delay: float | None
    time: tuple[float, float]
    other_time: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Owned:
    """A fingerprint, and the number of the submission that contains it."""

    owner: int
    print: Fingerprint


def find_copies(
    batch: Sequence[Grading],
    *,
    earlier: Iterable[Grading] = (),
    examples: Iterable[bytes] = (),
) -> dict[str, tuple[SharedRecord, ...]]:
    """Return, for each submission of the batch, the recordings that it shares with others.

    Parameters
    ----------
    earlier : submissions of earlier batches; they are compared only with the batch, not with each
        other.
    examples : packed fingerprints of recordings that the lab gave out; everybody may have them.
    """
    everyone = [*batch, *earlier]
    names = [
        prints.submission if number < len(batch) else f"{prints.submission} (an earlier batch)"
        for number, prints in enumerate(everyone)
    ]
    owners = [
        *everyone,
        *(Grading(submission="", authors=(), fingerprints=packed) for packed in examples),
    ]
    groups = _by_group(owners)
    equal: dict[tuple[int, int], list[noise.Match]] = defaultdict(list)
    total: dict[tuple[int, int], float] = defaultdict(float)
    for _, entries in sorted(groups.items()):
        for pair, match in _equal(
            entries, first_batch=len(batch), everyone=len(everyone), owners=owners, total=total
        ):
            equal[pair].append(match)
    compared = sum(len(entries) ** 2 for entries in groups.values())
    given = {
        (a, one.experiments[0])
        for (a, b), found in equal.items()
        if b >= len(everyone)
        for one in found
    }
    proof: dict[tuple[int, int], list[noise.Match]] = {}
    for pair, found in equal.items():
        own = [one for one in found if given.isdisjoint(zip(pair, one.experiments, strict=True))]
        proof[pair] = _decisive(own, compared=compared) if pair[1] < len(everyone) else []
    pairs = _Pairs(groups, everyone=everyone, first_batch=len(batch))
    for pair in pairs.worth_hearing(total):
        proof[pair] = [*proof.get(pair, ()), *pairs.shared(pair, given, proof.get(pair, ()))]
    shared: dict[str, list[SharedRecord]] = defaultdict(list)
    for pair, found in sorted(proof.items()):
        for one in found:
            for mine, other in ((0, 1), (1, 0)):
                if pair[mine] < len(batch):
                    record = _record_of(one, mine, other, submission=names[pair[other]])
                    shared[names[pair[mine]]].append(record)
    return {
        name: tuple(sorted(found, key=lambda r: (r.submission, r.experiment, r.other_experiment)))
        for name, found in sorted(shared.items())
    }


def _by_group(owners: Iterable[Grading]) -> dict[str, list[_Owned]]:
    """Group fingerprints that may come from the same recording, without duplicates of one owner."""
    groups: dict[str, list[_Owned]] = defaultdict(list)
    for owner, prints in enumerate(owners):
        once: dict[tuple[str, bytes], Fingerprint] = {}
        for one in unpack(prints.fingerprints):  # a recording under several names counts once
            once.setdefault((one.group, one.residual.tobytes()), one)
        for one in once.values():
            groups[one.group].append(_Owned(owner=owner, print=one))
    return groups


def _record_of(one: noise.Match, mine: int, other: int, *, submission: str) -> SharedRecord:
    """Return a match as seen from one of the two submissions."""
    return SharedRecord(
        experiment=one.experiments[mine],
        submission=submission,
        other_experiment=one.experiments[other],
        sigmas=round(one.sigmas, 1),
        equal_rows=one.equal_rows,
        delay=None if one.delay is None else round(one.delay if mine == 0 else -one.delay, 3),
        time=one.times[mine],
        other_time=one.times[other],
    )


def same_team(a: Grading, b: Grading) -> bool:
    """Return whether two submissions are from the same team.

    They are from the same team if they have an author or an account number in common. If one of
    them names no authors, equal names of the submissions are enough.
    """
    if same_number(a.owner, b.owner):
        return True
    if a.people and b.people:
        return not a.people.isdisjoint(b.people)
    return a.submission == b.submission


def same_recordings(a: Grading, b: Grading) -> bool:
    """Return whether one of two submissions contains all recordings of the other, unchanged."""
    of_a, of_b = ({one.residual.tobytes() for one in unpack(p.fingerprints)} for p in (a, b))
    return bool(of_a and of_b) and (of_a <= of_b or of_b <= of_a)


def _decisive(found: Sequence[noise.Match], *, compared: int) -> list[noise.Match]:
    """Return the matches of two submissions, one per recording, if together they prove a copy.

    Parameters
    ----------
    compared : number of pairs of recordings in which chance could have made a match.
    """
    chosen: list[noise.Match] = []
    for one in sorted(found, key=lambda one: (-one.different, -one.sigmas, one.experiments)):
        a, b = one.experiments
        if all(a != c.experiments[0] and b != c.experiments[1] for c in chosen):
            chosen.append(one)
    least = _TO_A_ROUNDING * np.log(max(compared, 2))
    return chosen if sum(one.different for one in chosen) >= least else []


# ------------------------------------------------------- pairs of submissions


class _Pairs:
    """Noise and releases of a class's submissions; noise is compared on demand."""

    def __init__(
        self,
        groups: Mapping[str, Sequence[_Owned]],
        *,
        everyone: Sequence[Grading],
        first_batch: int,
    ):
        self._everyone = everyone
        self._prints: dict[int, dict[str, list[Fingerprint]]] = defaultdict(
            lambda: defaultdict(list)
        )
        for group, found in groups.items():
            for entry in found:
                self._prints[entry.owner][group].append(entry.print)
        self._lengths = {
            group: noise.padded_length([one.print for one in found])
            for group, found in groups.items()
        }
        # Spectra take up to 5 MB for each submission.
        self._of = lru_cache(maxsize=_SPECTRA_KEPT)(self._heard)
        self._found: dict[tuple[int, int], list[noise.Agreement]] = {}
        releases = {a: Releases(self._prints[a]) for a in range(len(everyone))}
        self._delays = {
            (a, b): releases[a].delays_to(releases[b])
            for a in range(first_batch)
            for b in range(a + 1, len(everyone))
            if not self._same_team(a, b)
        }
        self._usual = usual_parts([one for found in self._delays.values() for one in found])

    def _heard(self, submission: int) -> dict[str, list[noise.Heard]]:
        return {
            group: [noise.Heard(print=one, length=self._lengths[group]) for one in prints]
            for group, prints in self._prints[submission].items()
        }

    def worth_hearing(self, similarity: Mapping[tuple[int, int], float]) -> list[tuple[int, int]]:
        """Return the pairs of submissions whose noise is compared.

        Parameters
        ----------
        similarity : similarity of pairs in the first comparison.
        """
        kept = {pair for pair in self._delays if self._chance(pair) < _RELEASED_ALIKE}
        taken: Counter[int] = Counter()
        for pair, _ in sorted(similarity.items(), key=lambda one: (-one[1], one[0])):
            if pair in self._delays and min(taken[one] for one in pair) < _MOST_SIMILAR:
                kept.add(pair)
                taken.update(pair)
        return sorted(kept)

    def _chance(self, pair: tuple[int, int], given: Container[tuple[int, str]] = ()) -> float:
        """Return how probable it is that honest releases agree as well; see `releases.chance`."""
        found = [
            one
            for one in self._delays.get(pair, ())
            if not any(
                (o, p.experiment) in given for o, p in zip(pair, one.fingerprints, strict=True)
            )
        ]
        a, b = (self._prints[one] for one in pair)
        of = sum(min(len(a[group]), len(b[group])) for group in a.keys() & b.keys()
                 if is_decay(group))  # fmt: skip
        return chance(found, of=of, usual=self._usual)

    def shared(
        self, pair: tuple[int, int], given: Container[tuple[int, str]], known: Iterable[noise.Match]
    ) -> list[noise.Match]:
        """Return the recordings that two submissions share according to noise and releases.

        Parameters
        ----------
        given : submission and name of each recording that the lab gave out.
        known : recordings with equal rows; they are not returned again.
        """
        found = [
            one
            for one in self._agreements(*pair)
            if not any((pair[side], one.of(side)) in given for side in (0, 1))
        ]
        others = self._others(pair)
        proof = partial(
            noise.copied, found, releases=self._chance(pair, given), pairs=len(self._delays)
        )
        if len(others) < _FEWEST_TEAMS or not proof():
            return []
        a, b = (noise.usual(self._seen_from(own, c) for c in others) for own in pair)
        told = {one.experiments for one in known}
        return [
            one.match_of(sigmas)
            for one, sigmas in proof((a, b))
            if (one.of(0), one.of(1)) not in told
        ]

    def _others(self, pair: tuple[int, int]) -> list[int]:
        """Return submissions of other teams, spread evenly over the class."""
        everyone = self._everyone
        teams = [
            c
            for c in range(len(everyone))
            if c in self._prints and not any(self._same_team(c, own) for own in pair)
        ]
        return teams[:: max(1, len(teams) // _MOST_TEAMS)]

    def _seen_from(self, own: int, other: int) -> tuple[list[noise.Agreement], int]:
        """Return the agreements of two submissions, and which side the first one is."""
        first, second = sorted((own, other))
        return self._agreements(first, second), int(own != first)

    def _same_team(self, a: int, b: int) -> bool:
        return a == b or same_team(self._everyone[a], self._everyone[b])

    def _agreements(self, a: int, b: int) -> list[noise.Agreement]:
        if (a, b) not in self._found:
            delays = self._delays.get((a, b), ())
            self._found[a, b] = noise.agreements(self._of(a), self._of(b), delays)
        return self._found[a, b]


# ------------------------------------------------------------------- candidates


def _equal(
    entries: Sequence[_Owned],
    *,
    first_batch: int,
    everyone: int,
    owners: Sequence[Grading],
    total: dict[tuple[int, int], float],
) -> Iterator[tuple[tuple[int, int], noise.Match]]:
    """Yield pairs of recordings with equal rows from different teams, each with its two owners.

    Parameters
    ----------
    total : the similarity of submissions, to which these recordings are added.
    """
    best: dict[tuple[int, int], noise.Match] = {}
    most: dict[tuple[int, int], float] = defaultdict(lambda: _LEAST_ALIKE)  # best similarity so far
    seen: set[tuple[int, int, int]] = set()

    @cache
    def same(a: int, b: int) -> bool:
        return same_team(owners[a], owners[b])

    # For a recording and another submission, the recording in that submission that is certainly a
    # copy.
    partner: dict[tuple[int, int], int] = {}
    compared: Counter[tuple[int, int]] = Counter()
    recordings = Counter(entry.owner for entry in entries)
    for i, anchor_i, j, anchor_j, sigmas in _candidates(entries, everyone=everyone):
        a, b = entries[i], entries[j]
        if a.owner > b.owner:
            i, anchor_i, j, anchor_j, a, b = j, anchor_j, i, anchor_i, b, a
        pair = (a.owner, b.owner)
        shift = anchor_j - anchor_i
        if pair[0] >= first_batch or same(*pair) or (i, j, shift) in seen:
            continue
        seen.add((i, j, shift))
        if partner.get((i, b.owner), j) != j or partner.get((j, a.owner), i) != i:
            continue
        compared[pair] += 1
        if compared[pair] > _MOST_COMPARED * (recordings[a.owner] + recordings[b.owner]):
            continue
        total[pair] += sigmas**2
        match = noise.compare(a.print, b.print, shift=shift)
        if match.slope < noise.LEAST_SLOPE or match.sigmas <= most[i, j]:
            continue
        most[i, j] = match.sigmas
        if equal := noise.equal_rows(a.print, b.print, shift=shift):
            best[i, j] = replace(equal, slope=match.slope, sigmas=match.sigmas)
            partner[i, b.owner], partner[j, a.owner] = j, i
    for (i, j), match in sorted(best.items(), key=lambda one: one[0]):
        yield (entries[i].owner, entries[j].owner), match


def _candidates(
    entries: Sequence[_Owned], *, everyone: int
) -> Iterator[tuple[int, int, int, int, float]]:
    """Yield anchors with similar noise: (entry, anchor, other entry, other anchor, sigmas).

    Motion and noise have separate anchors, and each kind yields the most similar pairs first. All
    anchors are compared with the best anchors of each recording. An index would not be faster than
    this product, because a copy with six times its noise added is hardly more similar than chance.

    Recordings that the lab gave out (owners from `everyone` on) are always candidates.
    """
    owners = np.array([entry.owner for entry in entries])
    kinds = zip_longest(*(one.print.anchors for one in entries), fillvalue=())
    for anchors, n_first in zip(kinds, (_FIRST_IN_MOTION, *2 * (_FIRST_IN_NOISE,)), strict=False):
        places = [(i, at) for i, own in enumerate(anchors) for at in own]
        first = [(i, at) for i, own in enumerate(anchors) for at in own[:n_first]]
        if not places:
            continue
        columns = _windows(entries, first).T
        of_columns = owners[[i for i, _ in first]]
        found: list[tuple[float, int, int]] = []  # similarity, place, best anchor
        for start in range(0, len(places), _BLOCK):
            block = places[start : start + _BLOCK]
            alike = np.abs(_windows(entries, block) @ columns)
            alike[owners[[i for i, _ in block]][:, None] == of_columns] = 0.0
            for row in np.flatnonzero(np.any(alike >= _WORTH_A_LOOK, axis=1)).tolist():
                near = np.flatnonzero(alike[row] >= _WORTH_A_LOOK)
                given = of_columns[near] >= everyone
                most = np.argsort(-alike[row, near[~given]], kind="stable")[:_MOST_ALIKE]
                near = np.concatenate([near[given], near[~given][most]])
                found += [(float(alike[row, c]), start + row, c) for c in near.tolist()]
        for sigmas, place, column in sorted(found, key=lambda one: (-one[0], one[1:])):
            yield *places[place], *first[column], sigmas


def _windows(entries: Sequence[_Owned], places: Sequence[tuple[int, int]]) -> np.ndarray:
    """Return the residuals around anchors, (n, n_free * _WIDTH).

    They are scaled so that the product of two is approximately in sigmas.
    """
    n_free = entries[0].print.residual.shape[0]
    windows = np.zeros((len(places), n_free, _WIDTH), dtype=np.float32)
    for window, (i, at) in zip(windows, places, strict=True):
        residual, start = entries[i].print.noise, at - _BEFORE
        part = residual[:, max(start, 0) : start + _WIDTH]
        window[:, max(-start, 0) : max(-start, 0) + part.shape[1]] = part
    flat = np.clip(np.round(_PER_SIGMA * windows.reshape(len(places), -1)), -_LEVELS, _LEVELS)
    counts = np.count_nonzero(flat, axis=1)
    power = np.einsum("ij,ij->i", flat, flat)
    factor = (PASSED * counts) ** 0.25 / np.sqrt(np.maximum(power, 1.0))
    return flat * np.where(counts >= noise.LEAST_OVERLAP, factor, 0.0).astype(np.float32)[:, None]
