"""What must be handed in and is not."""

from collections.abc import Collection

from pipeline.grading.rubric import RequiredRuns, Rubric, matching
from pipeline.names import first_few
from pipeline.schemas.grade import Flag
from pipeline.submission import Experiment, Submission

# Runs that serve as well: a ring-down after a step is a decay, a reduced table holds all dwells.
_SERVES = {"decay": ("decay", "step"), "sine": ("sine",), "step": ("step",)}


def asked_pieces(rubric: Rubric) -> list[str]:
    """Return the names of all pieces that a rubric asks for."""
    return list(_pieces(None, rubric))


def missing_pieces(
    submission: Submission, rubric: Rubric, *, unreadable: Collection[str]
) -> list[str]:
    """Return the names of the pieces that are not there; an unreadable experiment is none."""
    left = tuple(e for e in submission.experiments if e.id not in unreadable)
    submission = submission.model_copy(update={"experiments": left})
    return [name for name, there in _pieces(submission, rubric).items() if not there]


def missing_flag(missing: list[str]) -> Flag:
    """Return the flag for what is missing."""
    return Flag(
        code="missing",
        parameters=tuple(missing),
        message=f"not handed in: {first_few(missing, 6)}.",
        evidence={"missing": missing},
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
    """Return how a required run is called: "decay of cart 2", "12 sine"."""
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
