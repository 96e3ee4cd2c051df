"""Group the submissions of a class that share recordings or tables of numbers."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipeline.grading.grade import Flag


@dataclass(frozen=True, kw_only=True)
class Cluster:
    """Submissions that are connected by shared recordings or tables.

    Attributes
    ----------
    recordings : each shared recording or table, as a list of (submission, experiment or table).
    """

    recordings: tuple[tuple[tuple[str, str], ...], ...]

    @property
    def submissions(self) -> tuple[str, ...]:
        """The submissions of the cluster."""
        return tuple(sorted({name for recording in self.recordings for name, _ in recording}))

    def by_submissions(self) -> dict[tuple[str, ...], list[str]]:
        """Return what is shared in words, by the submissions that contain them."""
        found: dict[tuple[str, ...], list[str]] = defaultdict(list)
        for recording in self.recordings:
            (_, first), *_ = recording
            others = [f"{id_} in {name}" for name, id_ in recording if id_ != first]
            text = f"{first} ({', '.join(others)})" if others else first
            found[tuple(dict.fromkeys(name for name, _ in recording))].append(text)
        return dict(found)


def find_clusters(flags: Mapping[str, Flag]) -> list[Cluster]:
    """Return the clusters of a class.

    Parameters
    ----------
    flags : flag for shared data of each submission.
    """
    pairs = [
        ((name, mine["experiment"]), (mine["submission"], mine["other_experiment"]))
        for name, flag in flags.items()
        for mine in flag.evidence["recordings"]
    ]
    pairs += [
        ((name, f"reported.{mine['table']}"), (mine["submission"], f"reported.{mine['table']}"))
        for name, flag in flags.items()
        for mine in flag.evidence.get("tables", ())
    ]
    recordings: dict[str, list[tuple[tuple[str, str], ...]]] = defaultdict(list)
    for recording in _joined(pairs):
        recordings[recording[0][0]].append(recording)
    teams = _joined([(a, b) for (a, _), (b, _) in pairs])
    return [
        Cluster(recordings=tuple(sorted(r for name in team for r in recordings[name])))
        for team in teams
    ]


def renamed(clusters: Iterable[Cluster], names: Mapping[str, str], *, other: str) -> list[Cluster]:
    """Return clusters with other names for submissions.

    Parameters
    ----------
    other : the new name of submissions that are not in `names`.
    """
    return sorted(
        (
            Cluster(
                recordings=tuple(
                    sorted(
                        tuple(sorted((names.get(name, other), id_) for name, id_ in recording))
                        for recording in cluster.recordings
                    )
                )
            )
            for cluster in clusters
        ),
        key=lambda cluster: cluster.recordings,
    )


def _joined(pairs: Sequence[tuple[Any, Any]]) -> list[tuple[Any, ...]]:
    """Join pairs that have an element in common into sorted groups."""
    if not pairs:
        return []
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    nodes = sorted({node for pair in pairs for node in pair})
    at = {node: i for i, node in enumerate(nodes)}
    ends = np.array([(at[a], at[b]) for a, b in pairs], dtype=int).reshape(-1, 2).T
    joined = coo_array((np.ones(len(pairs)), (ends[0], ends[1])), shape=(len(nodes), len(nodes)))
    groups: dict[int, list[Any]] = defaultdict(list)
    for node, group in zip(nodes, connected_components(joined, directed=False)[1], strict=True):
        groups[int(group)].append(node)
    return sorted(map(tuple, groups.values()))
