"""How many points a mistake costs under three rubrics, and whether right numbers lose any."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from benchmarks.page import Table, share, spread
from pipeline.grading.grade import Grade
from pipeline.grading.rubric import FlagCosts, Parameters, Rubric, matching
from pipeline.submission import Reported
from tests.helpers.grading_class import Team

# Part of the report that each check grades.
GRADED_TABLE = {
    "initial": "initial",
    "final": "final",
    "state_space": "state_space",
    "gains": "feedback",
    "claims": "feedback",
    "prefilter": "feedback",
}
Grading = tuple[str, Team, set[str]]  # kind of mistake, team, and the codes of the right flags
STRICT, LENIENT = 0.5, 2.0  # tolerances are multiplied by these factors


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One grading: its share of the points, and how many criteria lost points.

    Attributes
    ----------
    wrong, wrong_lost : number of criteria about changed numbers, and how many of them lost points.
    right, right_lost : the same for criteria about numbers that the mistake did not change.
    """

    points: float
    wrong: int = 0
    wrong_lost: int = 0
    right: int = 0
    right_lost: int = 0


def three_rubrics(rubric: Rubric) -> dict[str, Rubric]:
    """Return a rubric as shipped, a strict version and a lenient one."""
    costs = FlagCosts.model_validate(dict.fromkeys(FlagCosts.model_fields, 1.0))
    return {
        "as shipped": rubric,
        "strict: half the tolerances, a named mistake costs the whole criterion": _scaled(
            rubric, STRICT
        ).model_copy(update={"flags": costs}),
        "lenient: twice the tolerances, a named mistake costs nothing more": _scaled(
            rubric, LENIENT
        ).model_copy(update={"flags": FlagCosts.model_validate({"wrong_state_space": 0.0})}),
    }


def _scaled(rubric: Rubric, factor: float) -> Rubric:
    """Return a rubric with every tolerance multiplied by a factor."""
    criteria = []
    for criterion in rubric.criteria:
        limits = [
            x for x in type(criterion).model_fields if x.endswith(("_percent", "_full", "_none"))
        ]
        update = {name: factor * getattr(criterion, name) for name in limits}
        criteria.append(criterion.model_copy(update=update))
    return rubric.model_copy(update={"criteria": tuple(criteria)})


def points(benches: Sequence[Iterable[Grading]]) -> Table:
    """Return the points of honest teams and of teams with mistakes under each rubric."""
    judged: dict[str, dict[bool, list[Judged]]] = defaultdict(lambda: defaultdict(list))
    for bench in benches:
        for name, honest, one in _judge_bench(bench):
            judged[name][honest].append(one)
    rows = []
    for name, groups in judged.items():
        honest, slipped = groups[True], groups[False]
        rows.append(
            [
                name,
                spread(100 * one.points for one in honest),
                spread(100 * one.points for one in slipped),
                share(sum(o.wrong_lost for o in slipped), sum(o.wrong for o in slipped)),
                share(sum(o.right_lost for o in slipped), sum(o.right for o in slipped)),
            ]
        )
    return Table(
        title="Points under three rubrics",
        head=[
            "rubric",
            "honest teams, % of points",
            "teams with mistakes, % of points",
            "criteria about wrong numbers that lost points",
            "criteria about right numbers that lost points",
        ],
        rows=rows,
        note=f"""
{len(benches)} fresh benches, each with an honest team and up to four mistakes, as in the first
table.
A TA who knew the mistake would take points for the numbers that it changed, and for no others.
A criterion counts as lost if the same team had more points there before the mistake. Criteria that
compare two tables, or ask for all pieces, are left out of the last two columns. A named mistake
costs points once, where it costs most; so other criteria with the same mistake keep theirs.
""",
    )


def _judge_bench(bench: Iterable[Grading]) -> Iterator[tuple[str, bool, Judged]]:
    """Yield (rubric, honest, result) of each grading of one bench."""
    honest: dict[str, Grade] = {}
    reported: Reported | None = None
    for _, team, codes in bench:
        if codes & {"data_problem", "missing"} or (honest and not codes):
            continue  # mistakes in recordings or the rubric
        for name, rubric in three_rubrics(team.rubric).items():
            grade = replace(team, rubric=rubric).grade()
            share_of = grade.points / grade.out_of
            if not codes:
                honest[name], reported = grade, team.reported
                yield name, True, Judged(points=share_of)
            else:
                assert reported is not None
                yield name, False, _compare(team, reported, honest[name], grade, rubric)


def _compare(team: Team, before: Reported, honest: Grade, grade: Grade, rubric: Rubric) -> Judged:
    """Return how many criteria lost points by a mistake."""
    had = {criterion.id: criterion.points for criterion in honest.criteria}
    has = {criterion.id: criterion.points for criterion in grade.criteria}
    counts = {True: [0, 0], False: [0, 0]}
    for criterion in rubric.criteria:
        table = GRADED_TABLE.get(criterion.check)
        if table is None or had.get(criterion.id, 0.0) == 0.0:
            continue
        old, new = getattr(before, table), getattr(team.reported, table)
        if isinstance(criterion, Parameters):
            names = matching(criterion.parameters, rubric.names)
            old, new = ([numbers.get(name) for name in names] for numbers in (old, new))
        elif table == "state_space" and before.final != team.reported.final:
            continue  # A and B are compared with the final table
        changed = old != new
        counts[changed][0] += 1
        counts[changed][1] += has.get(criterion.id, 0.0) < had[criterion.id]
    return Judged(
        points=grade.points / grade.out_of,
        wrong=counts[True][0],
        wrong_lost=counts[True][1],
        right=counts[False][0],
        right_lost=counts[False][1],
    )
