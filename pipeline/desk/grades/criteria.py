"""The criteria on a team's page: their order, their evidence, and the points to choose from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

from pipeline.desk.shown_criterion import show_message, show_numbers
from pipeline.grading.grade import Criterion, Flag, Grade
from pipeline.grading.gradebook.events import Entry, Event
from pipeline.grading.publish.feedback import TONES, alternative, evidence_table, sentence
from pipeline.grading.publish.feedback_figures import is_response, numbers_in
from pipeline.grading.rubric import Criterion as Asked
from pipeline.grading.rubric import Rubric, is_about
from pipeline.grading.tolerance import exact
from pipeline.grading.total import to_step
from pipeline.grading.words import WORDS, points_text
from pipeline.names import read_name
from pipeline.report.html import render_blocks
from pipeline.setup import Units
from pipeline.words.numbers import NOTHING
from pipeline.words.text import capital, name_span, with_symbols

MOST_STEPS = 9  # one for each key, from 1 to 9
_QUARTERS = 4


@dataclass(frozen=True, kw_only=True)
class Item:
    """A row in the list on a team's page: a criterion, or a flag that concerns no criterion.

    Attributes
    ----------
    id : id of the criterion, or code of the flag.
    lost : points lost in the automatic grading. Points given by hand do not count, so the row
        stays in its place.
    doubt : whether a person should look or has looked: points were lost, the criterion was not
        judged, or there is a flag or points given by hand.
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


def list_items(grade: Grade, now: Entry) -> list[Item]:
    """Return the rows: those in doubt first, flags before criteria, then by points lost."""
    judged = {criterion.id: criterion for criterion in grade.criteria}
    items = [
        Item(id=flag.code, is_remark=True, title=capital(WORDS.text(f"title_{flag.code}")))
        for flag in grade.flags
        if not any(is_about(flag, asked, now.rubric) for asked in now.rubric.criteria)
    ]
    for asked in now.rubric.criteria:
        own = judged.get(asked.id)
        flagged = any(is_about(flag, asked, now.rubric) for flag in grade.flags)
        earned = points_text(own.points) if own and own.id not in grade.open else NOTHING
        by_hand = asked.id in now.overrides
        items.append(
            Item(
                id=asked.id,
                title=capital(asked.title or asked.id),
                points=f"{earned} / {points_text(asked.points)}",
                outcome=WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
                tone=TONES[own.outcome] if own else "quiet",
                lost=asked.points - now.automatic.get(asked.id, asked.points),
                doubt=own is None or own.outcome != "pass" or flagged or by_hand,
                by_hand=by_hand,
            )
        )
    return sorted(items, key=lambda item: (not item.doubt, not item.is_remark, -item.lost))


def point_steps(out_of: float, *, step: float) -> list[float]:
    """Return up to nine choices of points from 0 to `out_of`, one for each key from 1 to 9.

    These are the multiples of the rubric's step. If those are too many, they are the quarters of
    `out_of`, rounded to a step.
    """
    whole = exact(out_of)
    fine = [n * exact(step) for n in range(MOST_STEPS) if n * exact(step) < whole]
    if (len(fine)) * exact(step) < whole:
        fine = [to_step(whole * n / _QUARTERS, step) for n in range(_QUARTERS)]
    return [float(points) for points in dict.fromkeys([*fine, whole])]


def list_steps(out_of: float, rubric: Rubric) -> list[str]:
    """Return the points of `point_steps` as text."""
    return [points_text(points) for points in point_steps(out_of, step=rubric.step)]


def describe_criterion(
    asked: Asked, grade: Grade, now: Entry, *, typed: Mapping[str, str]
) -> dict[str, Any]:
    """Return what the page shows of a criterion, even if it was never judged.

    Parameters
    ----------
    typed : fields of a refused form (points, other, why), and why it was refused (wrong).
    """
    own = next((c for c in grade.criteria if c.id == asked.id), None)
    by_hand = now.overrides.get(asked.id) or now.comments.get(asked.id)
    points = points_text(own.points) if own and own.id not in grade.open else ""
    steps = list_steps(asked.points, now.rubric)
    chosen = typed.get("points") or points
    other = typed.get("other", "") or ("" if chosen in steps else chosen)
    return {
        "id": asked.id,
        "title": capital(asked.title or asked.id),
        "is_manual": asked.check == "manual",
        "points": points or NOTHING,
        "out_of": points_text(asked.points),
        "outcome": WORDS.text(f"outcome_{own.outcome}") if own else "not judged",
        "tone": TONES[own.outcome] if own else "quiet",
        "lost": asked.id in grade.lost,
        "text": show_message(own) if own else "",
        "numbers": show_numbers(own, asked.check, grade.units) if own else "",
        "steps": steps,
        "chosen": "" if other else chosen,
        "other": other,
        "why": typed.get("why", ""),
        "wrong": typed.get("wrong", ""),
        "version": now.version(asked.id),
        "changed": asked.id in now.given,
        "by_hand": _describe_by_hand(by_hand) if by_hand else "",
        "is_comment": by_hand is not None and by_hand.what == "comment",
        "own_reason": by_hand.text if by_hand else "",
    }


def _describe_by_hand(by_hand: Event) -> str:
    what = "Comment by" if by_hand.what == "comment" else "Points by hand,"
    return f"{what} {by_hand.by}: {by_hand.text}"


def describe_flag(flag: Flag, units: Units | None) -> dict[str, Any]:
    """Return a flag as text, with the numbers that support it."""
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
    """Return the figures of a criterion; the one with the largest relative error comes first.

    Without a criterion, the figures that belong to no criterion are returned.

    Parameters
    ----------
    drawn : file name and SVG of each figure.
    own : the criterion as judged; None if it was not judged.
    first : file that the person wants to see first.
    """
    worst = _find_worst(own) if own else ""
    about = [(file, svg) for file, svg in drawn if _belongs(file, asked, own)]
    about.sort(key=lambda one: (one[0] != first, not _shows(one[0], worst)))
    return [{"file": file, "short": _shorten(file), "alt": alternative(svg)} for file, svg in about]


def _belongs(file: str, asked: Asked | None, own: Criterion | None) -> bool:
    """Return whether a figure belongs to a criterion."""
    numbers = numbers_in(file)
    if asked is None:
        return not numbers and not is_response(file)
    if numbers:
        about = asked.check in ("initial", "initial_final")
        return about and own is not None and not numbers.isdisjoint(own.found)
    return is_response(file) and asked.check == "final"


def _shorten(file: str) -> str:
    """Return the text of the button for a figure."""
    if is_response(file):
        return f"cart {file.removesuffix('.svg').rpartition('-')[2]}"
    return ", ".join(name_span(name).text for name in sorted(numbers_in(file))) or file


def _find_worst(own: Criterion) -> str:
    """Return the number with the largest relative error; "" if none can be compared."""
    ratios = {}
    for name, expected in own.expected.items():
        found = own.found.get(name)
        if _is_positive(found) and _is_positive(expected):
            ratios[name] = max(found / expected, expected / found)
    return max(ratios, key=lambda name: ratios[name], default="")


def _is_positive(value: Any) -> bool:
    return isinstance(value, float | int) and value > 0


def _shows(file: str, name: str) -> bool:
    """Return whether a figure shows the recording of a number, or the response of its cart."""
    if is_response(file):
        return bool(name) and file.endswith(f"-{read_name(name).cart}.svg")
    return name in numbers_in(file)
