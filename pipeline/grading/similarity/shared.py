"""Recordings that stand in two submissions: found by their noise, named on both sides.

Noise convicts where it agrees wholly, and nobody's in the class agrees in part; equal rows do
whatever else is found. With fewer than four teams to compare only equal rows do.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

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
from pipeline.names import first_few
from pipeline.schemas.grade import Flag

_WIDTH = 512  # samples around an anchor that are compared at first
_BEFORE = 128  # of them before it
_FIRST_IN_MOTION, _FIRST_IN_NOISE = 2, 1  # anchors that all of the others are held against
_BLOCK = 2048  # anchors compared in one product
_WORTH_A_LOOK = 3.2  # sigmas at first sight: one in a thousand by chance
# The rest of the work grows with the number of recordings, not with its square. Chance offers so
# many at first sight where 4,000 recordings are of one kind, and two honest teams with 20 runs of
# that kind each a tenth of what is compared at most.
_MOST_ALIKE = 16  # first anchors looked at for one anchor, the most alike; and what was handed out
_MOST_COMPARED = 10  # times the recordings that two submissions have of one kind
_COUNTS = 4.5  # sigmas of a recording that counts with others
_ALONE = 6.5  # … by itself: a class of 200 offers 1e9 comparisons, chance reaches 6.1 in them
_TOGETHER = 7.5  # root of the summed squares of several
_EQUAL_READINGS = 300  # of different rows, of all recordings: see `equal_rows`
# The reference of two recordings is one third of a class away from them: copies in a third of the
# class are so told from the bench.
_MOST_ALIGNED = 60  # recordings of others that are looked at
_MOST_OTHERS = 24  # of them that explain
_FEWEST_TEAMS = 3  # that explain
_COPIES = 1 / 3  # of the other teams, the most alike: they may have the same copy
_MOST_IN_PART = 1  # pair of a class whose noise agrees in part: two knocks may meet once
_MATCHES_TO_IN_PART = 10  # no chance, if that many agree wholly for each pair that does in part


@dataclass(frozen=True, kw_only=True)
class SharedRecord:
    """A recording of one submission that is one of another's, too.

    Attributes
    ----------
    sigmas : how far above chance their noise agrees.
    equal_rows : how many rows in turn are equal, but for one factor a column; 0 where not all are.
    time, other_time : s, from and to, where they are equal or agree.
    """

    experiment: str
    other: str
    other_experiment: str
    sigmas: float
    equal_rows: int
    time: tuple[float, float]
    other_time: tuple[float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Match:
    """Two recordings that agree: `a` is of the submission with the lower number."""

    a: Print
    b: Print
    shift: int
    likeness: Likeness

    def told(self, *, other: str, swapped: bool) -> SharedRecord:
        """Return what one of the two submissions is told."""
        times = [
            tuple(round(one.start + (row + s) * one.interval, 3) for row in self.likeness.rows)
            for one, s in ((self.a, 0), (self.b, self.shift))
        ]
        names = [self.a.experiment, self.b.experiment]
        mine, theirs = (1, 0) if swapped else (0, 1)
        return SharedRecord(
            experiment=names[mine],
            other=other,
            other_experiment=names[theirs],
            sigmas=self.likeness.sigmas,
            equal_rows=self.likeness.equal,
            time=times[mine],
            other_time=times[theirs],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Entry:
    """A fingerprint and the submission (by number) it is of."""

    owner: int
    print: Print


def find_shared(
    batch: Sequence[Member],
    *,
    earlier: Iterable[Member] = (),
    examples: Iterable[bytes] = (),
) -> dict[str, tuple[SharedRecord, ...]]:
    """Return, by submission of the batch, its recordings that stand in another submission.

    Parameters
    ----------
    earlier : of earlier batches; only held against the batch, not against one another.
    examples : packed fingerprints of recordings that were handed out: those may be shared.
    """
    everyone = [*batch, *earlier]
    names = [
        prints.submission if number < len(batch) else f"{prints.submission} (an earlier batch)"
        for number, prints in enumerate(everyone)
    ]
    owners = [*everyone, *(_handed_out(packed) for packed in examples)]
    groups: dict[str, list[_Entry]] = defaultdict(list)
    for owner, prints in enumerate(owners):
        once: dict[tuple[str, bytes], Print] = {}
        for one in unpack(prints.fingerprints):  # one recording under many names is one
            once.setdefault((one.group, one.residual.tobytes()), one)
        for one in once.values():
            groups[one.group].append(_Entry(owner=owner, print=one))
    matches: dict[tuple[int, int], list[_Match]] = defaultdict(list)
    for _, entries in sorted(groups.items()):
        for pair, match in _matches(
            entries, first_batch=len(batch), everyone=len(everyone), owners=owners
        ):
            matches[pair].append(match)
    convicts = _convicting([match.likeness for found in matches.values() for match in found])
    given = {
        (a, match.a.experiment)
        for (a, b), found in matches.items()
        if b >= len(everyone)
        for match in found
        if convicts(match.likeness) and match.likeness.sigmas >= _ALONE
    }
    shared: dict[str, list[SharedRecord]] = defaultdict(list)
    for (a, b), found in sorted(matches.items()):
        if b >= len(everyone):
            continue
        own = [
            match
            for match in found
            if convicts(match.likeness)
            and (a, match.a.experiment) not in given
            and (b, match.b.experiment) not in given
        ]
        for match in _decisive(own):
            for owner, other in ((a, b), (b, a)):
                if owner < len(batch):
                    told = match.told(other=names[other], swapped=owner == b)
                    shared[names[owner]].append(told)
    return {
        submission: tuple(sorted(found, key=lambda r: (r.other, r.experiment, r.other_experiment)))
        for submission, found in sorted(shared.items())
    }


def _handed_out(packed: bytes) -> Member:
    return Member(submission="", authors=(), fingerprints=packed)


def shared_flag(records: Sequence[SharedRecord]) -> Flag:
    """Return the flag of one submission: which recordings, and where else they stand."""
    recordings = [
        {
            "experiment": record.experiment,
            "submission": record.other,
            "other_experiment": record.other_experiment,
            "sigmas": round(record.sigmas, 1),
            "equal_rows": record.equal_rows,
            "time": list(record.time),
            "other_time": list(record.other_time),
        }
        for record in records
    ]
    others = list(dict.fromkeys(record.other for record in records))
    return Flag(
        code="shared_data",
        parameters=tuple(dict.fromkeys(record.experiment for record in records)),
        message=shared_message(recordings, others),
        evidence={"submissions": others, "recordings": recordings},
    )


def shared_message(recordings: Sequence[Mapping[str, Any]], others: Iterable[str]) -> str:
    """Return the sentence for recordings that stand in other submissions, with the best evidence.

    `recordings` as in the evidence of a flag; a gradebook may hold some without times.
    """
    experiments = list(dict.fromkeys(one["experiment"] for one in recordings))
    stand = "stands" if len(experiments) == 1 else "stand"
    best = max(recordings, key=lambda one: (one.get("equal_rows", 0), one["sigmas"]))
    when = "of {0:g} s to {1:g} s".format(*best["time"]) if "time" in best else "there"
    rows = best.get("equal_rows", 0)
    same = f"{rows} rows in turn are equal" if rows else "the noise is the same"
    return (
        f"{first_few(experiments, 4)} also {stand} in {', '.join(others)}: "
        f"{same}, those {when} in {best['experiment']}. "
        "That does not say whose they are; if they were shared for a reason, say so."
    )


def told(flag: Flag) -> str:
    """Return what a student reads of a flag: whose the other submission is, the instructor says."""
    if flag.code != "shared_data":
        return flag.message
    return shared_message(flag.evidence["recordings"], ["another submission"])


def same_team(a: Member, b: Member) -> bool:
    """Tell whether two submissions are of one team.

    That is with an author in common, or handed in under one number of a platform; without
    authors, of the same name.
    """
    if same_number(a.owner, b.owner):
        return True
    if a.people and b.people:
        return not a.people.isdisjoint(b.people)
    return a.submission == b.submission


def same_recordings(a: Member, b: Member) -> bool:
    """Tell whether one of two submissions has all recordings of the other, untouched."""
    of_a, of_b = ({one.residual.tobytes() for one in unpack(p.fingerprints)} for p in (a, b))
    return bool(of_a and of_b) and (of_a <= of_b or of_b <= of_a)


def _convicting(found: Sequence[Likeness]) -> Callable[[Likeness], bool]:
    """Return what tells a copy, given all pairs of a class that look alike.

    Where the noise of several agrees in part, the bench or its encoder makes it do so, and says
    nothing of those that agree wholly. Equal rows are a copy whatever else is found.
    """
    in_part = sum(one.is_in_part for one in found)
    whole = sum(one.is_whole for one in found)
    by_noise = in_part <= max(_MOST_IN_PART, whole // _MATCHES_TO_IN_PART)
    return lambda one: one.equal > 0 or (by_noise and one.is_whole)


def _decisive(found: Sequence[_Match]) -> list[_Match]:
    """Return the matches of one pair of submissions, one for each recording, if they suffice."""
    chosen: dict[tuple[str, str], _Match] = {}
    for match in sorted(found, key=lambda m: -m.likeness.sigmas):
        names = (match.a.experiment, match.b.experiment)
        if all(names[0] != a and names[1] != b for a, b in chosen):
            chosen[names] = match
    by_noise = [m.likeness.sigmas for m in chosen.values() if not m.likeness.equal]
    equal = sum(match.likeness.different for match in chosen.values()) >= _EQUAL_READINGS
    enough = max(by_noise, default=0.0) >= _ALONE or np.linalg.norm(by_noise) >= _TOGETHER
    return list(chosen.values()) if equal or enough else []


# ------------------------------------------------------------------- candidates


def _matches(
    entries: Sequence[_Entry], *, first_batch: int, everyone: int, owners: Sequence[Member]
) -> Iterator[tuple[tuple[int, int], _Match]]:
    """Yield pairs of recordings of different teams that look alike, with their owners."""
    best: dict[tuple[int, int], _Match] = {}
    alike: dict[tuple[int, int], float] = defaultdict(lambda: _COUNTS)  # at first comparison
    seen: set[tuple[int, int, int]] = set()
    apart: dict[tuple[int, int], bool] = {}
    partner: dict[tuple[int, int], int] = {}  # of a recording, in a submission: surely a copy
    compared: Counter[tuple[int, int]] = Counter()
    recordings = Counter(entry.owner for entry in entries)
    others = _Others(entries, owners)
    for i, anchor_i, j, anchor_j in _candidates(entries, everyone=everyone):
        a, b = entries[i], entries[j]
        if a.owner > b.owner:
            i, anchor_i, j, anchor_j, a, b = j, anchor_j, i, anchor_i, b, a
        pair = (a.owner, b.owner)
        if pair not in apart:
            apart[pair] = pair[0] < first_batch and not same_team(*(owners[o] for o in pair))
        shift = anchor_j - anchor_i
        if not apart[pair] or (i, j, shift) in seen:
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
        likeness = equal_rows(a.print, b.print, shift=shift)
        if likeness is None:
            beside = others.of(i, b.owner)
            if not beside:
                continue
            likeness = compare(a.print, b.print, shift=shift, others=beside)
        match = _Match(a=a.print, b=b.print, shift=shift, likeness=likeness)
        best[i, j] = match
        if likeness.equal or (likeness.is_whole and likeness.sigmas >= _ALONE):
            partner[i, b.owner], partner[j, a.owner] = j, i
    for (i, j), match in sorted(best.items(), key=lambda one: one[0]):
        yield (entries[i].owner, entries[j].owner), match


class _Others:
    """The recordings that are held beside one, the most alike first: what they share is no one's."""

    def __init__(self, entries: Sequence[_Entry], owners: Sequence[Member]) -> None:
        self._entries, self._owners = entries, owners
        self._aligned: dict[int, list[tuple[float, int, int]]] = {}

    def of(self, i: int, other: int) -> list[tuple[Print, int]]:
        """Return the others for recording i and one of another submission, with their shifts."""
        mine = self._entries[i].owner
        if i not in self._aligned:
            rest = [j for j, one in enumerate(self._entries) if one.owner != mine]
            some = rest[:: max(1, len(rest) // _MOST_ALIGNED)]
            mine_print = self._entries[i].print
            self._aligned[i] = sorted(
                ((*align(mine_print, self._entries[j].print), j) for j in some), reverse=True
            )
        teams = {
            owner: None
            for owner in (self._entries[j].owner for _, _, j in self._aligned[i])
            if not any(same_team(self._owners[owner], self._owners[o]) for o in (mine, other))
        }
        dropped = max(min(int(len(teams) * _COPIES), len(teams) - _FEWEST_TEAMS), 0)
        kept = set(list(teams)[dropped:] if len(teams) >= _FEWEST_TEAMS else ())
        found = [
            (self._entries[j].print, shift)
            for _, shift, j in self._aligned[i]
            if self._entries[j].owner in kept
        ]
        return found[:_MOST_OTHERS]


def _candidates(entries: Sequence[_Entry], *, everyone: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield (entry, its anchor, other entry, its anchor) whose surroundings look alike.

    All anchors are held against the first ones, in the motion and in the noise apart. No index
    does better than this one product: under its own noise six times over a copy looks hardly more
    alike than chance. The most alike come first, of those in the motion and of those in the noise.
    What was handed out, by owners beyond `everyone`, is never crowded out by those who used it.
    """
    owners = np.array([entry.owner for entry in entries])
    for kind, n_first in enumerate((_FIRST_IN_MOTION, _FIRST_IN_NOISE)):
        anchors = [one.print.anchors[kind] for one in entries]
        places = [(i, at) for i, own in enumerate(anchors) for at in own]
        first = [(i, at) for i, own in enumerate(anchors) for at in own[:n_first]]
        if not places:
            continue
        columns = _windows(entries, first).T
        of_columns = owners[[i for i, _ in first]]
        found: list[tuple[float, int, int]] = []  # how alike, the place, the first anchor
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

    Scaled so that a product of two is in sigmas, at first sight.
    """
    n_free = entries[0].print.residual.shape[0]
    windows = np.zeros((len(places), n_free, _WIDTH), dtype=np.float32)
    for window, (i, at) in zip(windows, places, strict=True):
        residual, start = entries[i].print.noise, at - _BEFORE
        part = residual[:, max(start, 0) : start + _WIDTH]
        window[:, max(-start, 0) : max(-start, 0) + part.shape[1]] = part
    flat = windows.reshape(len(places), -1)
    counts = np.count_nonzero(flat, axis=1)
    power = np.einsum("ij,ij->i", flat, flat)
    factor = (PASSED * counts) ** 0.25 / np.sqrt(np.maximum(power, 1.0))
    return flat * np.where(counts >= LEAST_OVERLAP, factor, 0.0).astype(np.float32)[:, None]
