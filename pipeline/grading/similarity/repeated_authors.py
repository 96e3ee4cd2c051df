"""Find people who are authors of several submissions of a class.

Submissions that share an author count as one team and are not flagged as copies. So adding another
student's id could hide a copy. The TA is informed of such authors; no student is accused.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from pipeline.grading.gradings import Member, person
from pipeline.grading.similarity.copies import find_copies
from pipeline.words.numbers import count, listing
from pipeline.words.text import clean

_NAMED = 8  # submissions named for one person


@dataclass(frozen=True, kw_only=True)
class RepeatedAuthors:
    """People who are all authors of the same two or more submissions.

    Attributes
    ----------
    authors : ids of the people; each is "" if names are left out.
    recordings : the largest number of recordings that one of the submissions shares with the
        others.
    compared : whether all of the submissions have readable recordings.
    """

    authors: tuple[str, ...]
    submissions: tuple[str, ...]
    recordings: int = 0
    compared: bool = True

    def __str__(self) -> str:
        """Return the message for the TA."""
        named = [" ".join(clean(author).split()) for author in self.authors]
        several = len(named) > 1
        nameless = f"{len(named)} people" if several else "One person"
        who = listing(named) if all(named) else nameless
        are = "are" if several else "is"
        where = listing([clean(name) for name in self.submissions], most=_NAMED)
        if not (self.recordings or self.compared):
            return f"{who} {are} in {where}; their recordings could not be compared"
        common = count(self.recordings, "recording") if self.recordings else "no recording"
        return f"{who} {are} in {where}, and these share {common}"


def find_repeated_authors(authors: Mapping[str, Sequence[str]]) -> list[RepeatedAuthors]:
    """Return the people who are authors of several submissions."""
    typed: dict[str, str] = {}
    found: dict[str, dict[str, None]] = {}
    for submission, people in authors.items():
        for author in people:
            typed.setdefault(person(author), author)
            found.setdefault(person(author), {})[submission] = None
    together: dict[tuple[str, ...], list[str]] = {}
    for who, submissions in sorted(found.items()):
        if len(submissions) > 1:
            together.setdefault(tuple(submissions), []).append(typed[who])
    return [
        RepeatedAuthors(authors=tuple(people), submissions=submissions)
        for submissions, people in together.items()
    ]


def with_recordings(
    doubles: Iterable[RepeatedAuthors], prints: Iterable[Member]
) -> list[RepeatedAuthors]:
    """Return the doubles with the number of recordings that their submissions share.

    Recordings that were given out by the lab count too.
    """
    alone = [replace(one, authors=(one.submission,)) for one in prints]
    shared = find_copies(alone)
    read = {one.submission for one in alone if one.fingerprints}
    return [
        replace(
            double,
            recordings=max(
                len({r.experiment for r in shared.get(a, ()) if r.submission in double.submissions})
                for a in double.submissions
            ),
            compared=read.issuperset(double.submissions),
        )
        for double in doubles
    ]
