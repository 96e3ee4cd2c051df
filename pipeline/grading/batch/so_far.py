"""The class list so far beside a run: who stays on it, and who goes on under another name.

A folder's name is whoever's who packs it, and two that are called alike both get longer ones. So a
submission is known by more than its name: the number that a platform has for who handed it in,
its files, its people and their recordings.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

from pipeline.grading.gradebook.book import Gradebook
from pipeline.grading.gradings import Grading, Listed, Prints, content, person
from pipeline.grading.intake.lms_names import read_owner, same_number
from pipeline.grading.similarity.shared import same_recordings


@dataclass(frozen=True, kw_only=True)
class Row:
    """What a batch itself needs of an outcome: all else stays in the book."""

    key: str
    prints: Prints
    reason: str = ""

    @classmethod
    def of(cls, outcome: Grading) -> "Row":
        """Return the row of an outcome."""
        return cls(
            key=outcome.key,
            prints=Prints(
                submission=outcome.submission,
                authors=outcome.authors,
                fingerprints=outcome.fingerprints,
                owner=outcome.owner,
            ),
            reason=outcome.reason if outcome.status == "failed" else "",
        )

    @cached_property
    def people(self) -> set[str]:
        """The authors, however they typed their ids."""
        return set(map(person, self.prints.authors))


@dataclass(frozen=True, kw_only=True)
class SoFar:
    """What became of the class list so far.

    Attributes
    ----------
    kept : lines that the run says nothing of.
    moved : the new name of each submission that goes on under another.
    taken_over : (submission, authors before, authors now) where those are others, who have not
        what was given by hand.
    """

    kept: Mapping[str, Row]
    moved: Mapping[str, str]
    taken_over: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]


def class_so_far(rows: Mapping[str, Row], book: Gradebook) -> SoFar:
    """Return what the run with these rows makes of the class list so far."""
    now = {name.casefold(): name for name in rows}
    left: dict[str, Listed] = {}
    new, moved = dict(rows), {}
    lines = list(book.listed())
    for line in lines:
        name = now.get(line.submission.casefold())
        if name is None or _others(_row(line), rows[name]):
            left[line.submission] = line
        else:
            del new[name]
            if name != line.submission:  # in capitals, say
                moved[line.submission] = name
    prints = book.prints_of([line.grading for line in left.values()])
    before = {one.submission: _row(left[one.submission], one.fingerprints) for one in prints}
    moved |= _matched(before, new)
    return SoFar(
        kept={n: r for n, r in before.items() if n not in moved and n.casefold() not in now},
        moved=moved,
        taken_over=tuple(
            (line.submission, line.authors, rows[name].prints.authors)
            for line in lines
            if (name := moved.get(line.submission) or now.get(line.submission.casefold()))
            and _strangers(_row(line), rows[name])
        ),
    )


def _row(line: Listed, fingerprints: bytes = b"") -> Row:
    prints = Prints(
        submission=line.submission,
        authors=line.authors,
        fingerprints=fingerprints,
        owner=line.owner,
    )
    return Row(key=line.key, prints=prints)


def _others(before: Row, now: Row) -> bool:
    """Tell whether a submission is another team's now; who is not named is nobody else."""
    return _strangers(before, now) and not same_number(before.prints.owner, now.prints.owner)


def _strangers(before: Row, now: Row) -> bool:
    return bool(before.people and now.people) and before.people.isdisjoint(now.people)


def _matched(before: Mapping[str, Row], now: Mapping[str, Row]) -> dict[str, str]:
    """Return which submission goes on as which: those first that have the most in common."""
    pairs = [
        (evidence, old, new)
        for old in before
        for new in now
        if any(evidence := _in_common(before[old], now[new]))
    ]
    moved: dict[str, str] = {}
    for _, old, new in sorted(pairs, key=lambda pair: ([not e for e in pair[0]], *pair[1:])):
        if old not in moved and new not in moved.values():
            moved[old] = new
    return moved


def _in_common(before: Row, now: Row) -> tuple[bool, ...]:
    """Return what says that two are one submission, the strongest first."""
    if _others(before, now):
        return ()
    both = before.people & now.people
    names = [f"-{row.prints.submission}" for row in (before, now)]
    # Of those who are not named many may hand in the same: nothing, or what cartlab new wrote.
    kin = both or any(a.endswith(b) for a, b in (names, names[::-1]))
    prints = before.prints.fingerprints and now.prints.fingerprints
    (_, was, number), (_, is_, number_now) = (read_owner(r.prints.owner) for r in (before, now))
    return (
        same_number(before.prints.owner, now.prints.owner),
        bool(kin) and content(before.key) == content(now.key) != "",
        bool(both and prints) and same_recordings(before.prints, now.prints),
        # Anybody can write other people's ids into a file, but not under their number.
        bool(both) and before.people == now.people and (was != is_ or number == number_now),
    )
