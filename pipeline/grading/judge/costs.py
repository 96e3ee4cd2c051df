"""Charge each mistake once: in the criterion where it costs most.

Everywhere else, the numbers are judged with the mistake undone. The rubric states the least and the
most that a mistake costs, as shares of the criterion where it is charged.
"""

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

from pipeline.grading import rubric as asked
from pipeline.grading.grade import CODES, Code, Flag
from pipeline.grading.judge.context import Judgement, Verdict
from pipeline.grading.judge.remarks import concerns
from pipeline.grading.mistakes.undo import Slip
from pipeline.grading.rubric import Rubric
from pipeline.grading.tolerance import ALL, NONE, exact
from pipeline.grading.words import WORDS
from pipeline.words.numbers import first_few

_DIRECT = ("initial", "final")  # the checks that judge single numbers of the tables


@dataclass(frozen=True, kw_only=True)
class Charges:
    """What mistakes cost in one criterion.

    Attributes
    ----------
    here : the mistakes charged here, and the share of the points that each one loses.
    elsewhere : the mistakes that lose points here too, and the criterion where each is charged.
    """

    here: Mapping[Slip, Fraction] = field(default_factory=dict)
    elsewhere: Mapping[Slip, asked.Criterion] = field(default_factory=dict)


def assign(
    criteria: Sequence[asked.Criterion],
    judgements: Mapping[str, Judgement],
    flags: Sequence[Flag],
    *,
    rubric: Rubric,
) -> dict[str, Charges]:
    """Assign each mistake to the criterion where it costs most, given the earlier ones.

    A wrong number that no known mistake explains is charged in every criterion that judges this
    number. It is undone only where other results follow from it.
    """
    here: dict[str, dict[Slip, Fraction]] = {one.id: {} for one in criteria}
    home: dict[Slip, asked.Criterion] = {}
    found = {slip for one in judgements.values() for slip in one.only}
    for slip in sorted(
        found, key=lambda slip: (not slip.number, CODES.index(slip.code), slip.number)
    ):
        cost = rubric.flags.of(slip.code)
        least, most = exact(cost.least), exact(cost.most)
        mine = [flag for flag in flags if flag.code == slip.code]
        worth: dict[str, Fraction] = {}
        for one in criteria:
            loss = loss_in(judgements[one.id], slip)
            if not loss and not any(concerns(flag, one, names=rubric.names) for flag in mine):
                continue
            room = (judgements[one.id].undone.share or NONE) - sum(here[one.id].values(), NONE)
            worth[one.id] = max(min(loss, most, room), least) * exact(one.points)
        own = [c for c in criteria if c.check in _DIRECT and worth.get(c.id)]
        if not (slip.number and own):
            dearest = max(worth, key=lambda id_: worth[id_], default="")
            own = [c for c in criteria if c.id == dearest]
        for one in own:
            here[one.id][slip] = min(loss_in(judgements[one.id], slip), most)
            home.setdefault(slip, one)
    return {
        one.id: Charges(
            here=here[one.id],
            elsewhere={
                slip: home[slip]
                for slip in judgements[one.id].only
                if slip in home and slip not in here[one.id] and loss_in(judgements[one.id], slip)
            },
        )
        for one in criteria
    }


def unnamed(judgement: Judgement, criterion: asked.Criterion) -> Charges:
    """Return the charges of wrong numbers that no known mistake explains, where they are judged."""
    if criterion.check not in _DIRECT:
        return Charges()
    return Charges(here={s: loss_in(judgement, s) for s in judgement.only if s.number})


def loss_in(judgement: Judgement, slip: Slip) -> Fraction:
    """Return the share of the points that a mistake alone loses in a criterion."""
    only = judgement.only.get(slip)
    if only is None or not judgement.is_better_undone:
        return NONE
    return max((judgement.undone.share or NONE) - (only.share or NONE), NONE)


def apply_flag_cost(
    judgement: Judgement,
    charges: Charges,
    criterion: asked.Criterion,
    flags: Sequence[Flag],
    *,
    rubric: Rubric,
) -> Verdict:
    """Return the verdict on a criterion: each mistake that is charged here loses its points."""
    typed, undone = judgement.typed, judgement.undone
    verdict, share = typed, typed.share
    if judgement.only and judgement.is_better_undone:
        # The losses of several mistakes overlap, so together they cost no more than as typed.
        lost: dict[Code, Fraction] = defaultdict(Fraction)
        for slip, loss in charges.here.items():
            lost[slip.code] += loss
        lost = {code: min(loss, exact(rubric.flags.of(code).most)) for code, loss in lost.items()}
        left = (undone.share or NONE) - sum(lost.values(), NONE)
        share = max(left, typed.share or NONE)
        said = _say_elsewhere(charges.elsewhere)
        if charges.elsewhere and not charges.here:
            right = WORDS.text("otherwise_right") if undone.share == 1 else undone.message
            verdict = replace(typed, message=f"{right} {said}".strip(), explained=undone.explained)
        elif said:
            verdict = replace(typed, message=f"{typed.message} {said}")
    verdict = replace(verdict, share=share)
    slips = {slip.code for slip in (*charges.here, *charges.elsewhere)}
    # The least cost of a missing item is charged where the items are counted.
    codes: set[Code] = {slip.code for slip in charges.here if slip.code != "missing"}
    for flag in flags:
        charged = flag.code in slips and flag.code != "missing"
        if not charged and concerns(flag, criterion, names=rubric.names):
            codes.add(flag.code)
    return _limit(verdict, codes, charges, rubric=rubric)


def _limit(
    verdict: Verdict, codes: Collection[Code], charges: Charges, *, rubric: Rubric
) -> Verdict:
    """Return a verdict with its share limited by the most expensive flag on its criterion.

    Only this flag counts, not the sum of all flags. A share that is already lower stays, unless
    all its loss belongs to flags that may not cost so much.
    """
    if verdict.share is None or not codes:
        return verdict
    if not charges.here and not charges.elsewhere:
        most = max(exact(rubric.flags.of(code).most) for code in codes)
        verdict = replace(verdict, share=max(verdict.share, ALL - most))
    dearest = max(sorted(codes, key=CODES.index), key=lambda code: rubric.flags.of(code).least)
    cost = rubric.flags.of(dearest).least
    kept: Fraction = ALL - exact(cost)
    if verdict.share is None or verdict.share <= kept:
        return verdict
    sentence = WORDS.text(
        "costs",
        title=WORDS.text(f"title_{dearest}"),
        percent=f"{100 * cost:g}",
    )
    return replace(verdict, share=kept, message=f"{verdict.message} {sentence}")


def _say_elsewhere(elsewhere: Mapping[Slip, asked.Criterion]) -> str:
    """Return sentences that name the mistakes undone here, and where each one lost its points."""
    places: dict[tuple[str, str], list[str]] = {}
    for slip, where in elsewhere.items():
        numbers = places.setdefault((slip.code, where.title or where.id), [])
        numbers += [slip.number] if slip.number else []
    return " ".join(
        WORDS.text(
            "undone_numbers" if numbers else "undone",
            title=WORDS.text(f"title_{code}"),
            where=where,
            numbers=first_few([number.partition(".")[2] for number in numbers], 4),
        )
        for (code, where), numbers in places.items()
    )
