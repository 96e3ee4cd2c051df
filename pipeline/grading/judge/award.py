"""Turn judgements into points: required criteria, costs of flags, and the rubric's rounding.

Each mistake is charged once, in the criterion where it costs most. Everywhere else, the numbers are
judged with the mistake undone. The rubric states the least and the most that a mistake costs, as
shares of the criterion where it is charged.

The gradebook stores the error of each number as an exact fraction. From these errors, the same code
computes points under a changed rubric, without reading recordings. If a change to the rubric alters
the errors, recordings must be graded again; `needs_recordings` finds such changes.
"""

import json
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from pipeline.grading import rubric as asked
from pipeline.grading.grade import CODES, Code, Criterion, Flag, Grade, Outcome
from pipeline.grading.judge.context import Judgement, Verdict
from pipeline.grading.mistakes.undo import Slip
from pipeline.grading.rubric import Rubric, concerns
from pipeline.grading.tolerance import ALL, NONE, Deviation, exact, points_for
from pipeline.grading.total import to_step, with_total
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


# Keys of a rubric that change the errors themselves. If one changes, the recordings must be graded
# again.
_OF_RUBRIC = ("system", "design", "required", "examples")
_OF_CRITERION = (
    "check", "from", "experiments", "parameters", "sigmas", "frequency_percent", "damping_percent",
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
    judgements = {wanted.id: _recomputed(wanted, findings[wanted.id]) for wanted in judged}
    criteria = award(judged, judgements, grade.flags, rubric=rubric)
    automatic = grade.model_copy(update={"overrides": (), "adjustments": ()})
    return with_total(automatic, criteria, rubric=rubric)


def _recomputed(wanted: asked.Criterion, finding: Judgement) -> Judgement:
    """Return a stored judgement with the shares that the criterion's new tolerances give."""

    def recomputed(verdict: Verdict) -> Verdict:
        if not verdict.models:
            return Verdict(share=verdict.share, message="")
        best = max(points_for(wanted, model) for model in verdict.models)
        return Verdict(share=min(best, verdict.most), message="")

    return Judgement(
        typed=recomputed(finding.typed),
        undone=recomputed(finding.undone),
        only={slip: recomputed(one) for slip, one in finding.only.items()},
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
