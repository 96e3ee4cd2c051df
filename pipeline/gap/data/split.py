"""Which runs teach and which judge."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from pipeline.gap.data.runs import Run

_SAME_SIZE = 0.06  # relative; sizes closer than this are repeats


def without_twins(runs: Sequence[Run]) -> list[Run]:
    """Return the runs without those whose samples are those of an earlier one."""
    kept: list[Run] = []
    for run in runs:
        if not any(k.y.shape == run.y.shape and np.array_equal(k.y, run.y) for k in kept):
            kept.append(run)
    return kept


def split(runs: Sequence[Run]) -> tuple[list[int], list[int]]:
    """Return the indices of training and held-out runs.

    Whole runs are held out. Of repeats one goes to each side; of three sizes of a kind the middle
    one is held out, so that both extremes teach; of two free decays one. Every kind keeps one
    run in training. Nothing is held out of a single run: cut it in time instead.
    """
    groups: dict[tuple, list[int]] = defaultdict(list)
    for index, run in enumerate(runs):
        groups[run.record.kind, run.free].append(index)
    held: list[int] = []
    pairs: list[list[int]] = []  # groups of two different runs, a last resort
    for (kind, _), members in groups.items():
        sizes = {i: _size(runs[i]) for i in members}
        clusters: list[list[int]] = []
        for i in sorted(members, key=lambda i: sizes[i]):
            if clusters and abs(sizes[i] - sizes[clusters[-1][0]]) <= _SAME_SIZE * abs(sizes[i]):
                clusters[-1].append(i)
            else:
                clusters.append([i])
        for cluster in clusters:
            held += cluster[1::2]
        sizes_apart = [cluster[0] for cluster in clusters]
        if len(sizes_apart) >= 3:
            # In order of signed size: the extremes of both signs teach.
            held.append(sizes_apart[len(sizes_apart) // 2])
        elif len(sizes_apart) == 2 and kind == "decay" and len(members) == 2:
            held.append(min(sizes_apart, key=lambda i: abs(sizes[i])))
        elif len(sizes_apart) == 2:
            pairs.append(sizes_apart)
    if not held:
        held = [min(pair, key=lambda i: abs(_size(runs[i]))) for pair in pairs[:1]]
    return [i for i in range(len(runs)) if i not in held], sorted(held)


def _size(run: Run) -> float:
    """How hard a run was driven: its extreme input, or where a free decay starts."""
    if np.any(run.command):
        return float(run.command[np.argmax(np.abs(run.command))])
    offset = run.start - run.zero
    return float(offset[np.argmax(np.abs(offset))])
