"""The input to the checks, and their results (verdicts)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

from pipeline.grading.grade import Flag
from pipeline.grading.judge.earned import ALL, Deviation
from pipeline.grading.mistakes.controller import Controller
from pipeline.grading.mistakes.explain import Label
from pipeline.grading.mistakes.state_model import MatrixEntry, StateMatrices, compare_entries
from pipeline.grading.references.reference import References
from pipeline.grading.rubric import RequiredRuns, Rubric, matching
from pipeline.results import Analysis
from pipeline.submission import Experiment, Reported, Submission
from pipeline.words.numbers import first_few


@dataclass(frozen=True, kw_only=True)
class Work:
    """Everything that a check may use.

    Attributes
    ----------
    references : the parameters from the recordings, with bounds.
    controller : the reported controller, with the models to simulate it on.
    state_models : acceptable values of [A B].
    bad : recordings with a problem, and the problem of each.
    named : for each table, the parameters whose errors a known mistake explains.
    """

    submission: Submission
    analysis: Analysis
    rubric: Rubric
    references: References
    controller: Controller | None
    state_models: Sequence[StateMatrices]
    bad: Mapping[str, str]
    named: Mapping[Label, frozenset[str]]

    @property
    def missing(self) -> list[str]:
        """The required items that are missing; an unreadable file counts as missing."""
        return missing_pieces(self.submission, self.rubric, unreadable=self.analysis.unreadable)

    @cached_property
    def entries(self) -> list[MatrixEntry]:
        """The reported entries of A and B with their acceptable values.

        Empty if A is not reported.
        """
        space = self.reported.state_space
        n = self.rubric.system.carts
        return compare_entries(space, models=self.state_models, n=n) if space and space.A else []

    @property
    def reported(self) -> Reported:
        """The reported numbers; empty if nothing is reported."""
        return self.submission.reported or Reported()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of a check: a share of the points and a message.

    Attributes
    ----------
    share : share of the points; None if nothing could be judged; `message` then says why.
    explained : whether a known mistake explains all lost points; its flag then replaces the
        rubric's advice.
    models : for each acceptable model, the errors of the numbers; the best model counts. Empty if
        the share does not depend on tolerances.
    most : the largest possible share, whatever the tolerances.
    agrees : for each number that is judged by itself, whether it earns all its points.
    """

    share: Fraction | None
    message: str
    expected: dict[str, Any] = field(default_factory=dict)
    found: dict[str, Any] = field(default_factory=dict)
    explained: bool = False
    models: tuple[tuple[Deviation, ...], ...] = ()
    most: Fraction = ALL
    agrees: Mapping[str, bool] = field(default_factory=dict)


# --------------------------------------------------------------------- required items

# Kinds of recording that meet a requirement for only some of the carts. A step also counts as a
# decay, because the carts ring down after it.
_SERVES = {"decay": ("decay", "step"), "sine": ("sine",), "step": ("step",)}


def asked_pieces(rubric: Rubric) -> list[str]:
    """Return the names of all items that a rubric requires, such as recordings and parameters."""
    return list(_pieces(None, rubric))


def missing_pieces(
    submission: Submission, rubric: Rubric, *, unreadable: Collection[str]
) -> list[str]:
    """Return the names of the required items that are missing.

    An experiment whose file cannot be read counts as missing.
    """
    left = tuple(e for e in submission.experiments if e.id not in unreadable)
    submission = submission.model_copy(update={"experiments": left})
    return [name for name, there in _pieces(submission, rubric).items() if not there]


def missing_flag(missing: list[str]) -> Flag:
    """Return the flag for missing items."""
    return Flag(
        code="missing",
        parameters=tuple(missing),
        message=f"missing: {first_few(missing, 6)}.",
        evidence={"missing": missing},
    )


def data_flag(bad: Mapping[str, str]) -> Flag:
    """Return the flag for recordings with a problem."""
    first, problem = next(iter(bad.items()))
    others = len(bad) - 1
    have = "run has" if others == 1 else "runs have"
    more = f" ({others} more {have} a problem)" if others else ""
    return Flag(
        code="data_problem",
        parameters=tuple(bad),
        message=f"{first}: {problem.rstrip('.')}{more}.",
        evidence={"problems": dict(bad)},
    )


def _pieces(submission: Submission | None, rubric: Rubric) -> dict[str, bool]:
    required = rubric.required
    pieces = {
        run_name(runs): submission is not None and _enough(submission, runs)
        for runs in required.experiments
    }
    reported = submission.reported if submission else None
    for label in ("initial", "final"):
        table = getattr(reported, label) if reported else {}
        for name in matching(getattr(required, label), rubric.names):
            pieces[f"{label}.{name}"] = name in table
    if required.state_space:
        space = reported.state_space if reported else None
        pieces["state_space.A"] = space is not None and bool(space.A)
        pieces["state_space.B"] = space is not None and bool(space.B)
    feedback = reported.feedback if reported else None
    for name in required.feedback:
        pieces[f"feedback.{name}"] = getattr(feedback, name, None) not in (None, ())
    return pieces


def run_name(runs: RequiredRuns) -> str:
    """Return the name of a required run, such as "decay of cart 2" or "12 sine"."""
    carts = f" of cart {', '.join(map(str, runs.carts))}" if runs.carts else ""
    return f"{runs.at_least} {runs.kind}{carts}" if runs.at_least > 1 else f"{runs.kind}{carts}"


def _enough(submission: Submission, runs: RequiredRuns) -> bool:
    everyone = tuple(range(1, submission.system.carts + 1))
    carts = tuple(sorted(runs.carts)) or everyone
    kinds = _SERVES.get(runs.kind, (runs.kind,)) if carts != everyone else (runs.kind,)

    def counts(experiment: Experiment) -> bool:
        return experiment.kind in kinds and (experiment.carts or everyone) == carts

    if runs.kind == "sine" and any(e.kind == "bode" for e in submission.experiments):
        return True
    return sum(map(counts, submission.experiments)) >= runs.at_least
