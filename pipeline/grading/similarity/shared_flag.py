"""What submissions of a class share: the flag of one submission, and groups of submissions."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pipeline.grading.grade import Flag
from pipeline.grading.similarity.copies import SharedRecord
from pipeline.grading.similarity.tables import SharedTable
from pipeline.words.numbers import first_few, listing


def shared_flag(records: Sequence[SharedRecord], tables: Sequence[SharedTable] = ()) -> Flag:
    """Return the flag of one submission for its shared recordings and tables."""
    found = [*records, *tables]
    evidence = {
        "submissions": _submissions(map(asdict, found)),
        "recordings": [asdict(record) for record in records],
        "tables": [asdict(table) for table in tables],
    }
    what = [record.experiment for record in records] + [table.table for table in tables]
    return Flag(
        code="shared_data",
        parameters=tuple(dict.fromkeys(what)),
        message=shared_message(evidence),
        evidence=evidence,
    )


def shared_message(evidence: Mapping[str, Any], *, other: str = "") -> str:
    """Return the sentences about what other submissions contain too, with the best evidence.

    Parameters
    ----------
    evidence : evidence of a flag; an older gradebook has no tables and no times in it.
    other : words for every other submission; "" to name them.
    """
    recordings, tables = evidence["recordings"], evidence.get("tables", ())
    said = []
    if recordings:
        said.append(_recordings_message(recordings, other=other))
    if tables:
        said.append(_tables_message(tables, other=other))
    whose = (
        "whose recording it is; if it was" if recordings else "whose numbers they are; if they were"
    )
    return f"{' '.join(said)} This does not show {whose} shared for a reason, say so."


def _recordings_message(recordings: Sequence[Mapping[str, Any]], *, other: str) -> str:
    experiments = list(dict.fromkeys(one["experiment"] for one in recordings))
    are = "is" if len(experiments) == 1 else "are"
    best = max(
        recordings,
        key=lambda one: (one.get("equal_rows", 0), one.get("delay") is not None, one["sigmas"]),
    )
    when = " from {:g} s to {:g} s".format(*best["time"]) if "time" in best else ""
    rows = best.get("equal_rows", 0)
    if rows:
        same = f"{rows} consecutive rows are equal"
    elif best.get("delay") is not None:
        same = "the cart was released at the same instant, to a hundredth of a sample"
    else:
        same = "the noise is the same"
    others = other or ", ".join(_submissions(recordings))
    return (
        f"{first_few(experiments, 4)} {are} also in {others}: "
        f"{same},{when} in {best['experiment']}."
    )


def _tables_message(tables: Sequence[Mapping[str, Any]], *, other: str) -> str:
    """Return the sentence about shared tables, with the counts of the most similar submission."""
    names = list(dict.fromkeys(one["table"] for one in tables))
    by = {name: [t for t in tables if t["submission"] == name] for name in _submissions(tables)}
    equal, of = max(
        (sum(t["equal"] for t in own), sum(t["of"] for t in own)) for own in by.values()
    )
    report = "tables report" if len(names) > 1 else "table reports"
    others = other or ", ".join(by)
    agree = f"all {of} are equal" if equal == of else f"{equal} of {of} are equal"
    if all(one.get("one_program") for one in tables):
        agree += (
            ". Two teams that used one faulty program would report this too, because their "
            "recordings agree that closely"
        )
    return f"The {listing(names)} {report} the same numbers as {others}: {agree}."


def _submissions(found: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the other submissions, each once."""
    return list(dict.fromkeys(one["submission"] for one in found))


def student_message(flag: Flag) -> str:
    """Return the message of a flag as students see it, without the name of another submission."""
    if flag.code != "shared_data":
        return flag.message
    return shared_message(flag.evidence, other="another submission")


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

    def hidden(cluster: Cluster) -> Cluster:
        recordings = (
            tuple(sorted((names.get(name, other), id_) for name, id_ in recording))
            for recording in cluster.recordings
        )
        return Cluster(recordings=tuple(sorted(recordings)))

    return sorted(map(hidden, clusters), key=lambda cluster: cluster.recordings)


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
