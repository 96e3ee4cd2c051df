"""A submission of the class list as it stands now: its grading, and the fold of its events."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from pipeline.grading.grade import Grade
from pipeline.grading.gradebook.events import (
    POINTS,
    Event,
    Request,
    newest_points,
    requests_of,
    reviewer,
)
from pipeline.grading.gradebook.override import with_comments, with_overrides
from pipeline.grading.rubric import Rubric


@dataclass(frozen=True)
class Entry:
    """A line of the class list; what it says now follows from its grading and its events.

    Attributes
    ----------
    rubric : the rubric of the class list.
    graded : grade by the rubric alone, with the flag for shared data.
    authors : the current authors; events of other people do not count.
    events : everything that people did to the submission, oldest first.
    owner : account on the learning platform that submitted the files, or "".
    key : hash of everything that affects the grade.
    grading : number of the grading in the gradebook.
    first_key : key of the first version under this name; strangers cannot guess it.
    """

    submission: str
    rubric: Rubric
    graded: Grade
    authors: tuple[str, ...]
    events: tuple[Event, ...]
    owner: str
    key: str
    grading: int
    first_key: str

    @cached_property
    def grade(self) -> Grade:
        """The grade with points given by hand, and the deduction for lateness."""
        return with_overrides(
            with_comments(self.graded, self.comments),
            self.overrides,
            rubric=self.rubric,
            adjustments=self.adjustments,
        )

    @cached_property
    def automatic(self) -> Mapping[str, float]:
        """The automatic points, by criterion."""
        return {criterion.id: criterion.points for criterion in self.graded.criteria}

    @cached_property
    def given(self) -> Mapping[str, Event]:
        """The last change by hand of each criterion, and of the total under `TOTAL`."""
        return newest_points(self._theirs)

    @cached_property
    def overrides(self) -> Mapping[str, Event]:
        """The current points given by hand, by criterion."""
        last = self.given.items()
        return {id_: own for id_, own in last if own.what == "override" and own.points is not None}

    @cached_property
    def comments(self) -> Mapping[str, Event]:
        """The current comments, by criterion."""
        return {id_: own for id_, own in self.given.items() if own.what == "comment"}

    @cached_property
    def adjustments(self) -> tuple[Event, ...]:
        """All changes of the total, oldest first."""
        return tuple(event for event in self._theirs if event.what == "adjusted")

    @cached_property
    def requests(self) -> Mapping[str, Request]:
        """The requests for a review, by criterion."""
        return requests_of(self._theirs)

    @property
    def reviewed_by(self) -> str:
        """Name of the person who marked the grading as reviewed, or ""."""
        return reviewer(self.events, self.grading)

    def changes(self, criterion: str) -> list[Event]:
        """Return all changes by hand of a criterion, oldest first."""
        return [e for e in self._theirs if e.what in POINTS and e.criterion == criterion]

    def version(self, criterion: str) -> str:
        """Return the version of a criterion's points; a change must name the one it is based on."""
        newest = self.given.get(criterion)
        return f"{self.grading}.{newest.id if newest else 0}"

    @property
    def whole_version(self) -> str:
        """Version of all that is known of the submission.

        It changes with every event, and when recordings are found to be shared.
        """
        newest = max((event.id for event in self.events), default=0)
        is_shared = any(flag.code == "shared_data" for flag in self.graded.flags)
        return f"{self.grading}.{newest}.{int(is_shared)}"

    def request_version(self, criterion: str) -> str:
        """Return the version of a request, which an answer must name."""
        return f"{self.version(criterion)}.{self.requests[criterion].number}"

    def after(self, *events: Event) -> "Entry":
        """Return the entry as it would be after more events."""
        return replace(self, events=(*self.events, *events))

    @cached_property
    def _theirs(self) -> tuple[Event, ...]:
        return tuple(event for event in self.events if event.concerns(self.authors))
