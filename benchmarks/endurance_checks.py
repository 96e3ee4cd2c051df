"""Compare everything that was sent to a desk with the gradebook and the students' folders."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.endurance_people import Change, Journal, digest
from pipeline.errors import PipelineError
from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.submission import load_submission


@dataclass(kw_only=True)
class Found:
    """The changes that went wrong, with a sentence for each."""

    lost: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    spoilt: list[str] = field(default_factory=list)

    def count(self, change: Change, times: int) -> None:
        """Record an error if a change was lost, or was stored more than once."""
        if change.confirmed and times == 0:
            self.lost.append(_say(change))
        if times > 1:
            self.doubled.append(_say(change))


def _say(change: Change) -> str:
    return f"{change.kind} {change.where} by {change.by}: {change.token}"


def check_book(place: str, journal: Journal, *, teams: Sequence[str], found: Found) -> None:
    """Check that each confirmed change is stored once, and any other at most once."""
    with Gradebook(place) as book:
        given: dict[tuple[str, str, str], list[Any]] = defaultdict(list)
        for team, one in book.changes_since(0):
            given[team, one.criterion, one.text].append(one)
        listed = [one.submission for one in book.class_now().entries]
        if sorted(listed) != sorted(teams):
            found.lost.append(f"the class list has {len(listed)} of {len(teams)} teams")
        asked = {one.where[0] for one in journal.sent if one.kind in ("request", "answer")}
        events = {team: book.history(team)[1] for team in sorted(asked)}
    steps = Counter(
        (team, event.criterion, event.what, event.text)
        for team, history in events.items()
        for event in history
    )
    reopened = Counter(one.where for one in journal.sent if one.kind == "reopened")
    for where, sent in reopened.items():
        team, criterion = where
        there = steps[team, criterion, "reopened", ""]
        confirmed = sum(
            one.confirmed for one in journal.sent if one.kind == "reopened" and one.where == where
        )
        if not confirmed <= there <= sent:
            found.lost.append(
                f"reopened {where}: {confirmed} confirmed, {sent} sent, {there} there"
            )
    for change in journal.sent:
        team, criterion = change.where
        if change.kind == "points":
            found.count(change, len(given[team, criterion, change.token]))
        elif change.kind == "together":
            times = [len(given[one, criterion, change.token]) for one in change.teams]
            found.count(change, max(times))
            if len(set(times)) > 1:
                found.spoilt.append(f"{_say(change)}: only for some of its teams")
        elif change.kind == "request":
            found.count(change, steps[team, criterion, "asked", change.token])
        elif change.kind == "answer":
            told = steps[team, criterion, "answered", change.token]
            found.count(change, told)
            # An answer and its points must be stored together, or neither of them.
            if len(given[team, criterion, change.token]) > told:
                found.spoilt.append(f"{_say(change)}: its points without it")
        if change.kind in ("points", "together"):
            for one in given[team, criterion, change.token]:
                if one.points != change.points and one.what != "comment":
                    found.spoilt.append(f"{_say(change)}: {one.points} points")
    sent = {change.token for change in journal.sent}
    found.spoilt += [f"nobody sent {key}" for key in given if key[2] not in sent and given[key]]


def check_folders(
    folders: Mapping[tuple[str, str], Path], journal: Journal, *, found: Found
) -> None:
    """Check that each folder has the recordings and notes that its student sent to it."""
    mine: dict[tuple[str, str], list[Change]] = defaultdict(list)
    for change in journal.sent:
        if change.kind in ("upload", "row"):
            mine[change.by, change.where[0]].append(change)
    for whose, changes in mine.items():
        folder = folders[whose]
        try:
            experiments = load_submission(folder).experiments
        except PipelineError as error:
            found.spoilt.append(str(error))
            continue
        named = Counter(experiment.file for experiment in experiments)
        notes = {experiment.id: experiment.note for experiment in experiments}
        last: dict[str, list[Change]] = defaultdict(list)
        for change in changes:
            if change.kind == "row":
                last[change.where[1]].append(change)
                continue
            path = folder / "data" / change.where[1]
            found.count(change, int(path.exists()))
            if path.exists() and digest(path.read_bytes()) != change.token:
                found.spoilt.append(_say(change))
            if path.exists() and named[f"data/{change.where[1]}"] != 1:
                times = named[f"data/{change.where[1]}"]
                (found.doubled if times else found.lost).append(f"table of {path.name}, {times}×")
        for id_, saved in last.items():
            confirmed = [i for i, change in enumerate(saved) if change.confirmed]
            allowed = saved[confirmed[-1] if confirmed else 0 :]
            right = [change.token for change in allowed] + ([] if confirmed else [""])
            if notes.get(id_) not in right:
                found.lost.append(f"{_say(saved[-1])}: the file has {notes.get(id_)!r}")
