"""Choose the records to use, cut them into runs, and hold some of the runs out."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.errors import DataError
from pipeline.estimation.interventions import between
from pipeline.gap.data.runs import GapRun, make_run
from pipeline.results import Intervention, LeftOut, Record
from pipeline.words.numbers import group_messages
from pipeline.words.phrases import phrases

_MOST_DWELLS = 4  # sine dwells to use; further ones add little but their frequency
_LEAST_MOTION = 8.0  # encoder steps; a smaller motion is not used
_FEWEST, _SHORTEST = 50, 0.5  # samples, s


def drop_left_out(
    records: Sequence[Record], *, left_out: Sequence[LeftOut]
) -> tuple[list[Record], list[str]]:
    """Return the records that the identification used, and notes on those that it left out.

    Raises
    ------
    DataError : every record is left out.
    """
    out = {one.experiment for one in left_out}
    kept = [record for record in records if record.id not in out]
    reasons = group_messages((one.experiment, one.reason) for one in left_out)
    notes = [phrases("gap").text("note_left_out", reason=reason) for reason in reasons]
    if records and not kept:
        raise DataError(f"gap: every recording is left out; {'; '.join(notes)}")
    return kept, notes


def prepare(
    records: Sequence[Record],
    *,
    springs: tuple[bool, ...],
    interventions: Sequence[Intervention] = (),
    notes: list[str],
) -> list[GapRun]:
    """Return the runs worth fitting; append a note on each record that is left out.

    The part of a record after an intervention is a separate run.

    Raises
    ------
    DataError : there is no record in which a free cart moves.
    """
    n, words = len(springs) - 1, phrases("gap")
    timed = [r for r in records if r.kind != "bode"]
    usable = [r for r in timed if _is_usable(r)]
    if len(usable) < len(timed):
        unusable = ", ".join(r.id for r in timed if r not in usable)
        notes.append(words.text("note_unusable", runs=unusable))
    if not usable:
        raise DataError(
            "gap: needs a record of half a second or more in which a free cart moves, found none"
        )
    open_loop = [r for r in usable if r.kind != "closed_loop"]
    if open_loop and len(open_loop) < len(usable):
        notes.append(words.text("note_feedback"))
        usable = open_loop
    usable = _with_still_carts_held(usable, notes=notes)
    dwells = [r for r in usable if r.kind == "sine"]
    if len(dwells) > _MOST_DWELLS:
        dwells.sort(key=lambda r: r.omega or 0.0)
        picked = {round(i) for i in np.linspace(0, len(dwells) - 1, _MOST_DWELLS)}
        left_out = {r.id for i, r in enumerate(dwells) if i not in picked}
        usable = [r for r in usable if r.id not in left_out]
        notes.append(words.text("note_dwells", all=len(dwells), used=_MOST_DWELLS))
    runs = [run for record in usable for run in _free_runs(record, interventions, n=n)]
    if not runs:
        raise DataError("gap: no record shows half a second of motion without a hand in it")
    if not any(np.any(run.command) for run in runs):
        notes.append(words.text("note_no_input"))
    kept = without_twins(runs)
    if len(kept) < len(runs):
        notes.append(words.text("note_duplicates", count=len(runs) - len(kept)))
    if not any(springs):
        notes.append(words.text("note_no_springs"))
        kept = [_on_no_spring(run) for run in kept]
    return kept


def _free_runs(record: Record, interventions: Sequence[Intervention], *, n: int) -> list[GapRun]:
    """Return the parts of a record between interventions that show motion, each as a run."""
    runs = []
    for piece in between(record, interventions):
        if _is_usable(piece):
            later = piece.t[0] > record.t[0]
            if later:
                let_go = piece.u is None or not np.any(piece.u)
                piece = replace(piece, kind="decay" if let_go else "sweep")
            run = make_run(piece, n=n, in_motion=later)
            # A cart that rests until a hand moves it shows nothing.
            if piece.kind != "decay" or _last_away(run):
                runs.append(run)
    return runs


def _on_no_spring(run: GapRun) -> GapRun:
    """Return a run for a bench without springs: its readings are absolute, and its start is known.

    Without springs there is no rest that defines a zero, and a start has a lasting effect. If the
    start were free, it would absorb missing effects.
    """
    # The zero counts as known to a thousandth of the noise.
    known = np.full(run.zero.size, 1e-3 * float(run.sigma.min()))
    return replace(run, start_known=True, zero=np.zeros(run.zero.size), zero_std=known)


def _is_usable(record: Record) -> bool:
    """Return whether a free cart moves, for long enough, under forces that are known."""
    if not record.free or record.t.size < _FEWEST or record.t[-1] - record.t[0] < _SHORTEST:
        return False
    # Without a recorded input, only a release or a run with cart 1 held is usable.
    known = record.u is not None or record.kind == "decay" or 1 not in record.free
    return known and _moves(record)


def _moves(record: Record) -> bool:
    moving = (c for c in record.carts if c in record.free)
    return any(_span(record, c) > _LEAST_MOTION * record.encoder_step(c) for c in moving)


def _span(record: Record, cart: int) -> float:
    return float(np.ptp(record.position(cart)))


def _with_still_carts_held(records: list[Record], *, notes: list[str]) -> list[Record]:
    """Return the records in which carts that never move are marked as held."""
    seen = [(r, cart) for r in records for cart in r.free if cart in r.carts]
    # A cart whose readings stay within three encoder steps is at rest.
    moving = {cart for r, cart in seen if _span(r, cart) > 3.0 * r.encoder_step(cart)}
    still = {cart for _, cart in seen} - moving
    if not still:
        return records
    carts = " and ".join(f"cart {cart}" for cart in sorted(still))
    notes.append(phrases("gap").text("note_held", carts=carts))
    return [replace(r, free=tuple(c for c in r.free if c not in still)) for r in records]


def split_holdout(runs: list[GapRun], *, notes: list[str]) -> tuple[list[GapRun], list[GapRun]]:
    """Return training and held-out runs; if no run can be spared, cut the longest one in two."""
    teach, judge_by = split(runs)
    if judge_by:
        return [runs[i] for i in teach], [runs[i] for i in judge_by]
    notes.append(phrases("gap").text("note_cut"))
    longest = max(range(len(runs)), key=lambda i: runs[i].t[-1] - runs[i].t[0])
    run = runs[longest]
    cut = int((1.0 - 0.4) * _last_motion(run))  # the last 40 % of the motion is held out
    pieces = []
    for piece in (slice(0, cut), slice(cut, None)):
        record = replace(
            run.record,
            # No hand acts in the later piece of a decay.
            kind=run.record.kind if piece.start == 0 and run.record.kind != "decay" else "sweep",
            t=run.t[piece],
            u=None if run.record.u is None else run.record.u[-run.t.size :][piece],
            y=np.array([run.record.y[j][-run.t.size :][piece] for j in range(len(run.record.y))]),
            reference=None,
        )
        starts = piece.start == 0 and run.record.kind != "decay"
        part = make_run(record, n=run.zero.size, in_motion=not starts)
        pieces.append(
            replace(
                part,
                guided=run.guided[:, piece],
                zero=run.zero,
                zero_std=run.zero_std,
                rest=run.rest,
                start_known=run.start_known,
            )
        )
    others = [r for i, r in enumerate(runs) if i != longest]
    return [*others, pieces[0]], [pieces[1]]


def _last_motion(run: GapRun) -> int:
    """Return the number of samples up to the last motion, but at least half of the run."""
    return max(_last_away(run) or run.t.size, run.t.size // 2)


def _last_away(run: GapRun) -> int:
    """Return the number of samples until all carts reach their final position; 0 without motion."""
    step = run.sigma * np.sqrt(12.0)
    away = np.abs(run.y - run.y[:, -1:]) > _LEAST_MOTION * step[:, None]
    return int(np.flatnonzero(away.any(axis=0))[-1]) + 1 if away.any() else 0


def without_twins(runs: Sequence[GapRun]) -> list[GapRun]:
    """Return the runs without exact copies of earlier runs."""
    kept: list[GapRun] = []
    for run in runs:
        if not any(k.y.shape == run.y.shape and np.array_equal(k.y, run.y) for k in kept):
            kept.append(run)
    return kept


def split(runs: Sequence[GapRun]) -> tuple[list[int], list[int]]:
    """Return the indices of training and held-out runs.

    Whole runs are held out, by these rules:

    - Every second repeat is held out.
    - Of three or more sizes of a kind, the middle one is held out, so the extremes are trained on.
    - Of two free decays, the smaller one is held out.
    - At least one run of each kind is trained on.
    - If nothing is held out so far, the smaller of two runs of a kind is, unless both are sweeps.
    - If still nothing is held out, the caller cuts a run in two.
    """
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, run in enumerate(runs):
        groups[run.record.kind, run.free].append(index)
    held: list[int] = []
    pairs: list[list[int]] = []  # two different runs each, held out only as a last resort
    for (kind, _), members in groups.items():
        sizes = {i: _size(runs[i]) for i in members}
        clusters: list[list[int]] = []
        for i in sorted(members, key=lambda i: sizes[i]):
            # Runs whose sizes differ by at most 6 % are repeats.
            if clusters and abs(sizes[i] - sizes[clusters[-1][0]]) <= 0.06 * abs(sizes[i]):
                clusters[-1].append(i)
            else:
                clusters.append([i])
        for cluster in clusters:
            held += cluster[1::2]
        sizes_apart = [cluster[0] for cluster in clusters]
        if len(sizes_apart) >= 3:
            # The order is by signed size, so the extremes of both signs are used for training.
            held.append(sizes_apart[len(sizes_apart) // 2])
        elif len(sizes_apart) == 2 and kind == "decay" and len(members) == 2:
            held.append(min(sizes_apart, key=lambda i: abs(sizes[i])))
        elif len(sizes_apart) == 2:
            pairs.append(sizes_apart)
    # Each of two sweeps may cover what the other lacks, so both are used for training.
    if not held and any(runs[i].record.kind != "sweep" for pair in pairs for i in pair):
        held = [min(pair, key=lambda i: abs(_size(runs[i]))) for pair in pairs[:1]]
    return [i for i in range(len(runs)) if i not in held], sorted(held)


def _size(run: GapRun) -> float:
    """Return how hard a run was driven: its extreme input, or the start of a free decay.

    Under feedback it is the range of the reference, because the reference determines the input.
    """
    if run.record.reference is not None and np.ptp(run.record.reference) > 0.0:
        return float(np.ptp(run.record.reference))
    if np.any(run.command):
        return float(run.command[np.argmax(np.abs(run.command))])
    offset = run.start - run.zero
    return float(offset[np.argmax(np.abs(offset))])
