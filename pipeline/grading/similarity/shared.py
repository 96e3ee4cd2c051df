"""Recordings that stand in two submissions: found by their noise, named on both sides.

A copy has the noise of its original, whatever noise was added on top: the regression of one
residual on the other, brought to one scale, has slope one. Two honest runs share at most what the
motion and the encoder's rounding leave in the residuals: with noise a slope well below a half.
Without noise, on a bench that repeats its motion to within a count, it is whatever their zeros
make of it, and the recordings that agree only in part, or disagree, show that this is so.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len

from pipeline.grading.gradings import Member
from pipeline.grading.intake.lms_names import same_number
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
_LEAST_OVERLAP = 80  # samples that say something in both
_LEAST_SLOPE = 0.5
# Read from zeros δ counts apart, one motion without noise is rounded to a slope of 1 - 6 δ + 6 δ²:
# one in five has 0.5 and more, one in two is in these bounds. With noise of 0.2 counts ± 0.09 is
# left of it, and none.
_LEAST_IN_PART, _MOST_IN_PART = 0.2, 0.4  # or below minus the least
_MATCHES_TO_IN_PART = 10  # no chance, if that many agree wholly for each pair that does in part
_NEARBY = 50  # shifts to either side that show how well chance does here
_OWN_WIDTH = 2  # shifts next to the right one see the same match
_COUNTS = 4.5  # sigmas of a recording that counts with others
_ALONE = 6.5  # … by itself: a class of 200 offers 1e9 comparisons, chance reaches 6.1 in them
_TOGETHER = 7.5  # root of the summed squares of several


@dataclass(frozen=True, kw_only=True)
class SharedRecord:
    """A recording of one submission that is one of another's, too.

    `sigmas` says how far above chance they agree.
    """

    experiment: str
    other: str
    other_experiment: str
    sigmas: float


_Match = tuple[float, str, str]  # sigmas, the experiment in the one and in the other submission


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
        for a, b, sigmas in _matches(
            entries, first_batch=len(batch), everyone=len(everyone), owners=owners
        ):
            matches[a.owner, b.owner].append((sigmas, a.print.experiment, b.print.experiment))
    given = {
        (a, experiment)
        for (a, b), found in matches.items()
        if b >= len(everyone)
        for sigmas, experiment, _ in found
        if sigmas >= _ALONE
    }
    shared: dict[str, list[SharedRecord]] = defaultdict(list)
    for (a, b), found in sorted(matches.items()):
        if b >= len(everyone):
            continue
        own = [m for m in found if (a, m[1]) not in given and (b, m[2]) not in given]
        for sigmas, in_a, in_b in _decisive(own):
            for owner, other, mine, theirs in ((a, b, in_a, in_b), (b, a, in_b, in_a)):
                if owner < len(batch):
                    record = SharedRecord(
                        experiment=mine,
                        other=names[other],
                        other_experiment=theirs,
                        sigmas=sigmas,
                    )
                    shared[names[owner]].append(record)
    return {
        submission: tuple(sorted(found, key=lambda r: (r.other, r.experiment, r.other_experiment)))
        for submission, found in sorted(shared.items())
    }


def _handed_out(packed: bytes) -> Member:
    return Member(submission="", authors=(), fingerprints=packed)


def shared_flag(records: Sequence[SharedRecord]) -> Flag:
    """Return the flag of one submission: which recordings, and where else they stand."""
    experiments = tuple(dict.fromkeys(record.experiment for record in records))
    others = list(dict.fromkeys(record.other for record in records))
    return Flag(
        code="shared_data",
        parameters=experiments,
        message=shared_message(experiments, others),
        evidence={
            "submissions": others,
            "recordings": [
                {
                    "experiment": record.experiment,
                    "submission": record.other,
                    "other_experiment": record.other_experiment,
                    "sigmas": round(record.sigmas, 1),
                }
                for record in records
            ],
        },
    )


def shared_message(experiments: Sequence[str], others: Iterable[str]) -> str:
    """Return the sentence for recordings that stand in other submissions."""
    stand = "stands" if len(experiments) == 1 else "stand"
    return (
        f"{first_few(experiments, 4)} also {stand} in {', '.join(others)}: the noise of the "
        "recordings is the same. That does not say whose they are; if they were shared for a "
        "reason, say so."
    )


def told(flag: Flag) -> str:
    """Return what a student reads of a flag: whose the other submission is, the instructor says."""
    if flag.code != "shared_data":
        return flag.message
    return shared_message(flag.parameters, ["another submission"])


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
    return of_a <= of_b or of_b <= of_a


def _decisive(found: Sequence[_Match]) -> list[_Match]:
    """Return the matches of one pair of submissions, one for each recording, if they suffice.

    They do not where further recordings agree in part: the bench then repeats its motion to
    within a count, with little noise, and that some are rounded alike is a matter of the zeros.
    """
    chosen: list[_Match] = []
    for match in sorted(found, key=lambda m: (-m[0], m[1:])):
        if match[0] > 0 and all(match[1] != c[1] and match[2] != c[2] for c in chosen):
            chosen.append(match)
    if len(chosen) <= _MATCHES_TO_IN_PART * sum(sigmas < 0 for sigmas, _, _ in found):
        return []
    together = float(np.sqrt(sum(sigmas**2 for sigmas, _, _ in chosen)))
    enough = chosen and (chosen[0][0] >= _ALONE or together >= _TOGETHER)
    return chosen if enough else []


# ------------------------------------------------------------------- candidates


def _matches(
    entries: Sequence[_Entry], *, first_batch: int, everyone: int, owners: Sequence[Member]
) -> Iterator[tuple[_Entry, _Entry, float]]:
    """Yield pairs of recordings of different teams that share their noise, with the sigmas.

    Those that share only a part of it, as one motion's rounding does, have negative ones.
    """
    best: dict[tuple[int, int], float] = {}
    seen: set[tuple[int, int, int]] = set()
    apart: dict[tuple[int, int], bool] = {}
    partner: dict[tuple[int, int], int] = {}  # of a recording, in a submission: surely a copy
    compared: Counter[tuple[int, int]] = Counter()
    recordings = Counter(entry.owner for entry in entries)
    for i, anchor_i, j, anchor_j in _candidates(entries, everyone=everyone):
        a, b = entries[i], entries[j]
        if a.owner > b.owner:
            i, anchor_i, j, anchor_j, a, b = j, anchor_j, i, anchor_i, b, a
        pair = (a.owner, b.owner)
        if pair not in apart:
            apart[pair] = pair[0] < first_batch and not same_team(*(owners[o] for o in pair))
        shift = int(b.print.anchors[anchor_j] - a.print.anchors[anchor_i])
        if not apart[pair] or (i, j, shift) in seen:
            continue
        seen.add((i, j, shift))
        if partner.get((i, b.owner), j) != j or partner.get((j, a.owner), i) != i:
            continue
        compared[pair] += 1
        if compared[pair] > _MOST_COMPARED * (recordings[a.owner] + recordings[b.owner]):
            continue
        in_a, in_b = a.print.swing[anchor_i], b.print.swing[anchor_j]
        scale = float(in_b / in_a) if in_a and in_b else None
        sigmas = _agreement(a.print, b.print, shift=shift, scale=scale)
        if abs(sigmas) >= _COUNTS:
            best[i, j] = max(sigmas, best.get((i, j), sigmas))
        if sigmas >= _ALONE:
            partner[i, b.owner], partner[j, a.owner] = j, i
    for (i, j), sigmas in sorted(best.items()):
        yield entries[i], entries[j], sigmas


def _candidates(entries: Sequence[_Entry], *, everyone: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield (entry, its anchor, other entry, its anchor) whose surroundings look alike.

    All anchors are held against the first ones, in the motion and in the noise apart. No index
    does better than this one product: under its own noise six times over a copy looks hardly more
    alike than chance. The most alike come first, of those in the motion and of those in the noise.
    What was handed out, by owners beyond `everyone`, is never crowded out by those who used it.
    """
    owners = np.array([entry.owner for entry in entries])
    for in_motion, n_first in ((True, _FIRST_IN_MOTION), (False, _FIRST_IN_NOISE)):
        places, first = [], []
        for i, entry in enumerate(entries):
            anchors = np.flatnonzero((entry.print.swing != 0) == in_motion).tolist()
            places += [(i, k) for k in anchors]
            first += [(i, k) for k in anchors[:n_first]]
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
    for window, (i, k) in zip(windows, places, strict=True):
        residual, start = entries[i].print.residual, int(entries[i].print.anchors[k]) - _BEFORE
        part = residual[:, max(start, 0) : start + _WIDTH]
        window[:, max(-start, 0) : max(-start, 0) + part.shape[1]] = part
    flat = windows.reshape(len(places), -1)
    counts = np.count_nonzero(flat, axis=1)
    power = np.einsum("ij,ij->i", flat, flat)
    factor = (PASSED * counts) ** 0.25 / np.sqrt(np.maximum(power, 1.0))
    return flat * np.where(counts >= _LEAST_OVERLAP, factor, 0.0).astype(np.float32)[:, None]


