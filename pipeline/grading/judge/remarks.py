"""Which flags concern what a criterion judges."""

from collections.abc import Mapping

from pipeline.grading import rubric as asked
from pipeline.grading.grade import Code, Flag, Grade
from pipeline.grading.rubric import Rubric, matching

# The check that each flag concerns. Other flags concern the parameter table that their evidence
# names.
_ABOUT: Mapping[Code, str] = {
    "initial_final_disagree": "initial_final",
    "wrong_state_space": "state_space",
    "wrong_gains": "gains",
    "wrong_prefilter": "prefilter",
    "missing": "required",
    "data_problem": "data",
}
_REDUCED = "data"  # the check that a flag concerns if its evidence names no parameter table


def concerns(flag: Flag, criterion: asked.Criterion, *, names: list[str]) -> bool:
    """Return whether a flag concerns what a criterion judges."""
    if flag.code == "missing" and "criteria" in flag.evidence:
        return criterion.id in flag.evidence["criteria"]
    if flag.code in _ABOUT:
        return _ABOUT[flag.code] == criterion.check
    tables = {flag.evidence.get("table"), flag.evidence.get("also_in")} - {None}
    if not tables:
        return criterion.check == _REDUCED
    if not isinstance(criterion, asked.Parameters) or criterion.check not in tables:
        return False
    return not set(flag.parameters).isdisjoint(matching(criterion.parameters, names))


def find_remarks(grade: Grade, criterion: asked.Criterion, rubric: Rubric) -> list[Flag]:
    """Return the flags of a grade that concern a criterion."""
    return [flag for flag in grade.flags if is_about(flag, criterion, rubric)]


def is_about(flag: Flag, criterion: asked.Criterion, rubric: Rubric) -> bool:
    """Return whether a flag concerns a criterion; the flag for shared recordings concerns none."""
    return flag.code != "shared_data" and concerns(flag, criterion, names=rubric.names)
