"""A rubric in words: what a submission must hold, what is checked, for how many points."""

from typing import Any

from pipeline.grading.rubric import (
    Claims,
    Criterion,
    Gains,
    Hardware,
    InitialFinal,
    Laws,
    Parameters,
    Prefilter,
    Rubric,
    StateModel,
    is_damping,
    matching,
)
from pipeline.submission.load import spring_names

_ASKS = {
    "required": "everything below is handed in",
    "data": "the recordings hold what they should",
    "initial": "initial estimates agree with the student's own recordings",
    "final": "final estimates agree with a fit to the student's own recordings",
    "initial_final": "initial and final estimates agree with each other",
    "laws": "the final table obeys the laws of a real chain of carts",
    "state_space": "A and B follow from the final table",
    "gains": "the gains reach the goal on the carts",
    "claims": "reported overshoot and settling time are what the gains give",
    "prefilter": "the prefilter is one over the loop's static gain",
    "hardware": "the closed-loop run is there, and the model reproduces it",
}


def rubric_dict(rubric: Rubric) -> dict[str, Any]:
    """Return the rubric as plain data, defaults filled in, patterns written out."""
    plain = rubric.model_dump(mode="json")
    plain["out_of"] = rubric.out_of
    for criterion, entry in zip(rubric.criteria, plain["criteria"], strict=True):
        if isinstance(criterion, Parameters | InitialFinal):
            entry["parameters"] = matching(criterion.parameters, rubric.names)
    for table in ("initial", "final"):
        patterns = getattr(rubric.required, table)
        plain["required"][table] = matching(patterns, rubric.names)
    return plain


def rubric_text(rubric: Rubric) -> str:
    """Return the rubric as a page of text."""
    lines = [f"{rubric.title or 'A rubric'}: {rubric.out_of:g} points", ""]
    lines += [f"bench: {_system(rubric)}"]
    if rubric.design:
        goal = rubric.design
        lines.append(
            f"controller: cart {goal.cart} by {goal.reference:g} {rubric.system.position.unit}, "
            f"overshoot at most {goal.overshoot_percent:g} %, "
            f"settling within {goal.settling_time:g} s"
        )
    lines += ["", "to hand in:", *(f"  {piece}" for piece in _pieces(rubric)), "", "criteria:"]
    for criterion in rubric.criteria:
        lines.append(f"  {criterion.points:>5g}  {criterion.id}: {asks(criterion, rubric)}")
        if after := ", ".join(criterion.requires):
            lines.append(f"         only if passed or partly passed: {after}")
    lines += ["", f"late: {_late(rubric)}"]
    lines.append(f"names: {'left out of all pages' if rubric.anonymous else 'shown'}")
    return "\n".join(lines)


def asks(criterion: Criterion, rubric: Rubric) -> str:
    """Return in words what a criterion asks, tolerances included."""
    text = criterion.title or _ASKS[criterion.check]
    if isinstance(criterion, Parameters | InitialFinal):
        text += f" [{', '.join(matching(criterion.parameters, rubric.names))}]"
    match criterion:
        case Parameters() | InitialFinal():
            names = matching(criterion.parameters, rubric.names)
            dampings = [is_damping(name) for name in names]
            limits = _limits(criterion, dampings=any(dampings), others=not all(dampings))
        case StateModel():
            limits = _limits(criterion, dampings=True, others=True)
        case Laws():
            limits = (
                "within half the last digits; half the points within "
                f"{criterion.frequency_percent:g} %, damping {criterion.damping_percent:g} %"
            )
        case Gains() | Claims():
            limits = (
                f"overshoot within {criterion.overshoot_full:g} percentage points, settling time "
                f"within {criterion.settling_full_percent:g} %; no points from "
                f"{criterion.overshoot_none:g} and {criterion.settling_none_percent:g} %"
            )
        case Prefilter() | Hardware():
            limits = (
                f"within {criterion.full_percent:g} %, no points from {criterion.none_percent:g} %"
            )
        case _:
            limits = "points by the share that is right"
    return f"{text} ({limits})"


def _limits(
    criterion: Parameters | InitialFinal | StateModel, *, dampings: bool, others: bool
) -> str:
    full, none = criterion.full_percent, criterion.none_percent
    parts = [f"within {full:g} %, no points from {none:g} %"] if others else []
    if dampings:
        full, none = criterion.damping_full_percent, criterion.damping_none_percent
        parts.append(f"damping within {full:g} %, no points from {none:g} %")
    return "; ".join(parts)


def _system(rubric: Rubric) -> str:
    system = rubric.system
    springs = [
        name
        for name, there in zip(spring_names(system.carts), system.springs, strict=True)
        if there
    ]
    count = "1 cart" if system.carts == 1 else f"{system.carts} carts"
    return (
        f"{count}, springs {', '.join(springs) or 'none'}; "
        f"positions in {system.position.unit}, input in {system.input.unit}"
    )


def _pieces(rubric: Rubric) -> list[str]:
    required, pieces = rubric.required, []
    for runs in required.experiments:
        alone = ", ".join(map(str, runs.carts))
        free = f" with cart {alone} free" if alone else ""
        pieces.append(f"{runs.at_least} or more {runs.kind} runs{free}")
    for table in ("initial", "final"):
        if names := matching(getattr(required, table), rubric.names):
            pieces.append(f"[reported.{table}] {', '.join(names)}")
    if required.state_space:
        pieces.append("[reported.state_space] A, B")
    if required.feedback:
        pieces.append(f"[reported.feedback] {', '.join(required.feedback)}")
    return pieces or ["nothing in particular"]


def _late(rubric: Rubric) -> str:
    late = rubric.late
    if not late.percent_per_day:
        return "nothing is taken off"
    grace = f" after {late.grace_days:g} days of grace" if late.grace_days else ""
    due = f" from {late.due:%Y-%m-%d %H:%M %z}" if late.due else ""
    return f"{late.percent_per_day:g} % a day{due}{grace}, at most {late.most_percent:g} %"