# ----------------------------------------------------------------------- verdict


def _agreement(a: Print, b: Print, *, shift: int, scale: float | None) -> float:
    """Return by how many sigmas the noise of two recordings agrees; 0 where it is not one's own.

    Where it agrees or disagrees in part, as the noise of no two runs and of no copy does, the
    sigmas are negative.

    Sample i of `a` is sample i + shift of `b`, `scale` times as large. Where the motion does not
    tell the scale, that of the noise itself is taken: less further noise is then seen through.
    """
    first, last = max(0, -shift), min(a.residual.shape[1], b.residual.shape[1] - shift)
    if last - first < _LEAST_OVERLAP:
        return 0.0
    # In units of b's noise, so that every cart has its say.
    factor = np.ones(b.step.size) if scale is None else scale * a.step / b.step
    in_a = a.residual[:, first:last] * factor[:, None]
    in_b = b.residual[:, first + shift : last + shift].astype(np.float64)
    in_b, in_a = in_b * (in_a != 0), in_a * (in_b != 0)
    common = np.count_nonzero(in_a)
    power_a, power_b = float(np.sum(in_a**2)), float(np.sum(in_b**2))
    if common < _LEAST_OVERLAP:
        return 0.0
    product = float(np.sum(in_a * in_b))
    slope = (abs(product) if scale is None else product) / min(power_a, power_b)
    in_part = slope <= -_LEAST_IN_PART or _LEAST_IN_PART <= slope <= _MOST_IN_PART
    chance = float(np.sqrt(power_a * power_b / (PASSED * common)))
    whole = slope >= _LEAST_SLOPE and not (a.is_coarse and b.is_coarse)
    if not (whole or in_part) or abs(product) < _COUNTS * chance:
        return 0.0
    sigmas = abs(product) / max(chance, _chance_nearby(in_a, in_b))
    return -sigmas if in_part else sigmas


def _chance_nearby(in_a: np.ndarray, in_b: np.ndarray) -> float:
    """Return the root-mean-square product at other shifts: rounding repeats where motion does."""
    n = in_a.shape[1]
    shifts = np.arange(_OWN_WIDTH + 1, min(_NEARBY + 1, n // 2))
    if not shifts.size:
        return 0.0
    length = next_fast_len(n + _NEARBY, real=True)
    spectrum = np.fft.rfft(in_a, length) * np.conj(np.fft.rfft(in_b, length))
    products = np.fft.irfft(spectrum.sum(axis=0), length)[np.concatenate([shifts, -shifts])]
    return float(np.sqrt(np.mean(np.square(products))))
