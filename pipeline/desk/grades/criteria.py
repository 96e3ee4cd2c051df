"""The criteria of a team as its page shows them: in which order, with what evidence and steps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

from pipeline.desk.evidence import show_message, show_numbers
from pipeline.grading.grade import Criterion, Flag, Grade
from pipeline.grading.gradebook.open_book import TeamNow
from pipeline.grading.gradebook.override import HandPoints
from pipeline.grading.judge.costs import is_about
from pipeline.grading.publish.feedback import (
    TONES,
    alternative,
    evidence_table,
    sentence,
)
from pipeline.grading.publish.feedback_figures import is_response, numbers_in
from pipeline.grading.references.tolerance import exact, to_step
from pipeline.grading.rubric import Criterion as Asked
from pipeline.grading.rubric import Rubric
from pipeline.grading.words import WORDS, points_text
from pipeline.names import read_name
from pipeline.report.render.html import render_blocks
from pipeline.set_up import Units
from pipeline.words.numbers import NOTHING
from pipeline.words.text import capital, name_span, with_symbols

MOST_STEPS = 9  # a key each, from 1
_QUARTERS = 4


@dataclass(frozen=True, kw_only=True)
class Item:
    """A line of the list on a team's page: a criterion, or a remark that is about none of them.

    Attributes
    ----------
    id : Of the criterion, or the code of the remark.
    lost : Points before those given by hand. So a decided criterion keeps its place in the list.
    doubt : Whether a person should look, or did: points are lost, it was not judged, it has a
        remark, or points by hand.
    """

    id: str
    is_remark: bool = False
    title: str
    points: str = ""
    outcome: str = ""
    tone: str = ""
    lost: float = 0.0
    doubt: bool = True
    by_hand: bool = False


def list_items(grade: Grade, now: TeamNow) -> list[Item]:
    """Return the criteria and the remarks beside them, those to look at first, most lost first."""
    judged = {criterion.id: criterion for criterion in grade.criteria}
    items = [
        Item(id=flag.code, is_remark=True, title=capital(WORDS.text(f"title_{flag.code}")))
        for flag in grade.flags
        if not any(is_about(flag, asked, now.rubric) for asked in now.rubric.criteria)
    ]
    for asked in now.rubric.criteria:
        own = judged.get(asked.id)
        flagged = any(is_about(flag, asked, now.rubric) for flag in grade.flags)
        earned = points_text(own.points) if own else NOTHING
        by_hand = asked.id in now.entry.overrides
        items.append(
            Item(
                id=asked.id,
                title=capital(asked.title or asked.id),
                points=f"{earned} / {points_text(asked.points)}",
                outcome=WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
                tone=TONES[own.outcome] if own else "quiet",
                lost=asked.points - now.entry.automatic.get(asked.id, asked.points),
                doubt=own is None or own.outcome != "pass" or flagged or by_hand,
                by_hand=by_hand,
            )
        )
    return sorted(items, key=lambda item: (not item.doubt, not item.is_remark, -item.lost))


def point_steps(out_of: float, *, step: float) -> list[float]:
    """Return the points that a criterion can be given by a key: at most nine, nothing and all too.

    The rubric's own steps where they are few, else quarters, rounded to a step.
    """
    whole = exact(out_of)
    fine = [n * exact(step) for n in range(MOST_STEPS) if n * exact(step) < whole]
    if (len(fine)) * exact(step) < whole:
        fine = [to_step(whole * n / _QUARTERS, step) for n in range(_QUARTERS)]
    return [float(points) for points in dict.fromkeys([*fine, whole])]


def list_steps(out_of: float, rubric: Rubric) -> list[str]:
    """Return these points as pages write them."""
    return [points_text(points) for points in point_steps(out_of, step=rubric.step)]


def describe_criterion(
    asked: Asked, grade: Grade, now: TeamNow, *, typed: Mapping[str, str]
) -> dict[str, Any]:
    """Return what the page shows of the chosen criterion; it may never have been judged.

    Parameters
    ----------
    typed : what was typed in its form and refused, and why: points, other, why, wrong.
    """
    own = next((c for c in grade.criteria if c.id == asked.id), None)
    given = now.entry.overrides.get(asked.id) or now.entry.comments.get(asked.id)
    points = points_text(own.points) if own else ""
    steps = list_steps(asked.points, now.rubric)
    chosen = typed.get("points") or points
    other = typed.get("other", "") or ("" if chosen in steps else chosen)
    return {
        "id": asked.id,
        "title": capital(asked.title or asked.id),
        "points": points or NOTHING,
        "out_of": points_text(asked.points),
        "outcome": WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
        "tone": TONES[own.outcome] if own else "quiet",
        "lost": own is not None and own.points < own.out_of,
        "text": show_message(own) if own else "",
        "numbers": show_numbers(own, asked.check, grade.units) if own else "",
        "steps": steps,
        "chosen": "" if other else chosen,
        "other": other,
        "why": typed.get("why", ""),
        "wrong": typed.get("wrong", ""),
        "version": now.versions[asked.id],
        "changed": asked.id in now.changed,
        "by_hand": _say_given(given) if given else "",
        "is_comment": given is not None and given.comment,
        "own_reason": given.why if given else "",
    }


def _say_given(given: HandPoints) -> str:
    what = "Comment by" if given.comment else "Points by hand,"
    return f"{what} {given.by}: {given.why}"


def describe_flag(flag: Flag, units: Units | None) -> dict[str, Any]:
    """Return a remark in words, with the numbers it rests on."""
    table = evidence_table(flag, units=units, numbers=count(0))
    return {
        "code": flag.code,
        "name": WORDS.text(f"title_{flag.code}"),
        "title": capital(WORDS.text(f"title_{flag.code}")),
        "text": with_symbols(sentence(flag.message)),
        "numbers": render_blocks([table]) if table else "",
    }


def show_figures(
    drawn: Sequence[tuple[str, str]], asked: Asked | None, own: Criterion | None, *, first: str = ""
) -> list[dict[str, str]]:
    """Return the figures of a criterion, the one with the number that is most off first.

    Without a criterion: those that belong to none.

    Parameters
    ----------
    drawn : file names and SVG.
    first : the file that somebody wants to see first.
    """
    worst = _find_worst(own) if own else ""
    about = [(file, svg) for file, svg in drawn if _belongs(file, asked, own)]
    about.sort(key=lambda one: (one[0] != first, not _shows(one[0], worst)))
    return [{"file": file, "short": _shorten(file), "alt": alternative(svg)} for file, svg in about]


def _belongs(file: str, asked: Asked | None, own: Criterion | None) -> bool:
    """Tell whether a figure belongs beside a criterion: records by the numbers in them."""
    numbers = numbers_in(file)
    if asked is None:
        return not numbers and not is_response(file)
    if numbers:
        about = asked.check in ("initial", "initial_final")
        return about and own is not None and not numbers.isdisjoint(own.found)
    return is_response(file) and asked.check == "final"


def _shorten(file: str) -> str:
    """Return what a button calls a figure."""
    if is_response(file):
        return f"cart {file.removesuffix('.svg').rpartition('-')[2]}"
    return ", ".join(name_span(name).text for name in sorted(numbers_in(file))) or file


def _find_worst(own: Criterion) -> str:
    """Return the number that is most off, as a ratio; "" where no pair can be compared."""
    ratios = {}
    for name, expected in own.expected.items():
        found = own.found.get(name)
        if _is_positive(found) and _is_positive(expected):
            ratios[name] = max(found / expected, expected / found)
    return max(ratios, key=lambda name: ratios[name], default="")


def _is_positive(value: Any) -> bool:
    return isinstance(value, float | int) and value > 0


def _shows(file: str, name: str) -> bool:
    """Tell whether a figure shows a number: its record, or the response of its cart."""
    if is_response(file):
        return bool(name) and file.endswith(f"-{read_name(name).cart}.svg")
    return name in numbers_in(file)
