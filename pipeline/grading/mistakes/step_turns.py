"""Turning points of a cart after a step, which a student may mistake for its settled level."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.arrays import Array
from pipeline.grading.reference import Reference
from pipeline.names import read_name
from pipeline.results import Analysis, Record, StepGain

_TURNS = 3  # the peak, the trough after it, and the second peak
_DIGITS = 2  # significant digits; edges whose sizes agree to so many digits count as equal

Edge = tuple[int, float]  # number of the edge in its recording, and its size


@dataclass(frozen=True, kw_only=True, eq=False)
class StepTurns:
    """The turning points of one cart, as displacement per unit of input.

    Attributes
    ----------
    by_edge : for each edge, and each recording that repeats it, the first three turning points.
    furthest : for each edge, the largest displacement in each recording. If two modes beat, it may
        come after the first turning point.
    """

    by_edge: dict[Edge, list[list[float]]]
    furthest: dict[Edge, list[float]]

    def mean_peak(self) -> Reference | None:
        """Return the mean first turning point over all edges; None without edges."""
        peaks = [one[0] for repeats in self.by_edge.values() for one in repeats]
        return _spread([float(np.mean(peaks))]) if peaks else None

    def turn(self, edge: Edge, number: int) -> Reference | None:
        """Return turning point `number` after an edge, as a range over the repeats.

        Returns None if this or an earlier turning point is missing or not positive.
        """
        repeats = [one for one in self.by_edge.get(edge, ()) if len(one) > number]
        if not repeats or min(min(one[: number + 1]) for one in repeats) <= 0:
            return None
        return _spread([one[number] for one in repeats])

    def peak(self, edge: Edge) -> Reference:
        """Return the peak after an edge: a range that covers the first and the largest peak."""
        return _spread([*(repeat[0] for repeat in self.by_edge[edge]), *self.furthest[edge]])


def step_turns(name: str, analysis: Analysis) -> StepTurns:
    """Return the turning points after steps, for the cart of a gain (`K` or `K_i`)."""
    cart = read_name(name).cart or 1
    records = {record.id: record for record in analysis.records}
    found: dict[Edge, list[list[float]]] = {}
    furthest: dict[Edge, list[float]] = {}
    for step in analysis.step_gains:
        if step.cart == cart:
            for edge, moved, turns in _turns(step, records[step.experiment]):
                if turns and turns[0] > 0:
                    found.setdefault(edge, []).append(turns)
                    furthest.setdefault(edge, []).append(float(moved.max()))
    return StepTurns(by_edge=found, furthest=furthest)


def _spread(values: Sequence[float]) -> Reference:
    return Reference(
        value=float(np.median(values)), low=min(values), high=max(values), std=0.0, source="step"
    )


def _turns(step: StepGain, record: Record) -> Iterator[tuple[Edge, Array, list[float]]]:
    """Yield each edge, the cart's displacement per unit of input, and its turning points."""
    y = record.position(step.cart)
    for number, edge in enumerate(step.edges):
        change = edge.u_after - edge.u_before
        inside = (record.t >= edge.t) & (record.t <= edge.window_after[1])
        moved = (y[inside] - edge.level_before) / change
        level = (edge.level_after - edge.level_before) / change
        turns, side, rest = [], 1.0, moved
        while rest.size and len(turns) < _TURNS:
            # A turning point is the farthest point before the cart crosses its settled level again.
            beyond = side * (rest - level) > 0
            first = int(np.argmax(beyond)) if beyond.any() else rest.size
            back = np.flatnonzero(~beyond[first:])
            last = first + int(back[0]) if back.size else rest.size
            if first == last:
                break
            stretch = rest[first:last]
            turns.append(float(stretch[np.argmax(side * stretch)]))
            rest, side = rest[last:], -side
        yield (number, float(f"{change:.{_DIGITS}g}")), moved, turns
