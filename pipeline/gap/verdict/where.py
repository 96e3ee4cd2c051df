"""Find where a run departs from a model, what the cart does there, and what to record next."""

from collections.abc import Sequence

import numpy as np

from pipeline.arrays import Array
from pipeline.gap.data.runs import GapRun
from pipeline.gap.fit.levenberg_marquardt import GapFit
from pipeline.gap.fit.linearise import simulate_run
from pipeline.gap.search.hypothesis import Hypothesis
from pipeline.gap.types import GapWindow, Verdict
from pipeline.plant.catalogue import find_effect
from pipeline.words.phrases import phrases

# For each behaviour of the cart: the key of the sentence on the recording that shows more of it.
_SHOWS = {
    "velocity near zero": "show_rest",
    "fast motion": "show_motion",
    "large displacement, positive side": "show_displacement",
    "large displacement, negative side": "show_displacement",
    "after an edge of the input": "show_edges",
    "input on": "show_drive",
    "input off": "show_motion",
}


def find_windows(fit: GapFit, runs: Sequence[GapRun]) -> tuple[GapWindow, ...]:
    """Return the windows with most of the misfit, the worst first.

    The `share` of a window is relative to the squared misfit of its cart in its run.
    """
    found: list[tuple[float, GapWindow]] = []
    for run, nuisance in zip(runs, fit.nuisance, strict=True):
        model = simulate_run(fit, run, nuisance)
        for j, row in enumerate(run.rows):
            energy = ((run.y[j] - model[j]) / run.sigma[j]) ** 2
            total = float(energy.sum())
            width = max(4, int(0.15 * run.t.size))
            if total <= 0.0 or run.t.size <= width:
                continue
            inside = np.convolve(energy, np.ones(width), mode="valid")
            first = int(np.argmax(inside))
            window = GapWindow(
                experiment=run.id,
                cart=row + 1,
                start=float(run.t[first]),
                end=float(run.t[first + width - 1]),
                what=_what(run, model[j] - run.rest[row], energy),
                share=float(inside[first] / total),
            )
            found.append((float(inside[first]), window))
    found.sort(key=lambda pair: -pair[0])
    return tuple(window for _, window in found[:8])


def _what(run: GapRun, x: Array, energy: Array) -> str:
    """Return in words what the cart does where the misfit is larger than chance allows."""
    v = np.gradient(x, run.t)
    u = np.interp(run.t, run.knots, run.command)
    edges = np.flatnonzero(np.abs(np.diff(u)) > 0.2 * max(1e-12, float(np.ptp(u))))
    since = np.full(run.t.size, np.inf)
    for edge in edges:
        late = run.t - run.t[edge]
        since = np.where((late >= 0) & (late < since), late, since)
    speed, reach = float(np.abs(v).max()), float(np.abs(x).max())
    masks = {
        "velocity near zero": np.abs(v) < 0.1 * speed,
        "fast motion": np.abs(v) > 0.6 * speed,
        "large displacement, positive side": x > 0.6 * reach,
        "large displacement, negative side": x < -0.6 * reach,
        "after an edge of the input": since < 0.3,
        "input on": np.abs(u) > 0.05 * max(1e-12, float(np.abs(u).max())),
        "input off": np.abs(u) <= 0.05 * max(1e-12, float(np.abs(u).max())),
    }
    if not np.any(u) or np.count_nonzero(np.diff(u)) > 0.3 * u.size:
        del masks["input on"], masks["input off"]
    if not edges.size or edges.size > 6:
        del masks["after an edge of the input"]
    total = float(energy.sum())
    best, score = "throughout", 1.3  # a third above chance is worth mentioning
    for what, mask in masks.items():
        if 0.02 < mask.mean() < 0.98:
            excess = float(energy[mask].sum()) / total / float(mask.mean())
            if excess > score:
                best, score = what, excess
    return best


def choose_experiment(
    verdict: Verdict,
    chosen: Hypothesis,
    close: Sequence[Hypothesis],
    left: Sequence[GapWindow],
    *,
    repeated: bool,
) -> str:
    """Return advice on the next recording, for example how to decide between two effects.

    `left` are the windows in which the chosen model fits badly, the worst first. `repeated` is
    true if some runs have the same input, so that their scatter is known.
    """
    if verdict == "ambiguous":
        texts = {find_effect(key).deciding_run for key, _ in chosen.key ^ close[0].key}
        return " ".join(sorted(texts))
    if verdict == "named":
        return chosen.fit.structure.effects[-1].effect.deciding_run
    if verdict == "none":
        return ""
    words = phrases("gap")
    shows = words.text(next((_SHOWS[w.what] for w in left if w.what in _SHOWS), "show_motion"))
    return shows if repeated else f"{words.text('repeat_runs')} {shows}"
