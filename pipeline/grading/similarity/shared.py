"""Find recordings that two submissions share, by comparing their noise.

Equal noise is evidence if it goes beyond what the class shares. But if other pairs of the class
have partly equal noise, it proves nothing. Rows that are equal up to a factor are always evidence.
In a class of fewer than five teams, only equal rows count.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import zip_longest
from typing import Any

import numpy as np

from pipeline.grading.grade import Flag
from pipeline.grading.gradings import Member
from pipeline.grading.intake.lms_names import same_number
from pipeline.grading.similarity.likeness import (
    LEAST_OVERLAP,
    LEAST_SLOPE,
    Likeness,
    align,
    compare,
    equal_rows,
)
from pipeline.grading.similarity.prints import PASSED, Print, unpack
from pipeline.words.numbers import first_few

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
_COUNTS = 4.5  # sigmas that a recording needs to count together with others
# Sigmas that a single recording needs. In a class of 200 (1e9 comparisons) chance reaches 6.1.
_ALONE = 6.5
# Sigmas that several recordings need together, as the root of the sum of their squares.
_TOGETHER = 7.5
# Suppose two honest runs have the same motion and encoder zero, and noise of 1/25 count. Then one
# reading in 22 is rounded differently, so 22 equal readings have a probability of 1/e.
_TO_A_ROUNDING = 22
_MOST_ALIGNED = 60  # most recordings of other teams that are aligned with a recording
_MOST_OTHERS = 24  # aligned recordings that are used to explain a recording
_FEWEST_TEAMS = 3  # fewest teams from which these recordings must come
# Share of the other teams that is left out, the most similar first, because they may have the same
# copy.
_COPIES = 1 / 3
_MOST_IN_PART = 1  # pairs with partly equal noise that are tolerated: two knocks may coincide once
# For each 10 pairs with fully equal noise, one more pair with partly equal noise is tolerated.
_MATCHES_TO_IN_PART = 10


@dataclass(frozen=True, kw_only=True)
class SharedRecord:
    """A recording that another submission also contains.

    Attributes
    ----------
    submission, other_experiment : the other submission, and the recording's name in it.
    sigmas : agreement of the noise, in standard deviations above chance.
    equal_rows : number of consecutive rows that are equal up to one factor per column; 0 if this is
        not the evidence.
    time, other_time : start and end of the equal part, in s, in both recordings.
    """

    experiment: str
    submission: str
    other_experiment: str
    sigmas: float
    equal_rows: int
    time: tuple[float, float]
    other_time: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Entry:
    """A fingerprint, and the number of the submission that contains it."""

    owner: int
    print: Print


# (likeness, owner, recording, shift)
_Aligned = tuple[float, int, Print, int]


def find_shared(
    batch: Sequence[Member],
    *,
    earlier: Iterable[Member] = (),
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
        *(Member(submission="", authors=(), fingerprints=packed) for packed in examples),
    ]
    groups = _by_group(owners)
    matches: dict[tuple[int, int], list[Likeness]] = defaultdict(list)
    for _, entries in sorted(groups.items()):
        for pair, likeness in _matches(
            entries, first_batch=len(batch), everyone=len(everyone), owners=owners
        ):
            matches[pair].append(likeness)
    matches = _proving(matches)
    compared = sum(len(entries) ** 2 for entries in groups.values())
    given = {
        (a, one.experiments[0])
        for (a, b), found in matches.items()
        if b >= len(everyone)
        for one in found
        if one.equal_rows or one.sigmas >= _ALONE
    }
    shared: dict[str, list[SharedRecord]] = defaultdict(list)
    for pair, found in sorted(matches.items()):
        own = [one for one in found if given.isdisjoint(zip(pair, one.experiments, strict=True))]
        for one in _decisive(own, compared=compared) if pair[1] < len(everyone) else ():
            for mine, other in ((0, 1), (1, 0)):
                if pair[mine] < len(batch):
                    record = _record_of(one, mine, other, submission=names[pair[other]])
                    shared[names[pair[mine]]].append(record)
    return {
        name: tuple(sorted(found, key=lambda r: (r.submission, r.experiment, r.other_experiment)))
        for name, found in sorted(shared.items())
    }


def _by_group(owners: Iterable[Member]) -> dict[str, list[_Entry]]:
    """Group fingerprints that may come from the same recording, without duplicates of one owner."""
    groups: dict[str, list[_Entry]] = defaultdict(list)
    for owner, prints in enumerate(owners):
        once: dict[tuple[str, bytes], Print] = {}
        for one in unpack(prints.fingerprints):  # a recording under several names counts once
            once.setdefault((one.group, one.residual.tobytes()), one)
        for one in once.values():
            groups[one.group].append(_Entry(owner=owner, print=one))
    return groups


def _record_of(one: Likeness, mine: int, other: int, *, submission: str) -> SharedRecord:
    """Return a likeness as seen from one of the two submissions."""
    return SharedRecord(
        experiment=one.experiments[mine],
        submission=submission,
        other_experiment=one.experiments[other],
        sigmas=round(one.sigmas, 1),
        equal_rows=one.equal_rows,
        time=one.times[mine],
        other_time=one.times[other],
    )


def shared_flag(records: Sequence[SharedRecord]) -> Flag:
    """Return the flag of one submission for its shared recordings."""
    recordings = [asdict(record) for record in records]
    others = list(dict.fromkeys(record.submission for record in records))
    return Flag(
        code="shared_data",
        parameters=tuple(dict.fromkeys(record.experiment for record in records)),
        message=shared_message(recordings, others),
        evidence={"submissions": others, "recordings": recordings},
    )


def shared_message(recordings: Sequence[Mapping[str, Any]], others: Iterable[str]) -> str:
    """Return the sentence about recordings in other submissions, with the best evidence.

    Parameters
    ----------
    recordings : the recordings in the evidence of a flag; some from an older gradebook have no
        times.
    """
    experiments = list(dict.fromkeys(one["experiment"] for one in recordings))
    are = "is" if len(experiments) == 1 else "are"
    best = max(recordings, key=lambda one: (one.get("equal_rows", 0), one["sigmas"]))
    when = " from {:g} s to {:g} s".format(*best["time"]) if "time" in best else ""
    rows = best.get("equal_rows", 0)
    same = f"{rows} consecutive rows are equal" if rows else "the noise is the same"
    return (
        f"{first_few(experiments, 4)} {are} also in {', '.join(others)}: "
        f"{same},{when} in {best['experiment']}. "
        "This does not show whose recording it is; if it was shared for a reason, say so."
    )


def student_message(flag: Flag) -> str:
    """Return the message of a flag as students see it, without the name of another submission."""
    if flag.code != "shared_data":
        return flag.message
    return shared_message(flag.evidence["recordings"], ["another submission"])


def same_team(a: Member, b: Member) -> bool:
    """Return whether two submissions are from the same team.

    They are from the same team if they have an author or an account number in common. If one of
    them names no authors, equal names of the submissions are enough.
    """
    if same_number(a.owner, b.owner):
        return True
    if a.people and b.people:
        return not a.people.isdisjoint(b.people)
    return a.submission == b.submission


def same_recordings(a: Member, b: Member) -> bool:
    """Return whether one of two submissions contains all recordings of the other, unchanged."""
    of_a, of_b = ({one.residual.tobytes() for one in unpack(p.fingerprints)} for p in (a, b))
    return bool(of_a and of_b) and (of_a <= of_b or of_b <= of_a)


def _proving(
    matches: Mapping[tuple[int, int], Sequence[Likeness]],
) -> dict[tuple[int, int], list[Likeness]]:
    """Return the matches that prove a copy, by pair of submissions.

    If the noise of several pairs agrees only partly, the bench or its encoder causes the agreement.
    Then full agreement of noise proves nothing either. Equal rows always prove a copy.
    """
    sure = [one for found in matches.values() for one in found if one.is_sure]
    whole = sum(one.is_whole for one in sure)
    if len(sure) - whole > max(_MOST_IN_PART, whole // _MATCHES_TO_IN_PART):
        matches = {pair: [replace(o, slope=0.0) for o in found] for pair, found in matches.items()}
    return {
        pair: [one for one in found if one.equal_rows or one.is_whole]
        for pair, found in matches.items()
    }


def _decisive(found: Sequence[Likeness], *, compared: int) -> list[Likeness]:
    """Return the matches of two submissions, one per recording, if together they prove a copy.

    Parameters
    ----------
    compared : number of pairs of recordings in which chance could have made a match.
    """
    chosen: list[Likeness] = []
    for one in sorted(found, key=lambda one: (-one.different, -one.sigmas, one.experiments)):
        a, b = one.experiments
        if all(a != c.experiments[0] and b != c.experiments[1] for c in chosen):
            chosen.append(one)
    sigmas = [one.sigmas for one in chosen if one.is_whole]
    noise = max(sigmas, default=0.0) >= _ALONE or np.linalg.norm(sigmas) >= _TOGETHER
    equal = sum(one.different for one in chosen) >= _TO_A_ROUNDING * np.log(max(compared, 2))
    return chosen if noise or equal else []


# ------------------------------------------------------------------- candidates


def _matches(
    entries: Sequence[_Entry], *, first_batch: int, everyone: int, owners: Sequence[Member]
) -> Iterator[tuple[tuple[int, int], Likeness]]:
    """Yield pairs of similar recordings from different teams, each with its two owners."""
    best: dict[tuple[int, int], Likeness] = {}
    alike: dict[tuple[int, int], float] = defaultdict(lambda: _COUNTS)  # best likeness so far
    seen: set[tuple[int, int, int]] = set()
    aligned: dict[int, list[_Aligned]] = {}

    @cache
    def same(a: int, b: int) -> bool:
        return same_team(owners[a], owners[b])

    # For a recording and another submission, the recording in that submission that is certainly a
    # copy.
    partner: dict[tuple[int, int], int] = {}
    compared: Counter[tuple[int, int]] = Counter()
    recordings = Counter(entry.owner for entry in entries)
    for i, anchor_i, j, anchor_j in _candidates(entries, everyone=everyone):
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
        likeness = compare(a.print, b.print, shift=shift)
        if likeness.slope < LEAST_SLOPE or likeness.sigmas <= alike[i, j]:
            continue
        alike[i, j] = likeness.sigmas
        equal = equal_rows(a.print, b.print, shift=shift)
        if i not in aligned:
            aligned[i] = _aligned(entries, i)
        teams = {o for _, o, _, _ in aligned[i] if not any(same(o, own) for own in pair)}
        if others := _others([one for one in aligned[i] if one[1] in teams]):
            likeness = compare(a.print, b.print, shift=shift, others=others)
        else:
            likeness = replace(likeness, slope=0.0)
        if equal:
            likeness = replace(equal, slope=likeness.slope, sigmas=likeness.sigmas)
        best[i, j] = likeness
        if likeness.equal_rows or (likeness.is_whole and likeness.sigmas >= _ALONE):
            partner[i, b.owner], partner[j, a.owner] = j, i
    for (i, j), likeness in sorted(best.items(), key=lambda one: one[0]):
        yield (entries[i].owner, entries[j].owner), likeness


def _aligned(entries: Sequence[_Entry], i: int) -> list[_Aligned]:
    """Return recordings of other submissions, aligned with recording i, the most similar first."""
    rest = [one for one in entries if one.owner != entries[i].owner]
    found = []
    for one in rest[:: max(1, len(rest) // _MOST_ALIGNED)]:
        alike, shift = align(entries[i].print, one.print)
        found.append((alike, one.owner, one.print, shift))
    return sorted(found, key=lambda one: -one[0])


def _others(aligned: Sequence[_Aligned]) -> list[tuple[Print, int]]:
    """Return recordings that show what a class shares, with their shifts; empty for a small class.

    The most similar ones are left out, because their teams may have the same copy.
    """
    teams = list(dict.fromkeys(owner for _, owner, _, _ in aligned))
    if len(teams) < _FEWEST_TEAMS:
        return []
    kept = teams[min(int(len(teams) * _COPIES), len(teams) - _FEWEST_TEAMS) :]
    return [(one, shift) for _, owner, one, shift in aligned if owner in kept][:_MOST_OTHERS]


def _candidates(entries: Sequence[_Entry], *, everyone: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield anchors with similar noise around them: (entry, anchor, other entry, other anchor).

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
        for _, place, column in sorted(found, key=lambda one: (-one[0], one[1:])):
            yield *places[place], *first[column]


def _windows(entries: Sequence[_Entry], places: Sequence[tuple[int, int]]) -> np.ndarray:
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
    return flat * np.where(counts >= LEAST_OVERLAP, factor, 0.0).astype(np.float32)[:, None]
