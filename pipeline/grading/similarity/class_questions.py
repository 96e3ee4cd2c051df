"""Questions to the TA about a class; they accuse no student and cost no points.

Some people are authors of several submissions. Submissions that share an author count as one team
and are not flagged as copies, so adding another student's id could hide a copy.

Some submissions have carts that differ from those of the class; their bench may have other springs.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.grading.grade import Grade
from pipeline.grading.gradings import Grading, person
from pipeline.grading.rubric import Rubric
from pipeline.grading.similarity.copies import find_copies
from pipeline.names import read_name
from pipeline.words.numbers import count, listing, significant, unit_text
from pipeline.words.text import clean

# ----------------------------------------------------------------- repeated authors


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
        where = listing([clean(name) for name in self.submissions], most=8)
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
    repeated: Iterable[RepeatedAuthors], members: Iterable[Grading]
) -> list[RepeatedAuthors]:
    """Return the people with the number of recordings that their submissions share.

    Recordings that were given out by the lab count too.
    """
    alone = [replace(one, authors=(one.submission,)) for one in members]
    shared = find_copies(alone)
    read = {one.submission for one in alone if one.fingerprints}
    return [
        replace(
            people,
            recordings=max(
                len({r.experiment for r in shared.get(a, ()) if r.submission in people.submissions})
                for a in people.submissions
            ),
            compared=read.issuperset(people.submissions),
        )
        for people in repeated
    ]


# ----------------------------------------------------- carts unlike those of the class

_FEWEST_TEAMS = 5  # from which a class has a median
_MOST_SPREADS = 10  # median absolute deviations from the median that are usual
_MOST_PART = 0.1  # relative distance from the median that is usual
_RARE = 0.25  # share of the class; if more teams are far off, the class has several benches
_MOST_NUMBERS = 3  # named for one submission

Quantity = tuple[str, str]  # name and unit of a static gain or a frequency


@dataclass(frozen=True, kw_only=True)
class Distant:
    """A submission whose carts lie far from the class median.

    Attributes
    ----------
    numbers : name, unit, value and class median of each such number, the most different first.
    """

    submission: str
    numbers: tuple[tuple[str, str, float, float], ...]

    def __str__(self) -> str:
        """Return the most different numbers in words."""
        told = [
            f"{name} is {significant(value, digits=3)} {unit_text(unit)}"
            f" (class median {significant(median, digits=3)})"
            for name, unit, value, median in self.numbers[:_MOST_NUMBERS]
        ]
        more = len(self.numbers) - _MOST_NUMBERS
        return ", ".join(told) + (f", and {more} more" if more > 0 else "")


def recomputed_numbers(grade: Grade, *, rubric: Rubric) -> dict[Quantity, float]:
    """Return the static gains and frequencies that the recordings of a submission give."""
    tables = {asked.id: asked.check for asked in rubric.criteria}
    found: dict[Quantity, float] = {}
    if grade.units is None:
        return found
    for wanted in ("initial", "final"):  # the final numbers are more precise
        for criterion in grade.criteria:
            if tables.get(criterion.id) == wanted:
                for name, value in criterion.expected.items():
                    if not read_name(name).is_damping:
                        found[name, read_name(name).unit(grade.units)] = abs(value)
    return found


def find_distant(class_: Mapping[str, Mapping[Quantity, float]]) -> list[Distant]:
    """Return the submissions whose carts lie far from the class median, in order.

    A number is left out if fewer than five teams have it, or if more than a quarter of them lie far
    from the median.

    Parameters
    ----------
    class_ : static gains and frequencies of each submission.
    """
    having: dict[Quantity, dict[str, float]] = defaultdict(dict)
    for submission, numbers in class_.items():
        for quantity, value in numbers.items():
            having[quantity][submission] = value
    found: dict[str, list[tuple[str, str, float, float]]] = defaultdict(list)
    for (name, unit), values in having.items():
        if len(values) < _FEWEST_TEAMS:
            continue
        every = np.array(list(values.values()))
        median = float(np.median(every))
        spread = float(np.median(np.abs(every - median)))
        usual = max(_MOST_SPREADS * spread, _MOST_PART * abs(median))
        far = {team: value for team, value in values.items() if abs(value - median) > usual}
        if len(far) <= _RARE * len(values):
            for team, value in far.items():
                found[team].append((name, unit, value, median))
    return [
        Distant(submission=team, numbers=tuple(sorted(numbers, key=_difference)))
        for team, numbers in sorted(found.items())
    ]


def _difference(number: tuple[str, str, float, float]) -> tuple[float, str]:
    name, _, value, median = number
    ratio = min(value, median) / max(value, median, 1e-300)
    return ratio, name
