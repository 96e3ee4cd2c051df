"""Print a rubric, as data or as a page of text (`templates/rubric.txt.j2`)."""

from typing import Any

from pipeline.grading.rubric import (
    InitialFinal,
    Parameters,
    Required,
    Rubric,
    matching,
    source_of,
)
from pipeline.names import read_name
from pipeline.report.html import render_text
from pipeline.submission.load import spring_names


def rubric_dict(rubric: Rubric) -> dict[str, Any]:
    """Return the rubric as a dictionary for JSON; defaults are filled in and patterns expanded."""
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

    def named(patterns: tuple[str, ...]) -> list[str]:
        return matching(patterns, rubric.names)

    def dampings(criterion: Parameters | InitialFinal) -> bool:
        return any(read_name(name).is_damping for name in named(criterion.parameters))

    def others(criterion: Parameters | InitialFinal) -> bool:
        return not all(read_name(name).is_damping for name in named(criterion.parameters))

    springs = zip(spring_names(rubric.system.carts), rubric.system.springs, strict=True)
    return render_text(
        "rubric.txt.j2",
        rubric=rubric,
        springs=[name for name, there in springs if there],
        costs={code: cost for code, cost in rubric.flags if cost.least or cost.most < 1},
        nothing=rubric.required == Required(),
        named=named,
        source=source_of,
        dampings=dampings,
        others=others,
    )
