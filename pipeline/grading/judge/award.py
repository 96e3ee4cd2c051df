"""Turn verdicts into points: apply required criteria, costs of flags, and the rubric's rounding."""

from collections.abc import Mapping, Sequence
from fractions import Fraction

from pipeline.grading import rubric as asked
from pipeline.grading.grade import Criterion, Flag, Outcome
from pipeline.grading.judge.context import Judgement, Verdict
from pipeline.grading.judge.costs import apply_flag_cost, assign, unnamed
from pipeline.grading.rubric import Rubric
from pipeline.grading.tolerance import exact, to_step


def award(
    criteria: Sequence[asked.Criterion],
    judgements: Mapping[str, Judgement],
    flags: Sequence[Flag],
    *,
    rubric: Rubric,
) -> tuple[Criterion, ...]:
    """Return the result of each criterion of a rubric, given the judgements and flags.

    A criterion that others require counts as passed if only mistakes that can be undone keep it
    from earning points. So such a mistake costs nothing in the criteria that require it.
    """
    ready: dict[str, Criterion] = {}
    judged: dict[str, Judgement] = {}
    for wanted in criteria:
        waits_for = (ready[p] for p in wanted.requires if p in ready)
        failed = next((p for p in waits_for if p.outcome in ("fail", "skip")), None)
        one = Judgement.plain(_waiting(failed)) if failed else judgements[wanted.id]
        judged[wanted.id] = one
        verdict = apply_flag_cost(one, unnamed(one, wanted), wanted, flags, rubric=rubric)
        ready[wanted.id] = _result(wanted, verdict, rubric)
    charges = assign(criteria, judged, flags, rubric=rubric)
    return tuple(
        _result(
            one, apply_flag_cost(judged[one.id], charges[one.id], one, flags, rubric=rubric), rubric
        )
        for one in criteria
    )


def _result(wanted: asked.Criterion, verdict: Verdict, rubric: Rubric) -> Criterion:
    points = to_step((verdict.share or 0) * exact(wanted.points), rubric.step)
    if wanted.check == "required" and verdict.share != 1:  # rounding never hides what is missing
        points = max(Fraction(0), min(points, exact(wanted.points) - exact(rubric.step)))
    outcome = _outcome(verdict.share, points, out_of=exact(wanted.points))
    advised = outcome in ("partial", "fail") and not verdict.explained
    more = f" {wanted.message}" if wanted.message and advised else ""
    return Criterion(
        id=wanted.id,
        title=wanted.title,
        outcome=outcome,
        points=float(points),
        out_of=wanted.points,
        message=verdict.message + more,
        expected=verdict.expected,
        found=verdict.found,
    )


def _waiting(parent: Criterion) -> Verdict:
    how = "not passed" if parent.outcome == "fail" else "skipped"
    on = f"{parent.id!r} ({parent.title or parent.id})"
    return Verdict(share=None, message=f"Not checked: it depends on {on}, which was {how}.")


def _outcome(share: Fraction | None, points: Fraction, *, out_of: Fraction) -> Outcome:
    """Return the outcome of the rounded points; `skip` if nothing was judged."""
    if share is None:
        return "skip"
    return "pass" if points == out_of else "fail" if points == 0 else "partial"
