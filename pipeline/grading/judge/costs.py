"""Make each flag cost at least the share of its criterion's points that the rubric states."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction

from pipeline.grading import rubric as asked
from pipeline.grading.grade import Code, Flag, Grade
from pipeline.grading.judge.earned import ALL
from pipeline.grading.judge.work import Verdict
from pipeline.grading.references.tolerance import exact
from pipeline.grading.rubric import Rubric, matching
from pipeline.grading.words import WORDS

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


def charge(
    verdict: Verdict, criterion: asked.Criterion, flags: Sequence[Flag], *, rubric: Rubric
) -> Verdict:
    """Return a verdict with its share limited by the most expensive flag on its criterion.

    Only this flag counts, not the sum of all flags. A share that is already lower stays.
    """
    mine = [flag for flag in flags if concerns(flag, criterion, names=rubric.names)]
    dearest = max(mine, key=lambda flag: rubric.flags.of(flag.code), default=None)
    if dearest is None or verdict.share is None:
        return verdict
    cost = rubric.flags.of(dearest.code)
    kept: Fraction = ALL - exact(cost)
    if verdict.share <= kept:
        return verdict
    sentence = WORDS.text(
        "costs",
        title=WORDS.text(f"title_{dearest.code}"),
        percent=f"{100 * cost:g}",
    )
    return replace(verdict, share=kept, message=f"{verdict.message} {sentence}")


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
