"""Compute points under a changed rubric from stored errors, without reading recordings.

The gradebook stores the error of each number as an exact fraction. The usual code computes points
from these errors with the new tolerances, costs of flags, late deduction and rounding. If a change
to the rubric alters the errors, recordings must be graded again; `needs_recordings` finds such
changes.
"""

import json
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from pipeline.grading import rubric as asked
from pipeline.grading.grade import Grade
from pipeline.grading.judge.award import award
from pipeline.grading.judge.context import Judgement, Verdict
from pipeline.grading.mistakes.undo import Slip
from pipeline.grading.rubric import Rubric
from pipeline.grading.tolerance import Deviation, points_for, with_total

# Keys of a rubric that change the errors themselves. If one changes, the recordings must be graded
# again.
_OF_RUBRIC = ("system", "design", "required", "examples")
_OF_CRITERION = (
    "check", "experiments", "parameters", "sigmas", "frequency_percent", "damping_percent",
)  # fmt: skip


def findings_text(judgements: Mapping[str, Judgement]) -> str:
    """Return the judgements of all criteria as JSON, without messages.

    The same judgements give the same bytes.
    """
    plain = {}
    for id_, one in judgements.items():
        plain[id_] = _plain(one.typed)
        if one.only:
            only = [[slip.code, slip.number, _plain(alone)] for slip, alone in one.only.items()]
            plain[id_] |= {"undone": _plain(one.undone), "only": only}
    return json.dumps(plain, separators=(",", ":"))


def _plain(verdict: Verdict) -> dict[str, Any]:
    return {
        "share": None if verdict.share is None else str(verdict.share),
        "most": str(verdict.most),
        "models": [[(str(d.error), d.by) for d in model] for model in verdict.models],
    }


def read_findings(text: str) -> dict[str, Judgement]:
    """Return the judgements in a text from `findings_text`; their messages are empty."""
    return {
        id_: Judgement(
            typed=_verdict(plain),
            undone=_verdict(plain.get("undone", plain)),
            only={
                Slip(code=code, number=number): _verdict(alone)
                for code, number, alone in plain.get("only", ())
            },
        )
        for id_, plain in json.loads(text).items()
    }


def _verdict(plain: Mapping[str, Any]) -> Verdict:
    return Verdict(
        share=None if plain["share"] is None else Fraction(plain["share"]),
        message="",
        most=Fraction(plain["most"]),
        models=tuple(
            tuple(Deviation(error=Fraction(error), by=by) for error, by in model)
            for model in plain["models"]
        ),
    )


def recompute_points(grade: Grade, findings: Mapping[str, Judgement], *, rubric: Rubric) -> Grade:
    """Return the grade that another rubric gives; points given by hand are not included.

    Outcomes and points are the same as if the recordings were graded again, but messages are empty.
    Criteria without stored judgements are left out.
    """
    if grade.status == "failed":
        nothing = {"out_of": rubric.out_of, "points": 0.0, "deducted": 0.0, "overrides": ()}
        empty = {"criteria": (), "adjustments": (), "open": ()}
        return grade.model_copy(update={**nothing, **empty})
    judged = [wanted for wanted in rubric.criteria if wanted.id in findings]
    judgements = {wanted.id: _weighed(wanted, findings[wanted.id]) for wanted in judged}
    criteria = award(judged, judgements, grade.flags, rubric=rubric)
    automatic = grade.model_copy(update={"overrides": (), "adjustments": ()})
    return with_total(automatic, criteria, rubric=rubric)


def _weighed(wanted: asked.Criterion, finding: Judgement) -> Judgement:
    """Return a stored judgement with the shares that the criterion's new tolerances give."""

    def weighed(verdict: Verdict) -> Verdict:
        if not verdict.models:
            return Verdict(share=verdict.share, message="")
        best = max(points_for(wanted, model) for model in verdict.models)
        return Verdict(share=min(best, verdict.most), message="")

    return Judgement(
        typed=weighed(finding.typed),
        undone=weighed(finding.undone),
        only={slip: weighed(one) for slip, one in finding.only.items()},
    )


def needs_recordings(before: Rubric, now: Rubric) -> list[str]:
    """Return the changed keys of a rubric that take effect only if recordings are graded again.

    `criteria.ID` names a criterion that was never judged. `criteria.ID.KEY` names a key whose new
    value changes the errors.
    """
    found = [key for key in _OF_RUBRIC if getattr(before, key) != getattr(now, key)]
    if before.late.due != now.late.due:
        found.append("late.due")
    old = {criterion.id: criterion for criterion in before.criteria}
    for criterion in now.criteria:
        if criterion.id not in old:
            found.append(f"criteria.{criterion.id}")
            continue
        was = old[criterion.id]
        for key in _OF_CRITERION:
            # Not every criterion has every one of these keys.
            if getattr(was, key, None) != getattr(criterion, key, None):
                found.append(f"criteria.{criterion.id}.{key}")
    # A criterion about some experiments takes them from the other criterion about required items.
    gone = old.keys() - {criterion.id for criterion in now.criteria}
    found += [f"criteria.{id_}" for id_ in sorted(gone) if getattr(old[id_], "experiments", ())]
    return found
