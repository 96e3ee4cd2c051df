"""Describe how the rubric and the points differ between two class lists."""

from collections.abc import Callable, Container, Mapping
from typing import Any

from pydantic import ValidationError

from pipeline.grading.rubric import Rubric
from pipeline.grading.words import points_text


def rubric_changes(before: str, now: str) -> list[str]:
    """Return the differences between two rubrics, given as JSON, one phrase each."""
    if before == now:
        return []
    try:
        rubrics = [Rubric.model_validate_json(text) for text in (before, now)]
    except ValidationError:
        return ["the earlier rubric was written by another version of cartlab"]
    old, new = ({c.id: c for c in rubric.criteria} for rubric in rubrics)
    changes = [f"criterion {id_} was removed" for id_ in old if id_ not in new]
    for id_, criterion in new.items():
        if id_ not in old:
            changes.append(f"criterion {id_} is new")
        else:
            differing = _differing(old[id_].model_dump(), criterion.model_dump())
            changes += [f"{id_}: {change}" for change in differing]
    if not changes and list(old) != list(new):
        changes.append("the order of the criteria changed")
    old, new = (rubric.model_dump(exclude={"criteria"}) for rubric in rubrics)
    return changes + _differing(old, new)


def points_changes(
    before: Mapping[str, float],
    now: Mapping[str, float],
    *,
    by_hand: Container[str] = (),
    shown: Callable[[str], str] = str,
) -> list[str]:
    """Return a phrase for each submission that is new, was removed, or has other points.

    Parameters
    ----------
    before, now : points by submission in the previous and the new class list, respectively.
    by_hand : submissions with points given by hand; their phrases mention this.
    shown : function that returns the name to show for a submission.
    """
    in_order = sorted(now.items(), key=lambda one: shown(one[0]))
    changes = [
        f"{shown(name)}: {points_text(before[name])} → {points_text(points)}"
        + (" (with points given by hand)" if name in by_hand else "")
        for name, points in in_order
        if name in before and points != before[name]
    ]
    changes += [f"{shown(name)} is new" for name, _ in in_order if name not in before]
    return changes + [f"{shown(name)} was removed" for name in before if name not in now]


def _differing(before: Mapping[str, Any], now: Mapping[str, Any], at: str = "") -> list[str]:
    changes = []
    for key in {**before, **now}:
        old, new = before.get(key), now.get(key)
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            changes += _differing(old, new, f"{at}{key}.")
        elif old != new:
            changes.append(f"{at}{key} {_shown(old)} → {_shown(new)}")
    return changes


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple | Mapping):
        return f"({len(value)})" if len(str(value)) > 40 else str(value)
    text = (
        "nothing" if value in (None, "") else f"{value:g}" if type(value) is float else f"{value}"
    )
    return text if len(text) <= 40 else f"{text[:39]}…"
