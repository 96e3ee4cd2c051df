"""Compare a run with the current class list: which submissions are missing, renamed or replaced?

A name alone does not identify a submission: students name their folders as they like, and cartlab
adds to a name that occurs twice. A submission is also recognised by its account number on the
learning platform, its files, its authors and their recordings.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from pipeline.grading.gradebook.gradebook import Gradebook
from pipeline.grading.gradings import Member
from pipeline.grading.platforms import Account, same_number
from pipeline.grading.similarity.copies import same_recordings


@dataclass(frozen=True, kw_only=True)
class ClassChanges:
    """Changes to the current class list.

    Attributes
    ----------
    kept : submissions on the class list that are not in this run, by name.
    moved : new name of each renamed submission, by old name.
    taken_over : for each name that now belongs to other people: the name, the authors before, and
        the authors now. Points given by hand do not pass to the new authors.
    """

    kept: Mapping[str, Member]
    moved: Mapping[str, str]
    taken_over: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...]


def find_class_changes(rows: Mapping[str, Member], book: Gradebook) -> ClassChanges:
    """Return how a run changes the current class list; `rows` are the run's submissions by name."""
    now = {name.casefold(): name for name in rows}
    left: dict[str, Member] = {}
    new, moved = dict(rows), {}
    lines = list(book.listed())
    for line in lines:
        name = now.get(line.submission.casefold())
        if name is None or _is_other_team(line, rows[name]):
            left[line.submission] = line
        else:
            del new[name]
            if name != line.submission:  # the names differ only in upper and lower case
                moved[line.submission] = name
    before = {
        one.submission: one for one in book.fingerprints([one.grading for one in left.values()])
    }
    moved |= _match_renamed(before, new)
    return ClassChanges(
        kept={n: r for n, r in before.items() if n not in moved and n.casefold() not in now},
        moved=moved,
        taken_over=tuple(
            (line.submission, line.authors, rows[name].authors)
            for line in lines
            if (name := moved.get(line.submission) or now.get(line.submission.casefold()))
            and _has_only_new_authors(line, rows[name])
        ),
    )


def _is_other_team(before: Member, now: Member) -> bool:
    """Return whether a submission now has another team; False if authors are unknown."""
    return _has_only_new_authors(before, now) and not same_number(before.owner, now.owner)


def _has_only_new_authors(before: Member, now: Member) -> bool:
    return bool(before.people and now.people) and before.people.isdisjoint(now.people)


def _match_renamed(before: Mapping[str, Member], now: Mapping[str, Member]) -> dict[str, str]:
    """Return the new name of each renamed submission.

    The pairs with the strongest evidence are matched first.
    """
    pairs = [
        (evidence, old, new)
        for old in before
        for new in now
        if any(evidence := _evidence(before[old], now[new]))
    ]
    moved: dict[str, str] = {}
    for _, old, new in sorted(pairs, key=lambda pair: ([not e for e in pair[0]], *pair[1:])):
        if old not in moved and new not in moved.values():
            moved[old] = new
    return moved


def _evidence(before: Member, now: Member) -> tuple[bool, ...]:
    """Return, for each kind of evidence, whether it shows that both submissions are the same.

    The strongest kind comes first. The result is empty if the teams differ.
    """
    if _is_other_team(before, now):
        return ()
    both = before.people & now.people
    names = [f"-{row.submission}" for row in (before, now)]
    # Several teams without author ids may submit the same files, such as those of `cartlab new`. So
    # equal files count only if the submissions have a common author or similar names.
    kin = both or any(a.endswith(b) for a, b in (names, names[::-1]))
    prints = before.fingerprints and now.fingerprints
    was, is_ = (Account.read(row.owner) for row in (before, now))
    return (
        same_number(before.owner, now.owner),
        bool(kin) and before.content == now.content != "",
        bool(both and prints) and same_recordings(before, now),
        # Equal author ids are weak evidence, because anybody can type another person's id. They do
        # not count if the account numbers on the same platform differ.
        bool(both)
        and before.people == now.people
        and (was.platform != is_.platform or was.number == is_.number),
    )
