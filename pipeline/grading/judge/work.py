"""What the checks work on, and what each of them says."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

from pipeline.grading.judge.pieces import missing_pieces
from pipeline.grading.mistakes.controller import Controller
from pipeline.grading.mistakes.explain import Label
from pipeline.grading.mistakes.state_model import Entry, StateModel, compare_entries
from pipeline.grading.references.reference import References
from pipeline.grading.rubric import Rubric
from pipeline.results import Analysis
from pipeline.submission import Reported, Submission

ALL, NONE = Fraction(1), Fraction(0)  # shares of the points


@dataclass(frozen=True, kw_only=True)
class Work:
    """All that a check may look at.

    Attributes
    ----------
    state_models : what [A B] may rightly be.
    bad : runs that do not hold what they should, each with what is wrong.
    named : by table, the numbers that a known mistake explains.
    """

    submission: Submission
    analysis: Analysis
    rubric: Rubric
    references: References
    controller: Controller | None
    state_models: Sequence[StateModel]
    bad: Mapping[str, str]
    named: Mapping[Label, frozenset[str]]

    @property
    def missing(self) -> list[str]:
        """What must be handed in and is not; a file that cannot be read is not."""
        return missing_pieces(self.submission, self.rubric, unreadable=self.analysis.unreadable)

    @cached_property
    def entries(self) -> list[Entry]:
        """The entries of A and B beside what they may rightly be; none where they are not there."""
        space = self.reported.state_space
        n = self.rubric.system.carts
        return compare_entries(space, models=self.state_models, n=n) if space and space.A else []

    @property
    def reported(self) -> Reported:
        """What the students claim; empty where they claim nothing."""
        return self.submission.reported or Reported()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The share of the points; None where nothing could be judged, and `message` says why.

    `explained`: a known mistake is behind all that is lost, and its flag says more than advice.
    """

    share: Fraction | None
    message: str
    expected: dict[str, Any] = field(default_factory=dict)
    found: dict[str, Any] = field(default_factory=dict)
    explained: bool = False


def mean_share(shares: Sequence[Fraction]) -> Fraction:
    """Return the mean of some shares; at least one."""
    return sum(shares, NONE) / len(shares)
